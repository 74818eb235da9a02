/* Computes one output row of a sum: (a * first + b * second + 2^(shift - 1)) >> shift. */
INLINE void add_${suffixes}(const uint8_t *const *in, uint8_t *out, int values, int32_t first,
                      int32_t second, int shift, int low, int high)
{
    const ${type} *a = (const ${type} *)in[0];
    const ${other} *b = (const ${other} *)in[1];
    for (int i = 0; i < values; i++)
        out[i] = (uint8_t)clamp((a[i] * first + b[i] * second + (1 << (shift - 1))) >> shift, low,
                                high);
}

