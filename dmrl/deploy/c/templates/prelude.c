/* $description
 *
 * Written by dmrl $version (`dmrl export`). Do not edit: change the model and export again.
 *
 * The image is read row by row. Between two layers is a ring buffer of the newest rows, as many as
 * its readers need. After each image row, the deepest layer with all its input rows computes one
 * output row, until no layer can. A row consists of pixels, a pixel of adjacent channels. Every
 * value of an output row is rounded once (see `scaled`).
 *
 * C99 or C++11 on a machine with 8-bit bytes where >> of a negative number rounds down, as on every
 * compiler known to us. No library, no floating point, no heap, no recursion.
 */
#include "$prefix.h"

#if defined(__GNUC__)
#define INLINE static inline __attribute__((always_inline))
#define APART static __attribute__((noinline))
#else
#define INLINE static inline
#define APART static
#endif

/* The sums of a block fill the registers of a 32-bit RISC-V, so no load may be moved ahead. For large
 * cores, the compiler's own schedule is better. */
#if defined(__GNUC__) && !defined(__clang__) && defined(__riscv)
#pragma GCC optimize("no-predictive-commoning", "no-schedule-insns", "no-tree-coalesce-vars", \
                     "no-tree-sink")
#define SMALL_CORE
#define IN_ORDER __asm__ volatile("" ::: "memory")
#define AS_IT_IS(value) __asm__ volatile("" : "+r"(value)) /* opaque to the optimiser */
#else
#define IN_ORDER ((void)0)
#define AS_IT_IS(value) ((void)0)
#endif

typedef char shifts_round_down[(-1 >> 1) == -1 ? 1 : -1];
typedef char state_is_as_stated[sizeof(${prefix}_t) == ${PREFIX}_STATE_BYTES ? 1 : -1];

/* Requantization of one output channel. Sums start at the bias, which includes the half step for
 * rounding and, if values are signed, an offset of 128 levels that keeps sums positive. */
typedef struct {
    int32_t bias, multiplier;
} scale_t;

INLINE int32_t smallest(int32_t a, int32_t b)
{
    return a < b ? a : b;
}

/* Clamps with few comparisons: half of a ReLU's inputs are negative, and few other values need
 * clamping. */
INLINE int32_t clamp(int32_t value, int32_t low, int32_t high)
{
    if (low == 0 && value < 0)
        return 0;
    if ((uint32_t)(value - low) > (uint32_t)(high - low))
        return value < low ? low : high;
    return value;
}

/* Scales a value of a shortcut to the sum. */
INLINE int32_t gained(int32_t gain, int32_t value)
{
    return (gain * value) >> $gain_shift;
}

/* Requantizes a sum, whose offset is -`low`. `shift` is nearly always 32: the high word of the
 * product. */
INLINE uint8_t scaled(int32_t sum, int32_t multiplier, int shift, int32_t low, int32_t high)
{
    const int64_t value = (((int64_t)sum * multiplier) >> shift) + low;
    if (shift < 32)
        return (uint8_t)(value < low ? low : value > high ? high : value);
    int32_t clamped = clamp((int32_t)value, low, high);
    AS_IT_IS(clamped);
    return (uint8_t)clamped;
}

/* Requantizes a sum and stores it. Half of a ReLU's inputs are negative and need no multiplication,
 * and few values are too large. Large cores compute faster than they branch. */
INLINE void store(uint8_t *out, int32_t sum, int32_t multiplier, int shift, int32_t low, int32_t high)
{
#ifdef SMALL_CORE
    if (low == 0 && shift == 32) {
        if (sum < 0) {
            *out = 0;
            IN_ORDER;
            return;
        }
        sum = (int32_t)(((int64_t)sum * multiplier) >> 32);
        AS_IT_IS(sum);
        *out = (uint8_t)sum;
        if (sum > high) {
            *out = (uint8_t)high;
            IN_ORDER;
        }
        return;
    }
#endif
    *out = scaled(sum, multiplier, shift, low, high);
}

/* volatile, since compilers would otherwise replace these two loops by memset and memcpy, which not
 * every target has. */
static void fill(uint8_t *out, uint8_t value, size_t count)
{
    volatile uint8_t *to = out;
    for (size_t i = 0; i < count; i++)
        to[i] = value;
}

APART void copy(uint8_t *out, const uint8_t *values, int count)
{
    volatile uint8_t *to = out;
    for (const uint8_t *end = values + count / 8 * 8; values != end; to += 8, values += 8) {
        to[0] = values[0];
        to[1] = values[1];
        to[2] = values[2];
        to[3] = values[3];
        to[4] = values[4];
        to[5] = values[5];
        to[6] = values[6];
        to[7] = values[7];
    }
    count %= 8;
    for (int i = 0; i < count; i++)
        to[i] = values[i];
}

