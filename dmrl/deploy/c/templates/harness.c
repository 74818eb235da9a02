/* Runs the network on every image from standard input, for `dmrl verify` and others; or, as a shared
 * library, on one image per call.
 *
 * Output for each image, little endian: the grid of every head, int8, row by row; int32 stack bytes
 * used (0 where not measured); int32 number of detections; the detections, as in the header. On a
 * bare RISC-V it makes its own system calls, so it needs no library. */
#include "${prefix}.h"

static ${prefix}_t net;
#ifdef ${PREFIX}_FAR_BYTES
static ${prefix}_far_t away;
#define STATE &net, &away
#else
#define STATE &net
#endif

#if defined(HARNESS_GUARD) && defined(${PREFIX}_FAR_BYTES)
/* Under the address sanitizer, only copies may access the far state, and they must copy exactly the
 * number of bytes in the header. */
void __asan_poison_memory_region(const volatile void *place, size_t size);
void __asan_unpoison_memory_region(const volatile void *place, size_t size);
void *memmove(void *to, const void *from, size_t bytes);
static long copied;

void harness_copy(void *to, const void *from, int bytes)
{
    copied += bytes;
    __asan_unpoison_memory_region(&away, sizeof away);
    memmove(to, from, (size_t)bytes);
    __asan_poison_memory_region(&away, sizeof away);
}

static int network(const uint8_t *image, ${prefix}_detection_t *found, int most)
{
    copied = 0;
    __asan_unpoison_memory_region(&away, sizeof away);
    ${prefix}_init(STATE);
    __asan_poison_memory_region(&away, sizeof away);
    for (int row = 0; row < ${PREFIX}_HEIGHT; row++)
        ${prefix}_row(STATE, image + row * ${PREFIX}_ROW_BYTES);
    if (copied != ${PREFIX}_TRAFFIC_BYTES)
        __builtin_trap();
    return ${prefix}_detect(&net, found, most);
}
#else
static int network(const uint8_t *image, ${prefix}_detection_t *found, int most)
{
    return ${prefix}_run(STATE, image, found, most);
}
#endif

/* Runs one image; writes every head's grid to `grids` and the detections to `found`; returns their
 * number. */
int harness_run(const uint8_t *image, int8_t *grids, ${prefix}_detection_t *found, int most)
{
    const int count = network(image, found, most);
    for (int head = 0; head < ${PREFIX}_HEADS; head++)
        for (int row = 0; row < ${PREFIX}_ROWS; row++)
            for (int col = 0; col < ${PREFIX}_COLS; col++)
                *grids++ = ${prefix}_output(&net, head, row, col);
    return count;
}

#ifndef HARNESS_SHARED
#define MOST ${most}

#if defined(__riscv)
static long system_call(long number, long a, long b, long c)
{
    register long a0 __asm__("a0") = a, a1 __asm__("a1") = b, a2 __asm__("a2") = c;
    register long a7 __asm__("a7") = number;
    __asm__ volatile("ecall" : "+r"(a0) : "r"(a1), "r"(a2), "r"(a7) : "memory");
    return a0;
}
#define read(file, data, count) system_call(63, file, (long)(data), (long)(count))
#define write(file, data, count) system_call(64, file, (long)(data), (long)(count))
#else
#include <unistd.h>
#endif

static uint8_t image[${PREFIX}_IMAGE_BYTES];
static ${prefix}_detection_t found[MOST];
static int8_t grids[${PREFIX}_HEADS * ${PREFIX}_ROWS * ${PREFIX}_COLS];

static int take(void *data, size_t count)
{
    uint8_t *to = data;
    size_t there = 0;
    while (there < count) {
        const long more = read(0, to + there, count - there);
        if (more <= 0)
            return 0;
        there += (size_t)more;
    }
    return 1;
}

static void give(const void *data, size_t count)
{
    const char *from = data;
    while (count > 0) {
        const long done = write(1, from, count);
        if (done <= 0)
            return;
        from += done;
        count -= (size_t)done;
    }
}

#if defined(__riscv)
enum { PAINT = 0x5a, PAINTED = 16384 };

/* Measures the stack: fills it with a pattern, and later counts the bytes that have changed. */
static __attribute__((noinline)) void paint(void)
{
    volatile uint8_t space[PAINTED];
    for (int k = 0; k < PAINTED; k++)
        space[k] = PAINT;
}

static __attribute__((noinline)) int32_t unpainted(void)
{
    volatile uint8_t space[PAINTED];
    int32_t intact = 0;
    while (intact < PAINTED && space[intact] == PAINT)
        intact++;
    return PAINTED - intact;
}
#else
static void paint(void)
{
}

static int32_t unpainted(void)
{
    return 0;
}
#endif

#if defined(HARNESS_COUNT)
/* Runs only the network, to count its instructions. */
int main(void)
{
    while (take(image, sizeof image))
        network(image, found, MOST);
    return 0;
}
#else
int main(void)
{
    while (take(image, sizeof image)) {
        paint();
        const int32_t count = harness_run(image, grids, found, MOST);
        const int32_t stack = unpainted();
        give(grids, sizeof grids);
        give(&stack, sizeof stack);
        give(&count, sizeof count);
        give(found, (size_t)count * sizeof found[0]);
    }
    return 0;
}
#endif

#if defined(__riscv)
void _start(void)
{
    main();
    system_call(93, 0, 0, 0);
    for (;;)
        ;
}
#endif
#endif
