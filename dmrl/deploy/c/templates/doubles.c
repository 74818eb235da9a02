/* Clips a position to the image, in 1/16 px. */
static int32_t within(int32_t place, int32_t side)
{
    return place < 0 ? 0 : smallest(place, side);
}

/* Returns whether two detections are less than $near / 16 px apart: one robot, detected in two
 * cells. */
static int same_robot(const ${prefix}_detection_t *a, const ${prefix}_detection_t *b)
{
    const int32_t du = a->u_q4 - b->u_q4, dv = a->v_q4 - b->v_q4;
    return -$near < du && du < $near && -$near < dv && dv < $near
           && du * du + dv * dv < $near * $near;
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

