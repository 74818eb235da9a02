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

