/* Computes one output row of a convolution and a 2x2 max-pool. The largest sum has the largest value,
 * so only that sum is scaled. The upper row reads in[0 ... taps - 1], the lower row the next ones. */
INLINE void convolve_pool_${suffix}(const uint8_t *const *in, uint8_t *out, const int8_t *weights,
                             const scale_t *scales, int cols, int taps, int run, int step,
                             int outs, int low, int high, int shift)
{
    const int filter = taps * run;
    for (int next = 0; outs >= 4 && next < outs; next += 4) {
        const int o = smallest(next, outs - 4);
        for (int x = 0; x < cols; x++) {
            const scale_t *scale = scales + o;
            int32_t sum[16];
            for (int k = 0; k < 16; k++)
                sum[k] = scale[k % 4].bias;
            block_${suffix}(sum, in, weights + o * filter, taps, run, 2 * x * step, step, 1);
            for (int k = 0; k < 4; k++)
                out[x * outs + o + k] = scaled(
                    largest(largest(sum[k], sum[k + 4]), largest(sum[k + 8], sum[k + 12])),
                    scale[k].multiplier, shift, low, high);
        }
    }
    for (int o = 0; outs < 4 && o < outs; o++) {
        for (int x = 0; x < cols; x++) {
            int32_t sum = INT32_MIN;
            for (int k = 0; k < 4; k++)
                sum = largest(sum, dot_${suffix}(scales[o].bias, in + k / 2 * taps,
                                          weights + o * filter, taps, run,
                                          (2 * x + k % 2) * step));
            out[x * outs + o] = scaled(sum, scales[o].multiplier, shift, low, high);
        }
    }
}

