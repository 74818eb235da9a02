/* One output row of a convolution. The arguments but the first five are constants of the layer. */
INLINE void convolve_$suffix(const uint8_t *const *in, uint8_t *out, const int8_t *weights,
                        const scale_t *scales, int cols, int taps, int run, int step, int outs,
                        int low, int high, int wide)
{
    const int filter = taps * run, pairs = cols / 2 * 2, fours = outs / 4 * 4;
    for (int o = 0; o < fours; o += 4) {
        for (int x = 0; x < pairs; x += 2) {
            int32_t sum[8];
            dot_2x4_$suffix(sum, in, weights + o * filter, taps, run, x * step, step);
            for (int k = 0; k < 4; k++) {
                const scale_t *scale = &scales[o + k];
                out[x * outs + o + k] = clamp(scaled(sum[k], scale, wide), low, high);
                out[(x + 1) * outs + o + k] = clamp(scaled(sum[k + 4], scale, wide), low, high);
            }
        }
    }
    /* What is left: a last column, and channels beyond the last four. */
    for (int x = 0; x < cols; x++) {
        for (int o = x < pairs ? fours : 0; o < outs; o++) {
            const int32_t sum = dot_$suffix(in, weights + o * filter, taps, run, x * step);
            out[x * outs + o] = clamp(scaled(sum, &scales[o], wide), low, high);
        }
    }
}

