/* Self-test of ${prefix}.c: runs the vectors and compares the output, bit for bit. main returns the
 * number of failed vectors.
 *
 * Prints the detections; with -DSILENT it prints nothing and needs no library, for use on a chip.
 *
 * Written by dmrl ${version} (`dmrl export`). */
#include "${prefix}_vectors.h"

#ifdef SILENT
#define SAY(...)
#else
#include <stdio.h>
#define SAY(...) printf(__VA_ARGS__)
#endif

static ${prefix}_t net;
#ifdef ${PREFIX}_FAR_BYTES
static ${prefix}_far_t away;
#define STATE &net, &away
#else
#define STATE &net
#endif
static ${prefix}_detection_t found[${most}];
static uint8_t line[${PREFIX}_ROW_BYTES];

static const uint8_t *next_row(const vector_t *vector, int row, uint32_t *state)
{
    if (vector->image)
        return vector->image + row * ${PREFIX}_ROW_BYTES;
    for (int k = 0; k < ${PREFIX}_ROW_BYTES; k++) {
        *state = *state * 1664525u + 1013904223u;
        line[k] = (uint8_t)(*state >> 24);
    }
    return line;
}

static uint32_t checksum(void)
{
    uint32_t sum = 2166136261u;
    for (int head = 0; head < ${PREFIX}_HEADS; head++)
        for (int row = 0; row < ${PREFIX}_ROWS; row++)
            for (int col = 0; col < ${PREFIX}_COLS; col++)
                sum = (sum ^ (uint8_t)${prefix}_output(&net, head, row, col)) * 16777619u;
    return sum;
}

static int same(const ${prefix}_detection_t *a, const ${prefix}_detection_t *b)
{
    return a->u_q4 == b->u_q4 && a->v_q4 == b->v_q4 && a->depth_mm == b->depth_mm
           && a->confidence == b->confidence;
}

static int passes(const vector_t *vector)
{
    uint32_t state = 1;
    ${prefix}_init(STATE);
    for (int row = 0; row < ${PREFIX}_HEIGHT; row++)
        ${prefix}_row(STATE, next_row(vector, row, &state));
    const int count = ${prefix}_detect(&net, found, ${most});
    int right = count == vector->count && checksum() == vector->checksum;
    for (int k = 0; k < count; k++) {
        SAY("  u %.2f px, v %.2f px, depth %d mm, confidence %.3f\n", found[k].u_q4 / 16.0,
            found[k].v_q4 / 16.0, found[k].depth_mm, found[k].confidence / 65535.0);
        right = right && same(&found[k], &vector->found[k]);
    }
    return right;
}

int main(void)
{
    const int count = (int)(sizeof vectors / sizeof vectors[0]);
    int failed = 0;
    for (int k = 0; k < count; k++) {
        SAY("vector %d, %s:\n", k, vectors[k].image ? "an image" : "noise");
        const int right = passes(&vectors[k]);
        SAY("  %s\n", right ? "as the reference" : "DIFFERS from the reference");
        failed += !right;
    }
    return failed;
}
