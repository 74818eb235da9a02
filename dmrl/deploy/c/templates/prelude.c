/* $description
 *
 * Written by dmrl $version (`dmrl export`). Change the model and export again, not this file.
 *
 * The image comes row by row. What stands between two layers is a ring of the newest rows, as
 * many as its readers reach over. After each image row, the deepest layer that has the rows it
 * needs makes one output row, until none has. A row is a row of pixels; the channels of a pixel
 * lie side by side. A layer's output row ends in one rounding per value (see `scaled`).
 *
 * C99 on a machine with 8-bit bytes where >> of a negative number rounds down, as on every
 * compiler known to us. No library, no floating point, no heap, no recursion.
 */
#include "$prefix.h"

#if defined(__GNUC__)
#define INLINE static inline __attribute__((always_inline))
#else
#define INLINE static inline
#endif

/* Small cores gain from unrolling, and lose by carrying loads over to the next round;
 * compilers for large ones know better what to do. */
#if defined(__GNUC__) && !defined(__clang__) && (defined(__riscv) || defined(__arm__))
#pragma GCC optimize("no-predictive-commoning")
#define UNROLL _Pragma("GCC unroll 3")
#else
#define UNROLL
#endif

typedef char shifts_round_down[(-1 >> 1) == -1 ? 1 : -1];
typedef char state_is_as_stated[sizeof(${prefix}_t) == ${PREFIX}_STATE_BYTES ? 1 : -1];

/* How the sums of one output channel become its values. */
typedef struct {
    int32_t bias, multiplier, shift;
} scale_t;

INLINE int32_t smallest(int32_t a, int32_t b)
{
    return a < b ? a : b;
}

/* Most values need no clamping: one comparison tells. */
INLINE uint8_t clamp(int32_t value, int32_t low, int32_t high)
{
    if ((uint32_t)(value - low) <= (uint32_t)(high - low))
        return (uint8_t)value;
    return (uint8_t)(value < low ? low : high);
}

/* (sum * multiplier + 2^(shift - 1)) >> shift. Where every shift of the layer is above 32 the low
 * word of the product has no say, and a multiplication that keeps the high word will do; `wide`
 * layers have others too. */
INLINE int32_t scaled(int32_t sum, const scale_t *scale, int wide)
{
    const int64_t product = (int64_t)(sum + scale->bias) * scale->multiplier;
    if (wide) {
        const int64_t value = (product + ((int64_t)1 << (scale->shift - 1))) >> scale->shift;
        return value < -32768 ? -32768 : value > 32767 ? 32767 : (int32_t)value;
    }
    return ((int32_t)(product >> 32) + (1 << (scale->shift - 33))) >> (scale->shift - 32);
}

