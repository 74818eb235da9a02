/* Returns the sum of products of one output channel at one pixel: `taps` runs of `run` adjacent
 * values; the run of tap t starts at in[t] + at. */
INLINE int32_t dot_${suffix}(int32_t sum, const uint8_t *const *in, const int8_t *weights, int taps,
                      int run, int at)
{
    for (int t = 0; t < taps; t++) {
        const ${type} *x = (const ${type} *)in[t] + at;
        const int8_t *w = weights + t * run;
        for (int i = 0; i < run; i++)
            sum += x[i] * w[i];
    }
    return sum;
}

/* Products of value i of a run: four output channels, `filter` weights apart, at two pixels. */
#define PAIR_${suffix}(i, first, second, a, b)                                   \
    {                                                                     \
        const int32_t w0 = w[i], w1 = w[(i) + filter];                    \
        const int32_t w2 = w[(i) + 2 * filter], w3 = w[(i) + 3 * filter]; \
        int32_t v = first;                                                \
        a##0 += v * w0, a##1 += v * w1, a##2 += v * w2, a##3 += v * w3;   \
        v = second;                                                       \
        b##0 += v * w0, b##1 += v * w1, b##2 += v * w2, b##3 += v * w3;   \
    }

#ifdef SMALL_CORE
/* The same at four pixels: sixteen products for eight loads. Sixteen sums, the loaded values and the
 * pointers fit into the registers of a 32-bit RISC-V. */
#define FOUR_${suffix}(i)                                                        \
    {                                                                     \
        PAIR_${suffix}(i, x[i], x[(i) + step], a, b)                             \
        PAIR_${suffix}(i, y[i], y[(i) + step], c, d)                             \
        IN_ORDER;                                                         \
    }

#define EIGHT_${suffix}(i)                                                                  \
    FOUR_${suffix}(i) FOUR_${suffix}((i) + 1) FOUR_${suffix}((i) + 2) FOUR_${suffix}((i) + 3)         \
    FOUR_${suffix}((i) + 4) FOUR_${suffix}((i) + 5) FOUR_${suffix}((i) + 6) FOUR_${suffix}((i) + 7)

/* Adds the products to the sums of four output channels at four pixels. These are adjacent, `step`
 * values apart, the first at in[t] + at; or 2x2 pixels of two rows, if a max-pool follows. */
INLINE void block_${suffix}(int32_t sum[16], const uint8_t *const *in, const int8_t *weights,
                     int taps, int run, int at, int step, int pooled)
{
    const int filter = taps * run;
    int32_t a0 = sum[0], a1 = sum[1], a2 = sum[2], a3 = sum[3];
    int32_t b0 = sum[4], b1 = sum[5], b2 = sum[6], b3 = sum[7];
    int32_t c0 = sum[8], c1 = sum[9], c2 = sum[10], c3 = sum[11];
    int32_t d0 = sum[12], d1 = sum[13], d2 = sum[14], d3 = sum[15];
    for (int t = 0; t < taps; t++) {
        const ${type} *x = (const ${type} *)in[t] + at;
        const ${type} *y = pooled ? (const ${type} *)in[t + taps] + at : x + 2 * step;
        const int8_t *w = weights + t * run;
        for (const int8_t *end = w + run / 16 * 16; w != end; x += 16, y += 16, w += 16) {
            if (!pooled)
                y = x + 2 * step;
            EIGHT_${suffix}(0)
            EIGHT_${suffix}(8)
        }
        if (run % 16 >= 8) {
            EIGHT_${suffix}(0)
            x += 8, y += 8, w += 8;
        }
        for (int i = 0; i < run % 8; i++)
            FOUR_${suffix}(i)
    }
    sum[0] = a0, sum[1] = a1, sum[2] = a2, sum[3] = a3;
    sum[4] = b0, sum[5] = b1, sum[6] = b2, sum[7] = b3;
    sum[8] = c0, sum[9] = c1, sum[10] = c2, sum[11] = c3;
    sum[12] = d0, sum[13] = d1, sum[14] = d2, sum[15] = d3;
}
#else
/* Large cores vectorise over the values of a run, and two pixels fill their registers. */
INLINE void pair_${suffix}(int32_t sum[8], const uint8_t *const *in,
                    const int8_t *weights, int taps, int run, int at, int step)
{
    const int filter = taps * run;
    int32_t a0 = 0, a1 = 0, a2 = 0, a3 = 0, b0 = 0, b1 = 0, b2 = 0, b3 = 0;
    for (int t = 0; t < taps; t++) {
        const ${type} *x = (const ${type} *)in[t] + at;
        const int8_t *w = weights + t * run;
        for (int i = 0; i < run; i++)
            PAIR_${suffix}(i, x[i], x[i + step], a, b)
    }
    sum[0] += a0, sum[1] += a1, sum[2] += a2, sum[3] += a3;
    sum[4] += b0, sum[5] += b1, sum[6] += b2, sum[7] += b3;
}

INLINE void block_${suffix}(int32_t sum[16], const uint8_t *const *in, const int8_t *weights,
                     int taps, int run, int at, int step, int pooled)
{
    pair_${suffix}(sum, in, weights, taps, run, at, step);
    pair_${suffix}(sum + 8, pooled ? in + taps : in, weights, taps, run,
            pooled ? at : at + 2 * step, step);
}
#endif

