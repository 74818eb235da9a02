/* Bytes of ${prefix}_far_t, and bytes copied per image: from it, into it, and from the tables. */
#define ${PREFIX}_FAR_BYTES ($far_bytes)
#define ${PREFIX}_TRAFFIC_BYTES ($traffic_bytes)

/* Long rings, for the far memory. No layer computes in it: the rows and tables that a layer reads
 * are copied into ${prefix}_t, and its output is copied back. With -D${PREFIX}_COPY=NAME, your
 * function `void NAME(void *to, const void *from, int bytes)` copies instead, such as one that
 * starts a DMA transfer and waits for it. */
typedef struct {
$members} ${prefix}_far_t;

