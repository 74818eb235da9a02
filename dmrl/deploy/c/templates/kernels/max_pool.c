/* Computes one output row of a 2x2 max-pool. */
INLINE void max_pool_${suffix}(const uint8_t *const *in, uint8_t *out, int cols, int channels)
{
    for (int x = 0; x < cols; x++) {
        for (int c = 0; c < channels; c++) {
            const ${type} *upper = (const ${type} *)in[0] + 2 * x * channels + c;
            const ${type} *lower = (const ${type} *)in[1] + 2 * x * channels + c;
            out[x * channels + c] = (uint8_t)largest(largest(upper[0], upper[channels]),
                                                     largest(lower[0], lower[channels]));
        }
    }
}

