/*% macro describe(name) %*/
/*% set held = plan.buffers | selectattr("home", "equalto", name) | list %*/
/*% set one = held[0] %*/
/*% if held | length > 1 %*/
${"%d rows of %d layers, sharing one ring" | format(one.ring, held | length) if one.ring > 1 else "rows of %d layers, each read immediately by the next" | format(held | length)}
/*%- else %*/
${"%d of %d rows" | format(one.ring, one.rows) if one.ring < one.rows else "whole"}: ${one.cols} pixels${" and %d of padding" | format(one.gap) if one.gap else ""} x ${one.channels} ${"int8" if one.signed else "uint8"}
/*%- endif %*/
/*%- endmacro %*/
/* ${description}
 *
 * Written by dmrl ${version} (`dmrl export`).
 *
 *   state      ${state_bytes} bytes of RAM (${PREFIX}_STATE_BYTES), yours: static ${prefix}_t net;
 *   stack      at most ${stack_bytes} bytes (${PREFIX}_STACK_BYTES), in optimised builds
 *   constants  ${constant_bytes} bytes of weights and tables
 *   work       ${network.macs} multiply-accumulates per image
 *
 * No library, no floating point, no heap, no recursion, no global variables: two states may run
 * concurrently. Integers only; every machine and compiler gives the same result.
 */
#ifndef ${PREFIX}_H
#define ${PREFIX}_H

#include <stddef.h>
#include <stdint.h>

#ifdef __cplusplus
extern "C" {
#endif

#define ${PREFIX}_WIDTH ${network.width_px}
#define ${PREFIX}_HEIGHT ${network.height_px}
#define ${PREFIX}_CHANNELS ${network.channels} /* 3: red, green, blue; 1: grey */
#define ${PREFIX}_COLS ${network.grid_shape[1]} /* cells of ${PREFIX}_STRIDE x ${PREFIX}_STRIDE pixels */
#define ${PREFIX}_ROWS ${network.grid_shape[0]}
#define ${PREFIX}_STRIDE ${network.stride_px}

/* 1: images are raw Bayer mosaics, one byte per pixel, with red pixels in the rows and columns whose
 * index modulo 2 is RED_ROW and RED_COL (both 0: RGGB, as on the AI-deck).
 * 0: images have the network's format, ${PREFIX}_CHANNELS bytes per pixel. */
#ifndef ${PREFIX}_BAYER
#define ${PREFIX}_BAYER ${bayer | int}
#endif
#ifndef ${PREFIX}_RED_ROW
#define ${PREFIX}_RED_ROW 0
#endif
#ifndef ${PREFIX}_RED_COL
#define ${PREFIX}_RED_COL 0
#endif
#define ${PREFIX}_ROW_BYTES (${PREFIX}_WIDTH * (${PREFIX}_BAYER ? 1 : ${PREFIX}_CHANNELS))
#define ${PREFIX}_IMAGE_BYTES (${PREFIX}_HEIGHT * ${PREFIX}_ROW_BYTES)

/* Confidence threshold of detections, in steps of the network's output: ${"%g" | format(network.threshold)}.
 * ${PREFIX}_THRESHOLD_STEP 128 reports none, -128 every peak. */
#ifndef ${PREFIX}_THRESHOLD_STEP
#define ${PREFIX}_THRESHOLD_STEP (${network.threshold_q})
#endif

#define ${PREFIX}_STATE_BYTES (${state_bytes} + (${PREFIX}_BAYER ? ${bayer_bytes} : 0))
#define ${PREFIX}_STACK_BYTES ${stack_bytes}

/* Outputs of the network in every cell. */
enum {
/*% for name in network.heads %*/
    ${PREFIX}_${name | upper},
/*% endfor %*/
    ${PREFIX}_HEADS
};

typedef struct {
    int32_t u_q4, v_q4;      /* 1/16 px from the image's left and top edge */
    uint16_t depth_mm;       /* along the optical axis */
    uint16_t confidence;     /* 65535 is 1 */
    int8_t confidence_step;  /* the same in steps of the network's output; used for comparisons */
} ${prefix}_detection_t;

/*% if placement.far %*/
/* Bytes of ${prefix}_far_t, and bytes copied per image: from it, into it, and from the tables. */
#define ${PREFIX}_FAR_BYTES (${placement.far_bytes})
#define ${PREFIX}_TRAFFIC_BYTES (${placement.traffic_bytes})

/* Long rings, for the far memory. No layer computes in it: the rows and tables that a layer reads
 * are copied into ${prefix}_t, and its output is copied back. With -D${PREFIX}_COPY=NAME, your
 * function `void NAME(void *to, const void *from, int bytes)` copies instead, such as one that
 * starts a DMA transfer and waits for it. */
typedef struct {
/*% for name, size in placement.members(far=true).items() %*/
    uint8_t ${name}[${size}]; /* ${describe(name)} */
/*% endfor %*/
} ${prefix}_far_t;

/*% endif %*/
/* Ring buffers between the layers. You allocate it; do not access its members. */
typedef struct {
/*% if placement.far %*/
    int32_t stage[${placement.stage_bytes // 4}]; /* tables and far rows of the current layer */
/*% endif %*/
    int16_t done[${plan.buffers | length}]; /* rows of each tensor computed so far */
#if ${PREFIX}_BAYER
    int16_t raw_rows;
    uint8_t raw[3][${PREFIX}_WIDTH];
#endif
/*% for name, size in placement.members(far=false).items() %*/
    uint8_t ${name}[${size}]; /* ${describe(name)} */
/*% endfor %*/
/*% if placement.far and plan.zero_bytes %*/
    uint8_t zeros[${plan.zero_bytes}]; /* padding above and below */
/*% endif %*/
/*% if plan.pad_bytes %*/
    uint8_t image_pad[${plan.pad_bytes}];
/*% endif %*/
} ${prefix}_t;

/* Prepares the state for an image. Call it before the first row of every image. */
void ${prefix}_init(${params});

/* Reads the next row, ${PREFIX}_ROW_BYTES bytes, and computes all output rows that it completes.
 * `row` may be overwritten afterwards. Returns 1 after the last row; further rows are ignored. */
int ${prefix}_row(${params}, const uint8_t *row);

/* After the last row: writes at most `most` detections, best first; returns their number. */
int ${prefix}_detect(const ${prefix}_t *net, ${prefix}_detection_t *found, int most);

/* After the last row: returns the network's output in a cell, in steps. */
int8_t ${prefix}_output(const ${prefix}_t *net, int head, int row, int col);

/* Converts an output to units: confidence (65535 is 1), millimetres, or 1/16 px from the cell's left
 * or top edge. */
int32_t ${prefix}_meaning(int head, int8_t value);

/* Runs init, all rows and detect on an image of ${PREFIX}_IMAGE_BYTES bytes, from the top left. */
int ${prefix}_run(${params}, const uint8_t *image, ${prefix}_detection_t *found, int most);

#if !${PREFIX}_BAYER
/* Writes a row of the middle of an image, 3/2 times as large: ${PREFIX}_ROW_BYTES bytes. The network
 * detects robots in it that are too small in the whole image. The pilots of `dmrl fly` use it for
 * every second image. */
void ${prefix}_middle_row(const uint8_t *image, int row, uint8_t *out);

/* Maps detections in such a middle to the image, and leaves out those nearer than 0.4 m, which are
 * mostly false there. Returns how many are left. */
int ${prefix}_from_middle(${prefix}_detection_t *found, int count);
#endif

#ifdef __cplusplus
}
#endif

#endif
