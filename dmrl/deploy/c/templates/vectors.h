/* Vectors of the self-test in main.c: images and their expected output.
 *
 * Written by dmrl ${version} (`dmrl export`). */
#include "${prefix}.h"

#if ${PREFIX}_BAYER != ${bayer | int}
#error "these vectors were made with ${PREFIX}_BAYER ${bayer | int}"
#endif

typedef struct {
    const uint8_t *image; /* 0: noise, which the self-test makes itself */
    uint32_t checksum;    /* FNV-1a of the grids of all heads */
    int count;
    ${prefix}_detection_t found[${most}];
} vector_t;

/*% if picture is not none %*/
static const uint8_t picture[${picture.size}] = {
${picture | wrapped}
};
/*% endif %*/

static const vector_t vectors[] = {
/*% for vector in vectors %*/
    {${"0" if loop.first else "picture"}, ${vector.checksum}u, ${vector.found | length}, {
/*% for d in vector.found %*/
        {${d.u_q4}, ${d.v_q4}, ${d.depth_mm}, ${d.confidence}, 0},
/*% else %*/
        {0, 0, 0, 0, 0},
/*% endfor %*/
    }},
/*% endfor %*/
};
