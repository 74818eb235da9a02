/* The last layer of $prefix.c, to be learned on: a step of gradient on one image after another.
 *
 * Written by dmrl $version (`dmrl export --refine`). Integers only, as in $prefix.c.
 *
 *   ${prefix}_head_init(&head);                       once: the weights as exported
 *   ${prefix}_run(&net, image, found, 4);             an image
 *   ${prefix}_head_apply(&head, &net);                its grids by the learned weights
 *   count = ${prefix}_detect(&net, found, 4);         what is found by them
 *   ${prefix}_head_learn(&head, &net, u_q4, v_q4, depth_mm, rate);   if it is known who is there
 */
#ifndef ${PREFIX}_REFINE_H
#define ${PREFIX}_REFINE_H

#include "$prefix.h"

#define ${PREFIX}_FEATURES $features
/* Bytes of ${prefix}_head_t. */
#define ${PREFIX}_HEAD_BYTES (4 * ${PREFIX}_HEADS * (${PREFIX}_FEATURES + 1))

typedef struct {
    int32_t weight[${PREFIX}_HEADS][${PREFIX}_FEATURES]; /* in 1/65536 of a step of an int8 weight */
    int32_t bias[${PREFIX}_HEADS];                  /* in steps of the sum */
} ${prefix}_head_t;

/* The weights as they were exported. */
void ${prefix}_head_init(${prefix}_head_t *head);

/* Makes the grids of the image that has run anew, by these weights. */
void ${prefix}_head_apply(const ${prefix}_head_t *head, ${prefix}_t *net);

/* One step of gradient on the image whose grids were made last: a robot's centre is at u_q4, v_q4
 * (1/16 px), within the image, at depth_mm; depth_mm 0: nobody is in view. `rate` is the learning
 * rate times 65536, 0 to 65536. */
void ${prefix}_head_learn(${prefix}_head_t *head, const ${prefix}_t *net, int32_t u_q4, int32_t v_q4,
                     int32_t depth_mm, int32_t rate);

#endif
