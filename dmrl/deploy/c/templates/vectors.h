/* Vectors of the self-test in main.c: images and their expected output.
 *
 * Written by dmrl $version (`dmrl export`). */
#include "$prefix.h"

#if ${PREFIX}_BAYER != $bayer
#error "these vectors were made with ${PREFIX}_BAYER $bayer"
#endif

typedef struct {
    const uint8_t *image; /* 0: noise, which the self-test makes itself */
    uint32_t checksum;    /* FNV-1a of the grids of all heads */
    int count;
    ${prefix}_detection_t found[$most];
} vector_t;

$pictures
static const vector_t vectors[] = {
$rows};
