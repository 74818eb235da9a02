int8_t ${prefix}_output(const ${prefix}_t *net, int head, int row, int col)
{
    switch (head) {
$cases    default: return 0;
    }
}

int32_t ${prefix}_meaning(int head, int8_t value)
{
    switch (head) {
$meanings    default: return 0;
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

${doubles}static void detect_cell(const ${prefix}_t *net, int row, int col, ${prefix}_detection_t *found)
{
    const int8_t confidence = ${prefix}_output(net, ${PREFIX}_CONFIDENCE, row, col);
    const int8_t depth = ${prefix}_output(net, ${PREFIX}_DEPTH, row, col);
    found->u_q4 = $u;
    found->v_q4 = $v;
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
    return $count;
}

int ${prefix}_run($params, const uint8_t *image, ${prefix}_detection_t *found, int most)
{
    ${prefix}_init($args);
    for (int row = 0; row < ${PREFIX}_HEIGHT; row++)
        ${prefix}_row($args, image + row * ${PREFIX}_ROW_BYTES);
    return ${prefix}_detect(net, found, most);
}

