/* Where the next row of the image goes, behind its padding. */
static uint8_t *next_row(${prefix}_t *net)
{
    return $place;
}

static void row_is_there(${prefix}_t *net)
{
    net->done[0]++;
    advance(net);
}

$bayer
int ${prefix}_row(${prefix}_t *net, const uint8_t *row)
{
    if (net->done[0] == ${PREFIX}_HEIGHT)
        return 1;
#if ${PREFIX}_BAYER
    const int newest = net->raw_rows++; /* an image row needs the mosaic row below it */
    copy(net->raw[newest % 3], row, ${PREFIX}_WIDTH);
    if (newest > 0) {
        demosaic(net, newest - 1, next_row(net));
        row_is_there(net);
    }
    if (newest == ${PREFIX}_HEIGHT - 1) {
        demosaic(net, newest, next_row(net));
        row_is_there(net);
    }
#else
    copy(next_row(net), row, ${PREFIX}_ROW_BYTES);
    row_is_there(net);
#endif
    return net->done[0] == ${PREFIX}_HEIGHT;
}

