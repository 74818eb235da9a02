INLINE int32_t largest(int32_t a, int32_t b)
{
    return a > b ? a : b;
}

