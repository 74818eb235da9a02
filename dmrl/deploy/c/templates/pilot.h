/* Pilot: raw detections and the robot's state in, a command out. No heap, no libc.
 *
 * Call pilot_start once, then pilot_step 20 times a second. pilot_step never acts on an image that it
 * has used before or that is older than PILOT_MAX_AGE_S, and hovers without an image for PILOT_STALE_S.
 * Compile with -ffp-contract=off to get the commands of dmrl.flight.onboard_pilot, bit for bit.
 *
 * Written by dmrl ${version} (`dmrl export`). */
#ifndef PILOT_H
#define PILOT_H

#include <stdint.h>

#define PILOT_PAST ${PAST}
#define PILOT_DETECTIONS_MAX ${DETECTIONS_MAX}
#define PILOT_MAX_AGE_S ${MAX_AGE_S}
#define PILOT_STALE_S ${STALE_S}
#define PILOT_PACKET_MAX (12 + 8 * PILOT_DETECTIONS_MAX) /* bytes */

/* As the network's C detects: 1/16 px, millimetres, confidence of 65536. */
typedef struct {
    int32_t u_q4, v_q4;
    uint16_t depth_mm, confidence;
} pilot_detection_t;

/* Seconds, radians, metres per second along the robot's horizontal axes, metres above the floor. */
typedef struct {
    double time_s, roll, pitch, yaw_rate, vx, vy, height;
} pilot_state_t;

/* Metres per second along the robot's horizontal axes: forward, left, up; radians per second. */
typedef struct {
    double vx, vy, vz, yaw_rate;
} pilot_command_t;

typedef struct {
    double time_s, x, y, c, s, roll, pitch, height;
} pilot_pose_t;

typedef struct {
    double distance;
    pilot_pose_t past[PILOT_PAST]; /* a ring; the newest is at `newest` */
    int32_t newest, count;
    double mean[4], covariance[4][4], height, height_var, odds, side, seen_s, sure_s, image_s;
} pilot_t;

/* distance: metres to keep. */
void pilot_start(pilot_t *pilot, double distance);

/* image_s: exposure of the newest image that has arrived, on the clock of state->time_s; negative:
 * none yet. found, count: its detections. */
void pilot_step(pilot_t *pilot, const pilot_state_t *state, double image_s,
                const pilot_detection_t *found, int count, pilot_command_t *command);

/* Reads a CPX packet of the camera's chip, as dmrl.formats.aideck.cpx_detections packs it. Returns the
 * number of detections, -1 if the packet holds something else. time_ms: exposure on the camera's
 * clock. */
int pilot_unpack(const uint8_t *packet, int size, uint32_t *time_ms,
                 pilot_detection_t found[PILOT_DETECTIONS_MAX]);

#endif
