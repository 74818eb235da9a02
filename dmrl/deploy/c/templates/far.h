/* Bytes of ${prefix}_far_t, and bytes that an image copies from it, into it, and of the tables. */
#define ${PREFIX}_FAR_BYTES ($far_bytes)
#define ${PREFIX}_TRAFFIC_BYTES ($traffic_bytes)

/* Rings of long reach, for the large memory. No layer works on it: what it needs of it, and of the
 * tables, is copied into ${prefix}_t, and what it made is copied back. With
 * -D${PREFIX}_COPY=NAME your own `void NAME(void *to, const void *from, int bytes)` copies, such as
 * one that asks a DMA and waits. */
typedef struct {
$members} ${prefix}_far_t;

