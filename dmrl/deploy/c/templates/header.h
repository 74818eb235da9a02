/* $description
 *
 * Written by dmrl $version (`dmrl export`).
 *
 *   state      $state_bytes bytes of RAM (${PREFIX}_STATE_BYTES), yours: static ${prefix}_t net;
 *   stack      at most $stack_bytes bytes (${PREFIX}_STACK_BYTES), in optimised builds
 *   constants  $constant_bytes bytes of weights and tables
 *   work       $macs multiply-accumulates per image
 *
 * No library, no floating point, no heap, no recursion, no global variables: two states may run
 * concurrently. Integers only; every machine and compiler gives the same result.
 */
#ifndef ${PREFIX}_H
#define ${PREFIX}_H

#include <stddef.h>
#include <stdint.h>

#ifdef __cplusplus
extern "C" {
#endif

#define ${PREFIX}_WIDTH $width
#define ${PREFIX}_HEIGHT $height
#define ${PREFIX}_CHANNELS $channels /* 3: red, green, blue; 1: grey */
#define ${PREFIX}_COLS $cols /* cells of ${PREFIX}_STRIDE x ${PREFIX}_STRIDE pixels */
#define ${PREFIX}_ROWS $rows
#define ${PREFIX}_STRIDE $stride

/* 1: images are raw Bayer mosaics, one byte per pixel, with red pixels in the rows and columns whose
 * index modulo 2 is RED_ROW and RED_COL (both 0: RGGB, as on the AI-deck).
 * 0: images have the network's format, ${PREFIX}_CHANNELS bytes per pixel. */
#ifndef ${PREFIX}_BAYER
#define ${PREFIX}_BAYER $bayer
#endif
#ifndef ${PREFIX}_RED_ROW
#define ${PREFIX}_RED_ROW 0
#endif
#ifndef ${PREFIX}_RED_COL
#define ${PREFIX}_RED_COL 0
#endif
#define ${PREFIX}_ROW_BYTES (${PREFIX}_WIDTH * (${PREFIX}_BAYER ? 1 : ${PREFIX}_CHANNELS))
#define ${PREFIX}_IMAGE_BYTES (${PREFIX}_HEIGHT * ${PREFIX}_ROW_BYTES)

/* Confidence threshold of detections, in steps of the network's output: $threshold.
 * ${PREFIX}_THRESHOLD_STEP 128 reports none, -128 every peak. */
#ifndef ${PREFIX}_THRESHOLD_STEP
#define ${PREFIX}_THRESHOLD_STEP ($threshold_step)
#endif

#define ${PREFIX}_STATE_BYTES ($state_bytes + (${PREFIX}_BAYER ? $bayer_bytes : 0))
#define ${PREFIX}_STACK_BYTES $stack_bytes

/* Outputs of the network in every cell. */
enum { $heads, ${PREFIX}_HEADS };

typedef struct {
    int32_t u_q4, v_q4;      /* 1/16 px from the image's left and top edge */
    uint16_t depth_mm;       /* along the optical axis */
    uint16_t confidence;     /* 65535 is 1 */
    int8_t confidence_step;  /* the same in steps of the network's output; used for comparisons */
} ${prefix}_detection_t;

$far/* Ring buffers between the layers. You allocate it; do not access its members. */
typedef struct {
$members} ${prefix}_t;

/* Prepares the state for an image. Call it before the first row of every image. */
void ${prefix}_init($params);

/* Reads the next row, ${PREFIX}_ROW_BYTES bytes, and computes all output rows that it completes.
 * `row` may be overwritten afterwards. Returns 1 after the last row; further rows are ignored. */
int ${prefix}_row($params, const uint8_t *row);

/* After the last row: writes at most `most` detections, best first; returns their number. */
int ${prefix}_detect(const ${prefix}_t *net, ${prefix}_detection_t *found, int most);

/* After the last row: returns the network's output in a cell, in steps. */
int8_t ${prefix}_output(const ${prefix}_t *net, int head, int row, int col);

/* Converts an output to units: confidence (65535 is 1), millimetres, or 1/16 px from the cell's left
 * or top edge. */
int32_t ${prefix}_meaning(int head, int8_t value);

/* Runs init, all rows and detect on an image of ${PREFIX}_IMAGE_BYTES bytes, from the top left. */
int ${prefix}_run($params, const uint8_t *image, ${prefix}_detection_t *found, int most);

#ifdef __cplusplus
}
#endif

#endif
