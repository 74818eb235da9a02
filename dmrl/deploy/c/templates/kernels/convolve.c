/* Computes one output row of a convolution, with an optional shortcut, in blocks of four channels
 * and four pixels. The last block of a row, or of the channels, is moved back to end with them, so
 * some values are computed twice. */
INLINE void convolve_${suffixes}(const uint8_t *const *in, uint8_t *out, const int8_t *weights,
                        const scale_t *scales, const uint8_t *shortcut, const int32_t *gains,
                        int adds, int cols, int taps, int run, int step, int outs, int low,
                        int high, int shift)
{
    const int filter = taps * run;
    if (cols < 4 || outs < 4) {
        for (int x = 0; x < cols; x++) {
            for (int o = 0; o < outs; o++) {
                int32_t sum = dot_${suffix}(scales[o].bias, in, weights + o * filter, taps, run,
                                     x * step);
                if (adds)
                    sum += gained(gains[o], ((const ${other} *)shortcut)[x * outs + o]);
                out[x * outs + o] = scaled(sum, scales[o].multiplier, shift, low, high);
            }
        }
        return;
    }
    for (int next = 0; next < outs; next += 4) {
        const int o = smallest(next, outs - 4);
        const scale_t *scale = scales + o;
        const int8_t *filters = weights + o * filter;
        uint8_t *row = out + o;
        const ${other} *added = adds ? (const ${other} *)shortcut + o : 0;
        const int32_t *gain = adds ? gains + o : 0;
        for (int after = 0; after < cols; after += 4) {
            const int x = smallest(after, cols - 4);
            int32_t sum[16]; /* bias and shortcut first, while registers are free */
            for (int k = 0; k < 16; k++)
                sum[k] = scale[k % 4].bias;
            if (adds) {
                const ${other} *s = added + x * outs;
                AS_IT_IS(s);
                const int32_t g[4] = {gain[0], gain[1], gain[2], gain[3]};
                for (int k = 0; k < 16; k++) {
                    sum[k] += gained(g[k % 4], s[k / 4 * outs + k % 4]);
                    AS_IT_IS(sum[k]);
                }
            }
            block_${suffix}(sum, in, filters, taps, run, x * step, step, 0);
            uint8_t *place = row + x * outs;
            AS_IT_IS(place);
            const int32_t m[4] = {scale[0].multiplier, scale[1].multiplier, scale[2].multiplier,
                                  scale[3].multiplier};
            int32_t most = high;
            AS_IT_IS(most); /* load once per block, not per value */
            for (int k = 0; k < 16; k++)
                store(&place[k / 4 * outs + k % 4], sum[k], m[k % 4], shift, low, most);
        }
    }
}

