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
#define APART static __attribute__((noinline))
#else
#define INLINE static inline
#define APART static
#endif

/* The sums of a block fill the registers of a 32-bit RISC-V: nothing may be loaded ahead of its
 * turn. Compilers for large cores know better what to do. */
#if defined(__GNUC__) && !defined(__clang__) && defined(__riscv)
#pragma GCC optimize("no-predictive-commoning", "no-schedule-insns", "no-tree-coalesce-vars", \
                     "no-tree-sink")
#define SMALL_CORE
#define IN_ORDER __asm__ volatile("" ::: "memory")
#define AS_IT_IS(value) __asm__ volatile("" : "+r"(value)) /* to be computed, not to be reasoned about */
#else
#define IN_ORDER ((void)0)
#define AS_IT_IS(value) ((void)0)
#endif

typedef char shifts_round_down[(-1 >> 1) == -1 ? 1 : -1];
typedef char state_is_as_stated[sizeof(${prefix}_t) == ${PREFIX}_STATE_BYTES ? 1 : -1];

/* How the sums of one output channel become its values: they begin at the bias, which holds the
 * half step that rounds and, where values are signed, the 128 levels that keep it above zero. */
typedef struct {
    int32_t bias, multiplier;
} scale_t;

INLINE int32_t smallest(int32_t a, int32_t b)
{
    return a < b ? a : b;
}

/* Half of what a ReLU sees is negative; other values seldom need clamping, and one comparison
 * tells. */
INLINE int32_t clamp(int32_t value, int32_t low, int32_t high)
{
    if (low == 0 && value < 0)
        return 0;
    if ((uint32_t)(value - low) > (uint32_t)(high - low))
        return value < low ? low : high;
    return value;
}

/* What a value of a shortcut adds to a sum. */
INLINE int32_t gained(int32_t gain, int32_t value)
{
    return (gain * value) >> $gain_shift;
}

/* A value of a sum, which is `low` above it. `shift` is nearly always 32: a multiplication that keeps the high word. */
INLINE uint8_t scaled(int32_t sum, int32_t multiplier, int shift, int32_t low, int32_t high)
{
    const int64_t value = (((int64_t)sum * multiplier) >> shift) + low;
    if (shift < 32)
        return (uint8_t)(value < low ? low : value > high ? high : value);
    int32_t clamped = clamp((int32_t)value, low, high);
    AS_IT_IS(clamped);
    return (uint8_t)clamped;
}

/* Stores a value of a sum. Half of what a ReLU sees is negative and needs no multiplication, and few
 * values are too large; large cores rather compute than branch. */
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

/* Compilers would make these two loops calls of memset and memcpy, which not every target has:
 * hence volatile. */
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
        to[0] = values[0], to[1] = values[1], to[2] = values[2], to[3] = values[3];
        to[4] = values[4], to[5] = values[5], to[6] = values[6], to[7] = values[7];
    }
    count %= 8;
    for (int i = 0; i < count; i++)
        to[i] = values[i];
}

