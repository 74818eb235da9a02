/* One output row of a convolution and a 2x2 max-pool. The largest sum gives the largest value,
 * so that only it is scaled. The upper row reads in[0 ... taps - 1], the lower one the next. */
INLINE void convolve_pool_$suffix(const uint8_t *const *in, uint8_t *out, const int8_t *weights,
                             const scale_t *scales, int cols, int taps, int run, int step,
                             int outs, int low, int high, int wide)
{
    const int filter = taps * run, fours = outs / 4 * 4;
    for (int o = 0; o < fours; o += 4) {
        for (int x = 0; x < cols; x++) {
            int32_t upper[8], lower[8];
            dot_2x4_$suffix(upper, in, weights + o * filter, taps, run, 2 * x * step, step);
            dot_2x4_$suffix(lower, in + taps, weights + o * filter, taps, run, 2 * x * step, step);
            for (int k = 0; k < 4; k++) {
                const int32_t sum = largest(largest(upper[k], upper[k + 4]),
                                            largest(lower[k], lower[k + 4]));
                out[x * outs + o + k] = clamp(scaled(sum, &scales[o + k], wide), low, high);
            }
        }
    }
    for (int o = fours; o < outs; o++) {
        for (int x = 0; x < cols; x++) {
            int32_t sum = INT32_MIN;
            for (int k = 0; k < 4; k++)
                sum = largest(sum, dot_$suffix(in + k / 2 * taps, weights + o * filter, taps, run,
                                          (2 * x + k % 2) * step));
            out[x * outs + o] = clamp(scaled(sum, &scales[o], wide), low, high);
        }
    }
}

