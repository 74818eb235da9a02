/* See ${prefix}_refine.h. Written by dmrl $version (`dmrl export --refine`). */
#include "${prefix}_refine.h"

enum { ONE = 4096, LARGEST = 127 * 65536, LARGEST_BIAS = 1 << 30 };

static const int8_t weights[${PREFIX}_HEADS * ${PREFIX}_FEATURES] = {
$weights
};
/* For each head: bias and multiplier as in $prefix.c, and the gains of a gradient step for weights
 * and bias, in 1/256. */
static const int32_t heads[${PREFIX}_HEADS][4] = {
$heads};

/* Returns value - slope * rate * gain / 2^shift, rounded and clipped to -most to most. */
static int32_t moved(int32_t value, int32_t slope, int32_t rate, int32_t gain, int shift, int32_t most)
{
    const int64_t by = ((int64_t)slope * rate * gain + ((int64_t)1 << (shift - 1))) >> shift;
    const int64_t to = value - by;
    return (int32_t)(to < -most ? -most : to > most ? most : to);
}

static const uint8_t *features_at(const ${prefix}_t *net, int row, int col)
{
    return net->$member + row * $row_bytes + $start + col * ${PREFIX}_FEATURES;
}

void ${prefix}_head_init(${prefix}_head_t *head)
{
    for (int h = 0; h < ${PREFIX}_HEADS; h++) {
        for (int c = 0; c < ${PREFIX}_FEATURES; c++)
            head->weight[h][c] = weights[h * ${PREFIX}_FEATURES + c] * 65536;
        head->bias[h] = heads[h][0];
    }
}

static void set(${prefix}_t *net, int h, int row, int col, int8_t value)
{
    switch (h) {
$set    default: break;
    }
}

void ${prefix}_head_apply(const ${prefix}_head_t *head, ${prefix}_t *net)
{
    for (int row = 0; row < ${PREFIX}_ROWS; row++) {
        for (int col = 0; col < ${PREFIX}_COLS; col++) {
            const uint8_t *x = features_at(net, row, col);
            for (int h = 0; h < ${PREFIX}_HEADS; h++) {
                int32_t sum = head->bias[h];
                for (int c = 0; c < ${PREFIX}_FEATURES; c++)
                    sum += x[c] * ((head->weight[h][c] + 32768) >> 16);
                const int64_t value = (((int64_t)sum * heads[h][1]) >> $shift) - 128;
                set(net, h, row, col, (int8_t)(value < -128 ? -128 : value > 127 ? 127 : value));
            }
        }
    }
}

/* Returns the gradient of the loss by a head's output in a cell, times ONE. Confidence: d * |d| for
 * an error d, but 0 in the cells around the robot's. Log depth and offsets: sign of the error. */
static int32_t slope(const ${prefix}_t *net, int h, int row, int col, int32_t u_q4, int32_t v_q4,
                     int32_t depth_mm)
{
    const int step = 16 * ${PREFIX}_STRIDE;
    const int down = depth_mm ? row - v_q4 / step : ${PREFIX}_ROWS;
    const int right = depth_mm ? col - u_q4 / step : ${PREFIX}_COLS;
    const int32_t value = ${prefix}_meaning(h, ${prefix}_output(net, h, row, col));
    if (h == ${PREFIX}_CONFIDENCE) {
        const int here = down == 0 && right == 0;
        const int32_t off = value / 16 - (here ? ONE : 0);
        if (!here && -2 < down && down < 2 && -2 < right && right < 2)
            return 0;
        return off * (off < 0 ? -off : off) / ONE;
    }
    if (down || right)
        return 0;
    const int32_t wanted = h == ${PREFIX}_DEPTH ? depth_mm : $place;
    const int32_t most = h == ${PREFIX}_DEPTH ? ONE : ONE / 2;
    return value > wanted ? most : value < wanted ? -most : 0;
}

void ${prefix}_head_learn(${prefix}_head_t *head, const ${prefix}_t *net, int32_t u_q4, int32_t v_q4,
                     int32_t depth_mm, int32_t rate)
{
    for (int h = 0; h < ${PREFIX}_HEADS; h++) {
        for (int row = 0; row < ${PREFIX}_ROWS; row++) {
            for (int col = 0; col < ${PREFIX}_COLS; col++) {
                const int32_t by = slope(net, h, row, col, u_q4, v_q4, depth_mm);
                const uint8_t *x = features_at(net, row, col);
                if (by == 0)
                    continue;
                for (int c = 0; c < ${PREFIX}_FEATURES; c++)
                    head->weight[h][c] = moved(head->weight[h][c], by * x[c], rate, heads[h][2],
                                               24, LARGEST);
                head->bias[h] = moved(head->bias[h], by, rate, heads[h][3], 36, LARGEST_BIAS);
            }
        }
    }
}
