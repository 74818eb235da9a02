/* See pilot.h. The reference, with the reasons, is dmrl/flight/onboard_pilot.py: the same operations
 * in the same order.
 *
 * Written by dmrl ${version} (`dmrl export`). */
#include "pilot.h"

#if defined(__clang__)
#pragma STDC FP_CONTRACT OFF
#endif

#define ROUTE_BYTES 4
#define HEAD_BYTES 8
#define ROW_BYTES 8

static uint32_t u16_at(const uint8_t *data) { return data[0] | (uint32_t)data[1] << 8; }

int pilot_unpack(const uint8_t *packet, int size, uint32_t *time_ms,
                 pilot_detection_t found[PILOT_DETECTIONS_MAX])
{
    const uint8_t *head = packet + ROUTE_BYTES;
    if (size < ROUTE_BYTES + HEAD_BYTES || (packet[3] & 63) != 5 || head[0] != 0xDE ||
        head[1] > PILOT_DETECTIONS_MAX || size != ROUTE_BYTES + HEAD_BYTES + ROW_BYTES * head[1])
        return -1;
    *time_ms = u16_at(head + 4) | u16_at(head + 6) << 16;
    for (int k = 0; k < head[1]; k++) {
        const uint8_t *row = head + HEAD_BYTES + ROW_BYTES * k;
        found[k].u_q4 = (int16_t)u16_at(row);
        found[k].v_q4 = (int16_t)u16_at(row + 2);
        found[k].depth_mm = (uint16_t)u16_at(row + 4);
        found[k].confidence = (uint16_t)u16_at(row + 6);
    }
    return head[1];
}

typedef struct {
    double x, y, z, along, across, upward, to_x, to_y, away, odds;
} place_t;

typedef struct {
    double likelihood, rx, ry, ixx, ixy, iyy;
} candidate_t;

static double larger(double a, double b) { return b > a ? b : a; }
static double smaller(double a, double b) { return b < a ? b : a; }
static double size_of(double a) { return a < 0.0 ? -a : a; }

static void turn_of(double angle, double *c, double *s)
{
    const double half = angle / 2.0, scale = 1.0 / (1.0 + half * half);
    *c = (1.0 - half * half) * scale;
    *s = 2.0 * half * scale;
}

static double root(double value)
{
    double guess;
    if (value <= 0.0)
        return 0.0;
    guess = larger(value, 1.0);
    for (int k = 0; k < 40; k++)
        guess = 0.5 * (guess + value / guess);
    return guess;
}

static double angle_of(double x, double y)
{
    const double wide = size_of(x), high = size_of(y);
    double t, q, a;
    if (wide + high == 0.0)
        return 0.0;
    t = smaller(wide, high) / larger(wide, high);
    q = t * t;
    a = 0.9998660 + q * (-0.3302995 + q * (0.1801410 + q * (-0.0851330 + q * 0.0208351)));
    a *= t;
    if (high > wide)
        a = 1.5707963267948966 - a;
    if (x < 0.0)
        a = 3.141592653589793 - a;
    return y >= 0.0 ? a : -a;
}

static void restart(pilot_t *p, double x, double y, double z, double variance, double time_s)
{
    for (int i = 0; i < 4; i++) {
        p->mean[i] = 0.0;
        for (int j = 0; j < 4; j++)
            p->covariance[i][j] = i != j ? 0.0 : i < 2 ? variance : ${SPEED_VAR};
    }
    p->mean[0] = x;
    p->mean[1] = y;
    p->height = z;
    p->height_var = variance;
    p->odds = 1.0;
    p->seen_s = p->sure_s = time_s;
}

void pilot_start(pilot_t *pilot, double distance)
{
    pilot->distance = distance;
    pilot->newest = pilot->count = 0;
    pilot->side = 1.0;
    pilot->image_s = -1.0;
}

static void move(pilot_t *p, const pilot_state_t *state)
{
    const pilot_pose_t before = p->past[p->newest];
    const double dt = state->time_s - before.time_s, keep = 1.0 / (1.0 + dt / ${SPEED_S});
    double turned_c, turned_s, rows[4][4], *m = p->mean;
    pilot_pose_t *now;
    turn_of(state->yaw_rate * dt, &turned_c, &turned_s);
    p->newest = (p->newest + 1) % PILOT_PAST;
    now = &p->past[p->newest];
    now->c = before.c * turned_c - before.s * turned_s;
    now->s = before.s * turned_c + before.c * turned_s;
    now->x = before.x + dt * (now->c * state->vx - now->s * state->vy);
    now->y = before.y + dt * (now->s * state->vx + now->c * state->vy);
    now->time_s = state->time_s;
    now->roll = state->roll;
    now->pitch = state->pitch;
    now->height = state->height;
    p->count += p->count < PILOT_PAST;
    for (int i = 0; i < 2; i++) {
        m[i] = m[i] + dt * m[i + 2];
        m[i + 2] = keep * m[i + 2];
        for (int j = 0; j < 4; j++) {
            rows[i][j] = p->covariance[i][j] + dt * p->covariance[i + 2][j];
            rows[i + 2][j] = keep * p->covariance[i + 2][j];
        }
    }
    for (int i = 0; i < 4; i++)
        for (int j = 0; j < 2; j++) {
            p->covariance[i][j] = rows[i][j] + dt * rows[i][j + 2];
            p->covariance[i][j + 2] = keep * rows[i][j + 2];
        }
    for (int i = 0; i < 2; i++) {
        p->covariance[i][i] += ${DRIFT_VAR} * dt;
        p->covariance[i + 2][i + 2] += (1.0 - keep * keep) * ${SPEED_VAR};
    }
    p->height_var += ${DRIFT_VAR} * dt;
}

static place_t locate(const pilot_pose_t *then, const pilot_detection_t *found)
{
    place_t place;
    double cr, sr, cp, sp, along, across, rise;
    const double sureness = (found->confidence + 0.5) / 65536.0;
    const double depth = found->depth_mm / 1000.0;
    const double left = (${CX} - found->u_q4 / 16.0) / ${FX} * depth;
    const double up = (${CY} - found->v_q4 / 16.0) / ${FY} * depth;
    double level, ahead, aside;
    turn_of(then->roll, &cr, &sr);
    turn_of(then->pitch, &cp, &sp);
    level = sr * left + cr * up;
    ahead = cp * depth + sp * level;
    aside = cr * left - sr * up;
    place.x = then->x + (then->c * ahead - then->s * aside);
    place.y = then->y + (then->s * ahead + then->c * aside);
    place.z = then->height + (cp * level - sp * depth);
    place.away = root(ahead * ahead + aside * aside) + 0.001;
    along = (${DEPTH_RATIO} - ${DEPTH_SURE} * sureness) * place.away;
    across = ${SIDE_RATIO} * place.away;
    rise = (place.z - then->height) / place.away * along;
    place.to_x = (place.x - then->x) / place.away;
    place.to_y = (place.y - then->y) / place.away;
    place.along = along * along;
    place.across = across * across;
    place.upward = across * across + rise * rise;
    place.odds = sureness / (1.0 - sureness);
    return place;
}

static candidate_t compare(const pilot_t *pilot, const place_t *at, double age)
{
    candidate_t c;
    const double(*p)[4] = pilot->covariance, *m = pilot->mean, aa = age * age;
    double sxx = p[0][0] - age * (p[0][2] + p[2][0]) + aa * p[2][2];
    double sxy = p[0][1] - age * (p[0][3] + p[2][1]) + aa * p[2][3];
    double syy = p[1][1] - age * (p[1][3] + p[3][1]) + aa * p[3][3];
    const double rz = at->z - pilot->height, szz = pilot->height_var + at->upward;
    double det, squared, near;
    c.rx = at->x - (m[0] - age * m[2]);
    c.ry = at->y - (m[1] - age * m[3]);
    sxx += at->along * at->to_x * at->to_x + at->across * at->to_y * at->to_y;
    sxy += (at->along - at->across) * at->to_x * at->to_y;
    syy += at->along * at->to_y * at->to_y + at->across * at->to_x * at->to_x;
    det = sxx * syy - sxy * sxy;
    c.ixx = syy / det;
    c.ixy = -sxy / det;
    c.iyy = sxx / det;
    squared =
        c.rx * (c.ixx * c.rx + c.ixy * c.ry) + c.ry * (c.ixy * c.rx + c.iyy * c.ry) + rz * rz / szz;
    near = 1.0 + squared / 6.0;
    c.likelihood = 1.0 / (15.749609945722419 * root(det * szz) * near * near * near) * at->away *
                   at->away * at->away;
    if (squared > ${GATE})
        c.likelihood = 0.0;
    return c;
}

static void update(pilot_t *pilot, const candidate_t *c, const place_t *at, double age,
                   double weight)
{
    const double kz = weight * pilot->height_var / (pilot->height_var + at->upward);
    double hx[4], hy[4], kx[4], ky[4], (*p)[4] = pilot->covariance;
    for (int i = 0; i < 4; i++) {
        hx[i] = p[i][0] - age * p[i][2];
        hy[i] = p[i][1] - age * p[i][3];
        kx[i] = weight * (hx[i] * c->ixx + hy[i] * c->ixy);
        ky[i] = weight * (hx[i] * c->ixy + hy[i] * c->iyy);
        pilot->mean[i] = pilot->mean[i] + (kx[i] * c->rx + ky[i] * c->ry);
    }
    for (int i = 0; i < 4; i++)
        for (int j = 0; j < 4; j++)
            p[i][j] = p[i][j] - (kx[i] * hx[j] + ky[i] * hy[j]);
    pilot->height += kz * (at->z - pilot->height);
    pilot->height_var -= kz * pilot->height_var;
    pilot->seen_s = pilot->image_s;
}

static const pilot_pose_t *pose_at(const pilot_t *p, double time_s)
{
    const pilot_pose_t *then = &p->past[p->newest];
    for (int k = 0; k < p->count; k++) {
        const pilot_pose_t *pose = &p->past[(p->newest + PILOT_PAST - k) % PILOT_PAST];
        if (pose->time_s >= time_s)
            then = pose;
    }
    return then;
}

static void look(pilot_t *p, double age, const pilot_detection_t *found, int count)
{
    const pilot_pose_t *then = pose_at(p, p->image_s);
    const double dx = p->mean[0] - age * p->mean[2] - then->x;
    const double dy = p->mean[1] - age * p->mean[3] - then->y;
    const double ahead = then->c * dx + then->s * dy, aside = then->c * dy - then->s * dx;
    const int in_view = ahead > 0.1 && size_of(aside) < ${IN_VIEW} * ahead;
    const double share = in_view ? ${SEEN_SHARE} : ${UNSEEN_SHARE}, miss = 1.0 - share;
    double total = 0.0, others = 0.0, most = miss, own = 0.0, elsewhere;
    candidate_t best = {0.0, 0.0, 0.0, 0.0, 0.0, 0.0};
    place_t best_at = {0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0}, sure_at = best_at;
    int sure = -1, chosen = -1;
    for (int k = 0; k < count && k < PILOT_DETECTIONS_MAX; k++) {
        const place_t at = locate(then, &found[k]);
        const candidate_t c = compare(p, &at, age);
        const double square = at.odds * at.odds;
        const double evidence = 1.0 / (1.0 / (${EVIDENCE} * square) + 1.0 / ${OTHERS});
        const double ratio = share * evidence * c.likelihood;
        total += smaller(ratio, share * smaller(${STAYING} + square, ${OTHERS}));
        others += evidence;
        if (ratio > most) {
            most = ratio;
            best = c;
            best_at = at;
            own = evidence;
            chosen = k;
        }
        if (found[k].confidence >= (sure < 0 ? ${FOUND} : found[sure].confidence + 1)) {
            sure = k;
            sure_at = at;
        }
    }
    elsewhere = ${ELSEWHERE_SHARE} * (others - own) / ${VIEW};
    elsewhere += 1.0 - ${ELSEWHERE_SHARE};
    p->odds = smaller(p->odds * (miss + total) / elsewhere, ${MAX_ODDS});
    p->odds = larger(p->odds, 0.001);
    if (p->odds < ${LOST_ODDS} && sure >= 0 && sure != chosen)
        restart(p, sure_at.x, sure_at.y, sure_at.z, sure_at.along, p->image_s);
    else if (chosen >= 0) {
        update(p, &best, &best_at, age, most / (miss + most));
        if (found[chosen].confidence >= ${SURE})
            p->sure_s = p->image_s;
    }
}

static void give(pilot_command_t *command, double vx, double vy, double vz, double yaw_rate)
{
    command->vx = vx;
    command->vy = vy;
    command->vz = vz;
    command->yaw_rate = yaw_rate;
}

static void steer(pilot_t *p, const pilot_state_t *state, pilot_command_t *command)
{
    const pilot_pose_t *pose = &p->past[p->newest];
    const double *m = p->mean, dx = m[0] - pose->x, dy = m[1] - pose->y;
    const double x = pose->c * dx + pose->s * dy, y = pose->c * dy - pose->s * dx;
    const double vx = pose->c * m[2] + pose->s * m[3], vy = pose->c * m[3] - pose->s * m[2];
    const double drift_x = vx - state->vx, drift_y = vy - state->vy;
    const int stale = state->time_s - p->image_s > PILOT_STALE_S;
    const int unsure = state->time_s - p->sure_s > ${UNSURE_S};
    const double angle = angle_of(x, y), away = root(x * x + y * y) + 0.001;
    const double variance = 0.5 * (p->covariance[0][0] + p->covariance[1][1]);
    double to_x, to_y, trust, gap, wx, wy, towards, less, near;
    if (stale) {
        give(command, 0.0, 0.0, 0.0, 0.0);
        return;
    }
    if (unsure || state->time_s - p->seen_s > ${BLIND_S}) {
        if (-p->side * angle > larger(${SWEEP} * (root(variance) / away) - ${HALF_VIEW}, 0.0))
            p->side = -p->side;
        give(command, 0.0, 0.0, 0.0, p->side * ${SEARCH_RATE});
        return;
    }
    p->side = y + 0.7 * drift_y > 0.0 ? 1.0 : -1.0;
    to_x = x / away;
    to_y = y / away;
    trust = p->odds / (1.0 + p->odds) / (1.0 + variance / ${TRUST_VAR});
    gap = ${GAIN} * (away - p->distance);
    wx = trust * (vx + gap * to_x);
    wy = trust * (vy + gap * to_y);
    if (away < ${NEAR}) {
        towards = wx * to_x + wy * to_y;
        less = larger(towards, 0.0) + 2.0 * trust * (${NEAR} - away);
        wx = wx - less * to_x;
        wy = wy - less * to_y;
    }
    near = larger(away * away, ${NEAR} * ${NEAR});
    give(command, wx, wy, trust * ${CLIMB_GAIN} * (p->height - state->height),
         ${TURN_GAIN} * angle + trust * (x * drift_y - y * drift_x) / near);
}

void pilot_step(pilot_t *p, const pilot_state_t *state, double image_s,
                const pilot_detection_t *found, int count, pilot_command_t *command)
{
    const double age = state->time_s - image_s;
    if (p->count == 0) {
        pilot_pose_t *first = &p->past[0];
        first->time_s = state->time_s;
        first->x = first->y = first->s = first->roll = first->pitch = first->height = 0.0;
        first->c = 1.0;
        restart(p, p->distance, 0.0, state->height, ${START_VAR}, state->time_s);
        p->odds = ${START_ODDS};
    }
    move(p, state);
    if (image_s > p->image_s && image_s >= 0.0) {
        p->image_s = image_s;
        if (age <= PILOT_MAX_AGE_S)
            look(p, age, found, count);
    }
    steer(p, state, command);
}
