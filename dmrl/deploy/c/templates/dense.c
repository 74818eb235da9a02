/* Sum of products of one output channel at one pixel: `taps` runs of `run` values side by side,
 * the one of tap t starting at in[t] + at. */
INLINE int32_t dot_$suffix(const uint8_t *const *in, const int8_t *weights, int taps, int run, int at)
{
    int32_t sum = 0;
    for (int t = 0; t < taps; t++) {
        const $type *x = (const $type *)in[t] + at;
        const int8_t *w = weights + t * run;
        UNROLL
        for (int i = 0; i < run; i++)
            sum += x[i] * w[i];
    }
    return sum;
}

/* The same for four output channels at two pixels, `step` values apart: eight products for six
 * loads, and few enough sums for the registers of any core. */
INLINE void dot_2x4_$suffix(int32_t sum[8], const uint8_t *const *in, const int8_t *weights,
                       int taps, int run, int at, int step)
{
    const int filter = taps * run;
    int32_t a0 = 0, a1 = 0, a2 = 0, a3 = 0, b0 = 0, b1 = 0, b2 = 0, b3 = 0;
    for (int t = 0; t < taps; t++) {
        const $type *x = (const $type *)in[t] + at;
        const int8_t *w = weights + t * run;
        UNROLL
        for (int i = 0; i < run; i++) {
            const int32_t a = x[i], b = x[i + step];
            const int32_t w0 = w[i], w1 = w[i + filter];
            const int32_t w2 = w[i + 2 * filter], w3 = w[i + 3 * filter];
            a0 += a * w0, a1 += a * w1, a2 += a * w2, a3 += a * w3;
            b0 += b * w0, b1 += b * w1, b2 += b * w2, b3 += b * w3;
        }
    }
    sum[0] = a0, sum[1] = a1, sum[2] = a2, sum[3] = a3;
    sum[4] = b0, sum[5] = b1, sum[6] = b2, sum[7] = b3;
}

