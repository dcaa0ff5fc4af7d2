/* Values that lie on one lattice stretch by stretch, each with an offset of its own, as some compressors leave them
 * (docs/format.md, "Offsets").
 *
 * Such values are float32(n step + offset) with a whole n, and the offset is that of a value before, more often than
 * not of the last one. What is known of an offset is an interval, and every value that has it narrows it. A list holds
 * the offsets met last, the latest first.
 */

#include "binary_coder.h"
#include "copying.h"

enum {
    LISTED = 64,
    NEAR = 4, /* an offset in the list gives a value to within so many places */
    MOST_BITS = 34,
    LARGEST = 0x7F7FFFFF, /* pattern of the largest float32 */
    /* Contexts: is it the first of the list, by how many in turn were; is it in the list; which; how far off; new. */
    REST = 16,
    WHICH = REST + 1,
    OFF = WHICH + LISTED,
    NEW = OFF + 2 * 8,
    CONTEXTS = NEW + 16 + MOST_BITS,
};

_Static_assert(CONTEXTS == LODE_OFFSETS_MODEL, "the model holds all contexts");

/* The offsets met last, each between `least` and `most`. */
struct list {
    double least[LISTED], most[LISTED];
    int count;
};

/* The place of the nearest float32; beyond the largest, and of what is no number, the largest's. */
static int64_t place_of(double value) {
    float single = (float)value;
    uint32_t bits;
    memcpy(&bits, &single, sizeof bits);
    int64_t pattern = bits & INT32_MAX;
    if (pattern > LARGEST)
        return LARGEST;
    return bits >> 31 ? ~pattern : pattern;
}

/* The float32 at a place; beyond the largest one, that with its sign. */
static double value_at(int64_t place) {
    int64_t pattern = place < 0 ? ~place : place;
    uint32_t bits = (uint32_t)(pattern < LARGEST ? pattern : LARGEST);
    float value;
    memcpy(&value, &bits, sizeof value);
    return place < 0 ? -(double)value : (double)value;
}

static int64_t sum_of(int64_t a, int64_t b) {
    return (int64_t)((uint64_t)a + (uint64_t)b);
}

static double middle_of(const struct list *list, int rank) {
    return 0.5 * (list->least[rank] + list->most[rank]);
}

/* The first offset of the list that gives a place to within `NEAR`, or the length of the list. */
static int rank_of(const struct list *list, double base, int64_t place) {
    for (int rank = 0; rank < list->count; rank++)
        if ((uint64_t)place - (uint64_t)place_of(base + middle_of(list, rank)) + NEAR < 2 * NEAR)
            return rank;
    return list->count;
}

/* A number of so many bits, the highest first, each in the context of those before. */
LODE_INLINE uint32_t code_number(bool reads, struct coder *coder, uint32_t number, int bits, int32_t *contexts) {
    uint32_t node = 1;
    for (int step = bits - 1; step >= 0; step--)
        node = 2 * node + (uint32_t)code_bit(reads, coder, (int)(number >> step & 1), &contexts[node]);
    return node - (UINT32_C(1) << bits);
}

LODE_INLINE int code_rank(bool reads, struct coder *coder, int rank, const struct list *list, int *recent,
                          int32_t *model) {
    if (list->count == 0)
        return 0;
    if (code_bit(reads, coder, rank == 0, &model[*recent])) {
        *recent = *recent < 15 ? *recent + 1 : 15;
        return 0;
    }
    *recent = 0;
    if (!code_bit(reads, coder, rank < list->count, &model[REST]))
        return list->count;
    rank = (int)code_number(reads, coder, (uint32_t)rank, 6, &model[WHICH]);
    return rank < list->count ? rank : list->count - 1;
}

/* A place by its difference from the restored one: four bits in the contexts of those before, then each in its own. */
LODE_INLINE int64_t code_new(bool reads, struct coder *coder, int64_t place, int64_t restored, int bits,
                             int32_t *model) {
    uint64_t half = bits ? UINT64_C(1) << (bits - 1) : 0;
    uint64_t number = (uint64_t)place - (uint64_t)restored + half, value = 0;
    uint32_t node = 1;
    for (int step = 0; step < bits; step++) {
        int bit = (int)(number >> (bits - 1 - step) & 1);
        bit = code_bit(reads, coder, bit, &model[NEW + (step < 4 ? node : (uint32_t)(12 + step))]);
        if (step < 4)
            node = 2 * node + (uint32_t)bit;
        value = 2 * value + (uint64_t)bit;
    }
    return (int64_t)((uint64_t)restored + value - half);
}

/* Narrow the interval of a rank by what gives a value, or begin a new one, and put it at the front. */
static void narrow(struct list *list, int rank, double base, int64_t place) {
    double near = value_at(place);
    double bottom = 0.5 * (near + value_at(sum_of(place, -1))) - base;
    double top = 0.5 * (near + value_at(sum_of(place, 1))) - base;
    if (rank < list->count) {
        bottom = bottom > list->least[rank] ? bottom : list->least[rank];
        top = top < list->most[rank] ? top : list->most[rank];
        if (bottom > top)
            bottom = top = near - base;
    } else {
        list->count = list->count < LISTED ? list->count + 1 : LISTED;
        rank = list->count - 1;
    }
    for (int k = rank; k > 0; k--) {
        list->least[k] = list->least[k - 1];
        list->most[k] = list->most[k - 1];
    }
    list->least[0] = bottom;
    list->most[0] = top;
}

LODE_INLINE void code_places(bool reads, struct coder *coder, const double *bases, const int64_t *restored, int bits,
                             int64_t *places, int64_t count, int32_t *model) {
    struct list list = {.count = 0};
    int recent = 0;
    for (int64_t i = 0; i < count; i++) {
        int rank = reads ? 0 : rank_of(&list, bases[i], places[i]);
        rank = code_rank(reads, coder, rank, &list, &recent, model);
        if (rank < list.count) {
            int64_t expected = place_of(bases[i] + middle_of(&list, rank));
            uint32_t number = reads ? 0 : (uint32_t)((uint64_t)places[i] - (uint64_t)expected + NEAR);
            number = code_number(reads, coder, number, 3, &model[OFF + (rank ? 8 : 0)]);
            places[i] = expected + (int64_t)number - NEAR;
        } else {
            places[i] = code_new(reads, coder, reads ? 0 : places[i], restored[i], bits, model);
        }
        narrow(&list, rank, bases[i], places[i]);
    }
}

int64_t lode_offsets(int64_t reads, const double *bases, int64_t bases_count, const int64_t *restored,
                     int64_t restored_count, int64_t bits, int64_t *places, int64_t places_count, int32_t *model,
                     int64_t model_count, uint8_t *data, int64_t data_count) {
    if (restored_count != bases_count || places_count != bases_count || bits < 0 || bits > MOST_BITS ||
        model_count != LODE_OFFSETS_MODEL)
        return LODE_REFUSED;
    for (int i = 0; i < LODE_OFFSETS_MODEL; i++)
        model[i] = LODE_NEW_CONTEXT;
    struct coder coder = coder_start(reads, data, data_count);
    if (reads)
        code_places(true, &coder, bases, restored, (int)bits, places, bases_count, model);
    else
        code_places(false, &coder, bases, restored, (int)bits, places, bases_count, model);
    return reads ? coder.place : coder_finish(&coder);
}
