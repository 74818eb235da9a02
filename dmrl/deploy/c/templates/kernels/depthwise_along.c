/* Sum of nine products: three columns of three rows. */
#define NINE(a, b, c)                                                             \
    (bias + (a##0 * w0 + b##0 * w1 + c##0 * w2) + (a##1 * w3 + b##1 * w4 + c##1 * w5) \
     + (a##2 * w6 + b##2 * w7 + c##2 * w8))

/* Computes three values; the column registers a, b and c rotate, so each column is loaded once. */
#define THREE(at)                                                                        \
    c0 = p[((at) + 1) * step], c1 = q[((at) + 1) * step], c2 = r[((at) + 1) * step];     \
    store(to + (at) * step, NINE(a, b, c), multiplier, shift, low, high);                \
    a0 = p[((at) + 2) * step], a1 = q[((at) + 2) * step], a2 = r[((at) + 2) * step];     \
    store(to + ((at) + 1) * step, NINE(b, c, a), multiplier, shift, low, high);          \
    b0 = p[((at) + 3) * step], b1 = q[((at) + 3) * step], b2 = r[((at) + 3) * step];     \
    store(to + ((at) + 2) * step, NINE(c, a, b), multiplier, shift, low, high);

/* Computes one output row of a depthwise 3x3 convolution with stride 1 and padding equal to the
 * dilation, channel by channel. The nine weights and two of the three columns stay in registers, so
 * each column is loaded once. Positions left and right of the row read as `pad`. */
INLINE void depthwise_along_${suffix}(const uint8_t *const *in, uint8_t *out, const int8_t *weights,
                               const scale_t *scales, int cols, int channels, int dilation,
                               int pad, int low, int high, int shift)
{
    const int step = dilation * channels;
    for (int c = 0; c < channels; c++) {
        const int8_t *w = weights + 9 * c;
        const int32_t w0 = w[0], w1 = w[1], w2 = w[2], w3 = w[3], w4 = w[4], w5 = w[5], w6 = w[6],
                      w7 = w[7], w8 = w[8];
        const int32_t bias = scales[c].bias, multiplier = scales[c].multiplier;
        for (int first = 0; first < dilation && first < cols; first++) {
            const int at = first * channels + c;
            const ${type} *p = (const ${type} *)in[0] + at, *q = (const ${type} *)in[1] + at,
                        *r = (const ${type} *)in[2] + at;
            uint8_t *to = out + at;
            int32_t a0 = pad, a1 = pad, a2 = pad, b0 = p[0], b1 = q[0], b2 = r[0], c0, c1, c2;
            int left = (cols - 1 - first) / dilation; /* columns to the right of b */
            for (; left >= 6; left -= 6) {
                p += 6 * step, q += 6 * step, r += 6 * step, to += 6 * step;
                AS_IT_IS(p); AS_IT_IS(q); AS_IT_IS(r); AS_IT_IS(to);
                THREE(-6) THREE(-3)
            }
            if (left >= 3) {
                left -= 3, p += 3 * step, q += 3 * step, r += 3 * step, to += 3 * step;
                AS_IT_IS(p); AS_IT_IS(q); AS_IT_IS(r); AS_IT_IS(to);
                THREE(-3)
            }
            for (; left >= 0; left--) {
                p += step, q += step, r += step;
                c0 = c1 = c2 = pad;
                if (left)
                    c0 = p[0], c1 = q[0], c2 = r[0];
                store(to, NINE(a, b, c), multiplier, shift, low, high);
                a0 = b0, a1 = b1, a2 = b2, b0 = c0, b1 = c1, b2 = c2;
                to += step;
            }
        }
    }
}

