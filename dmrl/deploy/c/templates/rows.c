/* Returns the address of the next image row, behind its padding. */
static uint8_t *next_row(${prefix}_t *net)
{
    return $place;
}

static void row_is_there($params)
{
    net->done[0]++;
    advance($args);
}

$bayer
int ${prefix}_row($params, const uint8_t *row)
{
    if (net->done[0] == ${PREFIX}_HEIGHT)
        return 1;
#if ${PREFIX}_BAYER
    const int newest = net->raw_rows++; /* an image row needs the mosaic row below it */
    copy(net->raw[newest % 3], row, ${PREFIX}_WIDTH);
    if (newest > 0) {
        demosaic(net, newest - 1, next_row(net));
        row_is_there($args);
    }
    if (newest == ${PREFIX}_HEIGHT - 1) {
        demosaic(net, newest, next_row(net));
        row_is_there($args);
    }
#else
    copy(next_row(net), row, ${PREFIX}_ROW_BYTES);
    row_is_there($args);
#endif
    return net->done[0] == ${PREFIX}_HEIGHT;
}

