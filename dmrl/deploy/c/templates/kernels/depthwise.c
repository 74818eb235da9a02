/* Computes one output row of a depthwise 3x3 convolution, channel by channel, with the nine weights
 * of a channel in registers. Two taps of a row are `across` values apart. */
INLINE void depthwise_${suffix}(const uint8_t *const *in, uint8_t *out, const int8_t *weights,
                         const scale_t *scales, int cols, int across, int step, int channels,
                         int low, int high, int shift)
{
    for (int c = 0; c < channels; c++) {
        const int8_t *w = weights + 9 * c;
        const int32_t w0 = w[0], w1 = w[1], w2 = w[2], w3 = w[3], w4 = w[4], w5 = w[5], w6 = w[6],
                      w7 = w[7], w8 = w[8];
        const scale_t scale = scales[c];
        const ${type} *p = (const ${type} *)in[0] + c, *q = (const ${type} *)in[1] + c,
                    *r = (const ${type} *)in[2] + c;
        for (int x = 0; x < cols; x++) {
            const int32_t sum = scale.bias + p[0] * w0 + p[across] * w1 + p[2 * across] * w2
                                + q[0] * w3 + q[across] * w4 + q[2 * across] * w5
                                + r[0] * w6 + r[across] * w7 + r[2 * across] * w8;
            store(out + x * channels + c, sum, scale.multiplier, shift, low, high);
            p += step, q += step, r += step;
        }
    }
}

