/* ${description}
 *
 * Written by dmrl ${version} (`dmrl export`). Do not edit: change the model and export again.
 *
 * The image is read row by row. Between two layers is a ring buffer of the newest rows, as many as
 * its readers need. After each image row, the deepest layer with all its input rows computes one
 * output row, until no layer can. A row consists of pixels, a pixel of adjacent channels. Every
 * value of an output row is rounded once (see `scaled`).
 *
 * C99 or C++11 on a machine with 8-bit bytes where >> of a negative number rounds down, as on every
 * compiler known to us. No library, no floating point, no heap, no recursion.
 */
#include "${prefix}.h"

#if defined(__GNUC__)
#define INLINE static inline __attribute__((always_inline))
#define APART static __attribute__((noinline))
#else
#define INLINE static inline
#define APART static
#endif

/* The sums of a block fill the registers of a 32-bit RISC-V, so no load may be moved ahead. For large
 * cores, the compiler's own schedule is better. */
#if defined(__GNUC__) && !defined(__clang__) && defined(__riscv)
#pragma GCC optimize("no-predictive-commoning", "no-schedule-insns", "no-tree-coalesce-vars", \
                     "no-tree-sink")
#define SMALL_CORE
#define IN_ORDER __asm__ volatile("" ::: "memory")
#define AS_IT_IS(value) __asm__ volatile("" : "+r"(value)) /* opaque to the optimiser */
#else
#define IN_ORDER ((void)0)
#define AS_IT_IS(value) ((void)0)
#endif

typedef char shifts_round_down[(-1 >> 1) == -1 ? 1 : -1];
typedef char state_is_as_stated[sizeof(${prefix}_t) == ${PREFIX}_STATE_BYTES ? 1 : -1];

/* Requantization of one output channel. Sums start at the bias, which includes the half step for
 * rounding and, if values are signed, an offset of 128 levels that keeps sums positive. */
typedef struct {
    int32_t bias, multiplier;
} scale_t;

INLINE int32_t smallest(int32_t a, int32_t b)
{
    return a < b ? a : b;
}

/*% if plan.pools %*/
INLINE int32_t largest(int32_t a, int32_t b)
{
    return a > b ? a : b;
}

/*% endif %*/
/* Clamps with few comparisons: half of a ReLU's inputs are negative, and few other values need
 * clamping. */
INLINE int32_t clamp(int32_t value, int32_t low, int32_t high)
{
    if (low == 0 && value < 0)
        return 0;
    if ((uint32_t)(value - low) > (uint32_t)(high - low))
        return value < low ? low : high;
    return value;
}

/* Scales a value of a shortcut to the sum. */
INLINE int32_t gained(int32_t gain, int32_t value)
{
    return (gain * value) >> ${gain_shift};
}

/* Requantizes a sum, whose offset is -`low`. `shift` is nearly always 32: the high word of the
 * product. */
INLINE uint8_t scaled(int32_t sum, int32_t multiplier, int shift, int32_t low, int32_t high)
{
    const int64_t value = (((int64_t)sum * multiplier) >> shift) + low;
    if (shift < 32)
        return (uint8_t)(value < low ? low : value > high ? high : value);
    int32_t clamped = clamp((int32_t)value, low, high);
    AS_IT_IS(clamped);
    return (uint8_t)clamped;
}

/* Requantizes a sum and stores it. Half of a ReLU's inputs are negative and need no multiplication,
 * and few values are too large. Large cores compute faster than they branch. */
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

/* volatile, since compilers would otherwise replace these two loops by memset and memcpy, which not
 * every target has. */
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
        to[0] = values[0];
        to[1] = values[1];
        to[2] = values[2];
        to[3] = values[3];
        to[4] = values[4];
        to[5] = values[5];
        to[6] = values[6];
        to[7] = values[7];
    }
    count %= 8;
    for (int i = 0; i < count; i++)
        to[i] = values[i];
}

/*% macro range_of(signed) %*/
${"-128, 127" if signed else "0, 255"}
/*%- endmacro %*/
/*% macro describe(layer) %*/
/*% if layer.kind == "conv" %*/
${"depthwise " if layer.depthwise else ""}${layer.kernel}x${layer.kernel} convolution${", stride %d" | format(layer.stride) if layer.stride > 1 else ""}${", dilation %d" | format(layer.dilation) if layer.dilation > 1 else ""}${" and shortcut" if layer.shortcut >= 0 else ""}${"" if layer.signed else ", ReLU"}
/*%- elif layer.kind == "add" %*/
sum${"" if layer.signed else ", ReLU"}
/*%- else %*/
2x2 max-pool
/*%- endif %*/
/*%- endmacro %*/
/*% macro table(type, name, values) %*/
static const ${type} ${name}[${values.size}] = {
${values | wrapped}
};
/*%- endmacro %*/
/*# The address of a table, brought into the near memory where there are two. #*/
/*% macro near_table(step, kind, type) %*/
/*% set at = placement.stage_buffers(step).get(kind) %*/
/*% if at %*/(const ${type} *)brought(at_stage(net, ${at.at}), ${step.name}_${kind}, ${at.size_bytes})/*% else %*/${step.name}_${kind}/*% endif %*/
/*%- endmacro %*/
/*# The address of a row of input `number`, behind `skipped` columns of its padding. #*/
/*% macro input_row(step, number, row, pointer, skipped) %*/
/*% set buffer = plan.buffers[step.sources[number]] %*/
/*% set at = placement.stage_buffers(step).get(number | string) %*/
/*% if at %*/(const uint8_t *)brought(at_stage(net, ${at.at} + ${pointer} * ${at.size_bytes}), row_of_${buffer.name}(${args}, ${row}), ${at.size_bytes})/*% else %*/row_of_${buffer.name}(${args}, ${row})/*% endif %*/ + ${skipped * buffer.channels}
/*%- endmacro %*/
/* Weights: of each output channel the kernel's rows, of each row the pixels, of each pixel
 * the channels; depthwise: pixels, then channels. */
/*% for step in plan.steps if step.layer.kind == "conv" %*/
${table("int8_t", step.name ~ "_weights", step.layer.weight.transpose(0, 2, 3, 1))}
static const scale_t ${step.name}_scales[${step.layer.bias.size}] = {
/*% for bias, multiplier in zip(step.layer.bias, step.layer.multiplier) %*/
    {${bias}, ${multiplier}},
/*% endfor %*/
};
/*% if step.layer.gain.size %*/
${table("int32_t", step.name ~ "_gains", step.layer.gain)}
/*% endif %*/

/*% endfor %*/
/*% for name, head in network.heads.items() %*/
${table("int16_t" if name.startswith("offset") else "uint16_t", name ~ "_table", head.table)}
/*% endfor %*/
/*% for kernel in kernels %*/
/*% with suffix = kernel.suffix[:2], suffixes = kernel.suffix, type = kernel.types[0], other = kernel.types[-1] %*/
/*% include "kernels/" ~ kernel.template ~ ".c" %*/

/*% endwith %*/
/*% endfor %*/
/*% for call in calls %*/
APART void convolution_${loop.index0}(const uint8_t *const *in, uint8_t *out, const int8_t *weights,
    const scale_t *scales${", const uint8_t *shortcut, const int32_t *gains" if call.shortcut else ""})
{
    ${call.kernel.template}_${call.kernel.suffix}(in, out, weights, scales,
/*% if call.shortcut %*/
        shortcut, gains, /* adds */ 1,
/*% elif call.kernel.template == "convolve" %*/
        0, 0, /* adds */ 0,
/*% endif %*/
        /* cols */ ${call.cols},/*% for name, number in call.shape %*/ /* ${name} */ ${number},/*% endfor +%*/
        /* range */ ${range_of(call.signed)}, /* shift */ ${call.shift});
}

/*% endfor %*/
/*% if placement.far %*/
typedef char far_state_is_as_stated[sizeof(${prefix}_far_t) == ${PREFIX}_FAR_BYTES ? 1 : -1];

#ifdef ${PREFIX}_COPY
#ifdef __cplusplus
extern "C"
#endif
void ${PREFIX}_COPY(void *to, const void *from, int bytes);
#else
#define ${PREFIX}_COPY(to, from, bytes) copy((uint8_t *)(to), (const uint8_t *)(from), bytes)
#endif

/* Returns an address in the scratch buffer. */
INLINE uint8_t *at_stage(${prefix}_t *net, int at)
{
    return (uint8_t *)net->stage + at;
}

INLINE const void *brought(void *to, const void *from, int bytes)
{
    ${PREFIX}_COPY(to, from, bytes);
    return to;
}

/*% elif plan.zero_bytes %*/
static const uint8_t zeros[${plan.zero_bytes}] = {0}; /* padding above and below */

/*% endif %*/
/* Addresses of rows, padding included: where a row is written, and where it, or the padding above or
 * below the tensor, is read. */
/*% for buffer in plan.buffers %*/
INLINE uint8_t *place_of_${buffer.name}(${params}, int row)
{
    ${unused} (void)row;
    return ${placement.member(buffer)} + (row + ${buffer.shift}) % ${buffer.ring} * ${buffer.row_bytes};
}

/*% if loop.index0 in plan.read %*/
INLINE const uint8_t *row_of_${buffer.name}(${params}, int row)
{
/*% if buffer.above %*/
    if (row < 0 || row >= ${buffer.rows})
        return ${"net->image_pad" if buffer.pad_value else "net->zeros" if placement.far else "zeros"};
/*% endif %*/
    return place_of_${buffer.name}(${args}, row);
}

/*% endif %*/
/*% endfor %*/
/*% for step in plan.steps %*/
/*% set layer = step.layer %*/
/*% set source = plan.buffers[step.sources[0]] %*/
/*% set out = plan.buffers[loop.index] %*/
/*% set kernel = kernel_of[loop.index0] %*/
/*% set call = call_of[loop.index0] %*/
/*% set reads = step.reads %*/
/*% set gap = out.gap * out.channels %*/
/*% set staged = placement.stage_buffers(step).get("out") %*/
/* ${step.name}: ${describe(layer)}${", 2x2 max-pool" if step.pooled else ""}, ${source.cols} x ${source.rows} x ${source.channels} -> ${out.cols} x ${out.rows} x ${out.channels}. */
APART void make_${step.name}(${params}, int row)
{
    ${unused} (void)row;
/*% if staged %*/
    uint8_t *const out = at_stage(net, ${staged.at});
/*% else %*/
    uint8_t *const out = place_of_${out.name}(${args}, row) + ${gap};
/*% endif %*/
/*% if layer.kind == "add" %*/
    const uint8_t *const in[2] = {${input_row(step, 0, "row", 0, source.gap)},
                                  ${input_row(step, 1, "row", 0, plan.buffers[step.sources[1]].gap)}};
    ${kernel.template}_${kernel.suffix}(in, out, /* values */ ${out.cols * out.channels}, ${layer.multipliers[0]},
        ${layer.multipliers[1]}, /* shift */ ${layer.shift}, /* range */ ${range_of(layer.signed)});
/*% else %*/
    const uint8_t *in[${reads.count}];
    for (int k = 0; k < ${reads.count}; k++) /* a row of the kernel, or one of its weights */
        in[k] = ${input_row(step, 0, "row * %d - %d + k %% %d / %d * %d + k / %d * %d" | format(step.stride, -step.first, reads.taps, reads.across, reads.dilation, reads.taps, reads.stride), "k", source.gap - reads.margin)}
                + k % ${reads.across} * ${reads.dilation * source.channels};
/*% if layer.kind == "max_pool" %*/
    ${kernel.template}_${kernel.suffix}(in, out, /* cols */ ${out.cols}, /* channels */ ${out.channels});
/*% else %*/
    convolution_${call}(in, out, ${near_table(step, "weights", "int8_t")},
        ${near_table(step, "scales", "scale_t")}${"," if layer.shortcut >= 0 else ");"}
/*% if layer.shortcut >= 0 %*/
        ${input_row(step, 1, "row", 0, plan.buffers[step.sources[1]].gap)},
        ${near_table(step, "gains", "int32_t")});
/*% endif %*/
/*% endif %*/
/*% endif %*/
/*% if staged %*/
    brought(place_of_${out.name}(${args}, row) + ${gap}, out, ${staged.size_bytes});
/*% endif %*/
}

/*% endfor %*/
/* Output row r of a layer requires input rows up to r * stride + last. */
typedef struct {
    uint8_t source, other; /* both tensors of a sum; the same one twice otherwise */
    uint8_t reader;        /* the deepest layer that reads its output, or itself */
    int16_t stride, last, rows_in, rows_out;
} layer_t;

static const layer_t layers[${plan.steps | length}] = {
/*% for step in plan.steps %*/
    {${step.sources[0]}, ${step.sources[-1]}, ${plan.deepest_reader(loop.index0)}, ${step.stride}, ${step.last}, ${plan.buffers[step.sources[0]].rows}, ${plan.buffers[loop.index].rows}}, /* ${step.name} */
/*% endfor %*/
};

static void compute(${params}, int layer, int row)
{
    switch (layer) {
/*% for step in plan.steps %*/
    case ${loop.index0}: make_${step.name}(${args}, row); break;
/*% endfor %*/
    }
}

static int ready(const ${prefix}_t *net, int index)
{
    const layer_t *layer = &layers[index];
    const int row = net->done[index + 1];
    const int needed = smallest(row * layer->stride + layer->last, layer->rows_in - 1);
    return row < layer->rows_out && net->done[layer->source] > needed
           && net->done[layer->other] > needed;
}

/* Computes every possible output row; of all ready layers, the deepest first. Deeper layers were not
 * ready before a row is computed; those that read the row may be ready after it. */
static void advance(${params})
{
    int layer = ${plan.steps | length} - 1;
    while (layer >= 0) {
        if (ready(net, layer)) {
            compute(${args}, layer, net->done[layer + 1]);
            net->done[layer + 1]++;
            layer = layers[layer].reader;
        } else {
            layer--;
        }
    }
}

void ${prefix}_init(${params})
{
    fill((uint8_t *)net->done, 0, sizeof net->done);
#if ${PREFIX}_BAYER
    net->raw_rows = 0;
#endif
    ${unused}
/*% for home, value in placement.padding().items() %*/
    fill(${home}, ${value}, sizeof ${home});
/*% endfor %*/
}

/* Returns the address of the next image row, behind its padding. */
static uint8_t *next_row(${params})
{
    return place_of_image(${args}, net->done[0]) + ${plan.buffers[0].gap * network.channels};
}

static void row_is_there(${params})
{
    net->done[0]++;
    advance(${args});
}

#if ${PREFIX}_BAYER
/* Demosaics image row `row` from the mosaic rows around it. A missing colour is the mean of the two
 * or four nearest neighbours that measured it, halves rounded up; the border is mirrored. */
static void demosaic(const ${prefix}_t *net, int row, uint8_t *out)
{
    const int width = ${PREFIX}_WIDTH, height = ${PREFIX}_HEIGHT;
    const uint8_t *here = net->raw[row % 3];
    const uint8_t *above = net->raw[(row ? row - 1 : 1) % 3];
    const uint8_t *below = net->raw[(row < height - 1 ? row + 1 : row - 1) % 3];
    const int red_row = row % 2 == ${PREFIX}_RED_ROW;
    for (int x = 0; x < width; x++) {
        const int left = x ? x - 1 : 1, right = x < width - 1 ? x + 1 : x - 1;
        const int across = (here[left] + here[right] + 1) >> 1;
        const int down = (above[x] + below[x] + 1) >> 1;
        int red, green, blue;
        if (red_row == (x % 2 == ${PREFIX}_RED_COL)) { /* a red or a blue pixel */
            const int own = here[x];
            const int far = (above[left] + above[right] + below[left] + below[right] + 2) >> 2;
            green = (here[left] + here[right] + above[x] + below[x] + 2) >> 2;
            red = red_row ? own : far;
            blue = red_row ? far : own;
        } else {
            green = here[x];
            red = red_row ? across : down;
            blue = red_row ? down : across;
        }
/*% if network.channels == 1 %*/
        out[x] = (uint8_t)((77 * red + 150 * green + 29 * blue + 128) >> 8);
/*% else %*/
        out[3 * x] = (uint8_t)red;
        out[3 * x + 1] = (uint8_t)green;
        out[3 * x + 2] = (uint8_t)blue;
/*% endif %*/
    }
}
#endif
int ${prefix}_row(${params}, const uint8_t *row)
{
    if (net->done[0] == ${PREFIX}_HEIGHT)
        return 1;
#if ${PREFIX}_BAYER
    const int newest = net->raw_rows++; /* an image row needs the mosaic row below it */
    copy(net->raw[newest % 3], row, ${PREFIX}_WIDTH);
    if (newest > 0) {
        demosaic(net, newest - 1, next_row(${args}));
        row_is_there(${args});
    }
    if (newest == ${PREFIX}_HEIGHT - 1) {
        demosaic(net, newest, next_row(${args}));
        row_is_there(${args});
    }
#else
    copy(next_row(${args}), row, ${PREFIX}_ROW_BYTES);
    row_is_there(${args});
#endif
    return net->done[0] == ${PREFIX}_HEIGHT;
}

int8_t ${prefix}_output(const ${prefix}_t *net, int head, int row, int col)
{
    switch (head) {
/*% for name, head in network.heads.items() %*/
/*% set grid = plan.buffers[plan.tensors[head.tensor]] %*/
    case ${PREFIX}_${name | upper}: return (int8_t)net->${grid.home}[row * ${grid.row_bytes} + col * ${grid.channels} + ${head.channel}];
/*% endfor %*/
    default: return 0;
    }
}

int32_t ${prefix}_meaning(int head, int8_t value)
{
    switch (head) {
/*% for name in network.heads %*/
    case ${PREFIX}_${name | upper}: return ${name}_table[value + 128];
/*% endfor %*/
    default: return 0;
    }
}

/* Returns the confidence of a cell, in steps; outside the grid, a value below all others. */
static int confidence_at(const ${prefix}_t *net, int row, int col)
{
    if (row < 0 || row >= ${PREFIX}_ROWS || col < 0 || col >= ${PREFIX}_COLS)
        return -129;
    return ${prefix}_output(net, ${PREFIX}_CONFIDENCE, row, col);
}

/* Returns whether a cell exceeds its neighbours before it in raster order, and none after it exceeds
 * the cell. */
static int is_peak(const ${prefix}_t *net, int row, int col, int confidence)
{
    for (int k = 0; k < 4; k++)
        if (confidence_at(net, row - 1 + k / 3, col - 1 + k % 3) >= confidence)
            return 0;
    for (int k = 5; k < 9; k++)
        if (confidence_at(net, row - 1 + k / 3, col - 1 + k % 3) > confidence)
            return 0;
    return 1;
}

/* Copies field by field: compilers may call memcpy for a whole structure. */
static void put(${prefix}_detection_t *to, const ${prefix}_detection_t *from)
{
    to->u_q4 = from->u_q4;
    to->v_q4 = from->v_q4;
    to->depth_mm = from->depth_mm;
    to->confidence = from->confidence;
    to->confidence_step = from->confidence_step;
}

/*% if network.offset_u %*/
/* Clips a position to the image, in 1/16 px. */
static int32_t within(int32_t place, int32_t side)
{
    return place < 0 ? 0 : smallest(place, side);
}

/* Returns whether two detections are less than ${near_q4} / 16 px apart: one robot, detected in two
 * cells. */
static int same_robot(const ${prefix}_detection_t *a, const ${prefix}_detection_t *b)
{
    const int32_t du = a->u_q4 - b->u_q4, dv = a->v_q4 - b->v_q4;
    return -${near_q4} < du && du < ${near_q4} && -${near_q4} < dv && dv < ${near_q4}
           && du * du + dv * dv < ${near_q4} * ${near_q4};
}

/* Drops every detection close to a more confident one; returns the number of kept ones. */
static int without_doubles(${prefix}_detection_t *found, int count)
{
    int kept = 0;
    for (int k = 0; k < count; k++) {
        int other = 0;
        while (other < kept && !same_robot(&found[k], &found[other]))
            other++;
        if (other == kept)
            put(&found[kept++], &found[k]);
    }
    return kept;
}

/*% endif %*/
static void detect_cell(const ${prefix}_t *net, int row, int col, ${prefix}_detection_t *found)
{
    const int8_t confidence = ${prefix}_output(net, ${PREFIX}_CONFIDENCE, row, col);
    const int8_t depth = ${prefix}_output(net, ${PREFIX}_DEPTH, row, col);
/*% if network.offset_u %*/
    const int8_t u = ${prefix}_output(net, ${PREFIX}_OFFSET_U, row, col);
    const int8_t v = ${prefix}_output(net, ${PREFIX}_OFFSET_V, row, col);
    found->u_q4 = within(col * ${cell_q4} + offset_u_table[u + 128], ${PREFIX}_COLS * ${cell_q4});
    found->v_q4 = within(row * ${cell_q4} + offset_v_table[v + 128], ${PREFIX}_ROWS * ${cell_q4});
/*% else %*/
    found->u_q4 = col * ${cell_q4} + ${cell_q4 // 2};
    found->v_q4 = row * ${cell_q4} + ${cell_q4 // 2};
/*% endif %*/
    found->depth_mm = depth_table[depth + 128];
    found->confidence = confidence_table[confidence + 128];
    found->confidence_step = confidence;
}

int ${prefix}_detect(const ${prefix}_t *net, ${prefix}_detection_t *found, int most)
{
    int count = 0;
    for (int row = 0; row < ${PREFIX}_ROWS; row++) {
        for (int col = 0; col < ${PREFIX}_COLS; col++) {
            const int confidence = confidence_at(net, row, col);
            if (confidence < ${PREFIX}_THRESHOLD_STEP || !is_peak(net, row, col, confidence))
                continue;
            if (count < most)
                count++;
            else if (most < 1 || found[most - 1].confidence_step >= confidence)
                continue;
            detect_cell(net, row, col, &found[count - 1]);
            /* Insertion sort: move it before all less confident ones. */
            for (int k = count - 1; k > 0 && found[k - 1].confidence_step < confidence; k--) {
                ${prefix}_detection_t weaker;
                put(&weaker, &found[k - 1]);
                put(&found[k - 1], &found[k]);
                put(&found[k], &weaker);
            }
        }
    }
    return ${"without_doubles(found, count)" if network.offset_u else "count"};
}

int ${prefix}_run(${params}, const uint8_t *image, ${prefix}_detection_t *found, int most)
{
    ${prefix}_init(${args});
    for (int row = 0; row < ${PREFIX}_HEIGHT; row++)
        ${prefix}_row(${args}, image + row * ${PREFIX}_ROW_BYTES);
    return ${prefix}_detect(net, found, most);
}

#if !${PREFIX}_BAYER
void ${prefix}_middle_row(const uint8_t *image, int row, uint8_t *out)
{
    const int32_t y = ${PREFIX}_HEIGHT - 1 + 4 * row, below = y % 6;
    const uint8_t *const line = image + y / 6 * ${PREFIX}_ROW_BYTES;
    for (int k = 0; k < ${PREFIX}_ROW_BYTES; k++) {
        const int32_t x = ${PREFIX}_WIDTH - 1 + 4 * (k / ${PREFIX}_CHANNELS), right = x % 6;
        const uint8_t *const a = line + x / 6 * ${PREFIX}_CHANNELS + k % ${PREFIX}_CHANNELS;
        const uint8_t *const b = a + ${PREFIX}_ROW_BYTES;
        const int32_t left_sum = (6 - below) * a[0] + below * b[0];
        const int32_t right_sum = (6 - below) * a[${PREFIX}_CHANNELS] + below * b[${PREFIX}_CHANNELS];
        out[k] = (uint8_t)(((6 - right) * left_sum + right * right_sum + 18) / 36);
    }
}

int ${prefix}_from_middle(${prefix}_detection_t *found, int count)
{
    int left = 0;
    for (int k = 0; k < count; k++) {
        const int32_t depth_mm = (3 * found[k].depth_mm + 1) / 2;
        if (depth_mm < 400)
            continue;
        found[left].confidence = found[k].confidence; /* a copy of the whole would call memcpy */
        found[left].confidence_step = found[k].confidence_step;
        found[left].u_q4 = (8 * ${PREFIX}_WIDTH + 2 * found[k].u_q4 + 1) / 3;
        found[left].v_q4 = (8 * ${PREFIX}_HEIGHT + 2 * found[k].v_q4 + 1) / 3;
        found[left].depth_mm = (uint16_t)smallest(depth_mm, UINT16_MAX);
        left++;
    }
    return left;
}
#endif
