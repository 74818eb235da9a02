/* Output row r of a layer requires input rows up to r * stride + last. */
typedef struct {
    uint8_t source, other; /* both tensors of a sum; the same one twice otherwise */
    uint8_t reader;        /* the deepest layer that reads its output, or itself */
    int16_t stride, last, rows_in, rows_out;
} layer_t;

static const layer_t layers[$count] = {
$table};

static void compute($params, int layer, int row)
{
    switch (layer) {
$cases    }
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
static void advance($params)
{
    int layer = $count - 1;
    while (layer >= 0) {
        if (ready(net, layer)) {
            compute($args, layer, net->done[layer + 1]);
            net->done[layer + 1]++;
            layer = layers[layer].reader;
        } else {
            layer--;
        }
    }
}

void ${prefix}_init($params)
{
    fill((uint8_t *)net->done, 0, sizeof net->done);
#if ${PREFIX}_BAYER
    net->raw_rows = 0;
#endif
$pads}

