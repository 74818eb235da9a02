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
$store    }
}
#endif
