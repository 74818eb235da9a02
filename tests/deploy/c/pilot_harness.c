/* Runs the pilot on a computer or under qemu, with steps on standard input and output.
 *
 * First reads the distance to keep, a double. A step consists of the doubles time, roll, pitch, yaw
 * rate, vx, vy and height, the int32 size of a camera packet (0: no packet), and the packet. The
 * answer to a step is four doubles. */
#include "pilot.h"

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

void *memcpy(void *to, const void *from, unsigned long count)
{
    volatile char *t = to;
    const char *f = from;
    while (count--)
        *t++ = *f++;
    return to;
}

void *memset(void *to, int value, unsigned long count)
{
    volatile char *t = to;
    while (count--)
        *t++ = (char)value;
    return to;
}
#else
#include <unistd.h>
#endif

static int take(void *data, int size)
{
    char *at = data;
    while (size > 0) {
        const int got = (int)read(0, at, (unsigned long)size);
        if (got <= 0)
            return 0;
        at += got;
        size -= got;
    }
    return 1;
}

static pilot_t pilot;
static pilot_detection_t found[PILOT_DETECTIONS_MAX];
static uint8_t packet[PILOT_PACKET_MAX];

int main(void)
{
    double distance, image_s = -1.0;
    pilot_state_t state;
    pilot_command_t command;
    int32_t size;
    uint32_t time_ms;
    int count = 0;
    if (!take(&distance, sizeof distance))
        return 1;
    pilot_start(&pilot, distance);
    while (take(&state, sizeof state) && take(&size, sizeof size)) {
        if (size < 0 || size > PILOT_PACKET_MAX || !take(packet, size))
            return 1;
        if (size > 0) {
            const int got = pilot_unpack(packet, size, &time_ms, found);
            if (got >= 0) {
                count = got;
                image_s = time_ms / 1000.0;
            }
        }
        pilot_step(&pilot, &state, image_s, found, count, &command);
        if (write(1, &command, sizeof command) != (long)sizeof command)
            return 1;
    }
    return 0;
}

#if defined(__riscv)
void _start(void)
{
    main();
    system_call(93, 0, 0, 0);
    for (;;)
        ;
}
#endif
