/* On-device refinement of the last layer of $prefix.c, by one gradient step per image.
 *
 * Written by dmrl $version (`dmrl export --refine`). Integers only, as in $prefix.c.
 *
 *   ${prefix}_head_init(&head);                       once: the weights as exported
 *   ${prefix}_run(&net, image, found, 4);             run an image
 *   ${prefix}_head_apply(&head, &net);                compute its grids with the refined weights
 *   count = ${prefix}_detect(&net, found, 4);         detect with them
 *   ${prefix}_head_learn(&head, &net, u_q4, v_q4, depth_mm, rate);   if its label is known
 */
#ifndef ${PREFIX}_REFINE_H
#define ${PREFIX}_REFINE_H

#include "$prefix.h"

#ifdef __cplusplus
extern "C" {
#endif

#define ${PREFIX}_FEATURES $features
/* Bytes of ${prefix}_head_t. */
#define ${PREFIX}_HEAD_BYTES (4 * ${PREFIX}_HEADS * (${PREFIX}_FEATURES + 1))

typedef struct {
    int32_t weight[${PREFIX}_HEADS][${PREFIX}_FEATURES]; /* in 1/65536 of a step of an int8 weight */
    int32_t bias[${PREFIX}_HEADS];                  /* in steps of the sum */
} ${prefix}_head_t;

/* Sets the weights as exported. */
void ${prefix}_head_init(${prefix}_head_t *head);

/* Computes the grids of the last image again, with these weights. */
void ${prefix}_head_apply(const ${prefix}_head_t *head, ${prefix}_t *net);

/* Takes one gradient step on the image whose grids were computed last. The robot's centre is at u_q4,
 * v_q4 (1/16 px), inside the image, at depth_mm; depth_mm 0: no robot in view. `rate` is the learning
 * rate times 65536, 0 to 65536. */
void ${prefix}_head_learn(${prefix}_head_t *head, const ${prefix}_t *net, int32_t u_q4, int32_t v_q4,
                     int32_t depth_mm, int32_t rate);

#ifdef __cplusplus
}
#endif

#endif
