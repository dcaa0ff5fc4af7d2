/* Differences on a line of whole numbers: what is nearly uniform noise, of a width that is known beforehand
 * (docs/format.md, "Differences").
 *
 * The width follows from the lattice's step and the value's exponent. So the bits that a difference takes are counted
 * down from the most that the exponent of the restored value allows, in contexts; the bits themselves and the sign are
 * stored as they are. If the place on the line has occurred before, its last difference predicts this one.
 */

#include "binary_coder.h"
#include "copying.h"

enum {
    DEEPEST = 15, /* of a count of bits, and of the count so far, that have contexts of their own */
    SPECIAL = 256,
    WHICH = SPECIAL + 4,
    SAME = WHICH + LODE_MOST_SPECIALS + 1,
    CLOSE = SAME + 1,
    BESIDE = CLOSE + 1,
    CONTEXTS = BESIDE + 16,
    NEAR = 8, /* a difference this close to the one remembered is coded as the distance from it */
};

_Static_assert(CONTEXTS == LODE_DIFFERENCES_MODEL, "the model holds all contexts");

/* Bits that do not fill a byte yet, before the byte `at` of those stored. */
struct store {
    uint64_t queue;
    int queued;
    int64_t at;
    uint8_t *bytes;
    int64_t size;
};

static int length_of(uint64_t magnitude) {
    return magnitude ? 64 - __builtin_clzll(magnitude) : 0;
}

static uint64_t magnitude_of(int64_t difference) {
    return difference < 0 ? 0 - (uint64_t)difference : (uint64_t)difference;
}

/* Put a number of at most 33 bits at the end of what is stored, lowest bit first, or take it from there. */
LODE_INLINE uint64_t store_bits(bool reads, struct store *store, uint64_t value, int bits) {
    if (reads) {
        for (; store->queued < bits; store->queued += 8, store->at++)
            if (store->at < store->size)
                store->queue |= (uint64_t)store->bytes[store->at] << store->queued;
        value = store->queue & ((UINT64_C(1) << bits) - 1);
        store->queue >>= bits;
        store->queued -= bits;
        return value;
    }
    store->queue |= value << store->queued;
    store->queued += bits;
    for (; store->queued >= 8; store->queued -= 8, store->at++, store->queue >>= 8)
        if (store->at < store->size)
            store->bytes[store->at] = (uint8_t)store->queue;
    return value;
}

/* Which of the specials a value is, from 1; 0: none. */
LODE_INLINE int code_special(bool reads, struct coder *coder, int mark, int specials, int *recent, int32_t *model) {
    int bit = code_bit(reads, coder, mark != 0, &model[SPECIAL + *recent]);
    *recent = (2 * *recent + bit) & 3;
    if (!bit)
        return 0;
    int found = 1;
    while (found < specials && code_bit(reads, coder, mark > found, &model[WHICH + found]))
        found++;
    return found;
}

/* Code a difference by the one that was remembered; whether that was enough. */
LODE_INLINE bool code_by_memory(bool reads, struct coder *coder, uint64_t *difference, uint64_t before,
                                int32_t *model) {
    if (code_bit(reads, coder, *difference == before, &model[SAME])) {
        *difference = before;
        return true;
    }
    uint64_t beside = *difference - before + NEAR;
    if (!code_bit(reads, coder, beside < 2 * NEAR, &model[CLOSE]))
        return false;
    uint32_t node = 1;
    for (int step = 3; step >= 0; step--)
        node = 2 * node + (uint32_t)code_bit(reads, coder, (int)(beside >> step & 1), &model[BESIDE + node]);
    *difference = before - NEAR + (node & 15);
    return true;
}

/* Code a difference by the count of its bits, and store them. */
LODE_INLINE uint64_t code_whole(bool reads, struct coder *coder, struct store *store, uint64_t difference, int limit,
                                int32_t *model) {
    uint64_t magnitude = magnitude_of((int64_t)difference);
    int length = reads ? 0 : length_of(magnitude);
    int32_t *shorter = &model[16 * (limit < DEEPEST ? limit : DEEPEST)];
    int count = limit;
    for (; count > 0; count--) {
        int deep = limit - count < DEEPEST ? limit - count : DEEPEST;
        if (!code_bit(reads, coder, length < count, &shorter[deep]))
            break;
    }
    if (count == 0)
        return 0;
    /* What follows the first bit is stored: up to 32 bits at a time, highest first, and the sign at the end. */
    uint64_t value = 1;
    int rest = count - 1;
    while (rest > 32) {
        rest -= 32;
        value = value << 32 | store_bits(reads, store, magnitude >> rest & WIDEST, 32);
    }
    uint64_t last = 2 * (magnitude & ((UINT64_C(1) << rest) - 1)) + (difference >> 63);
    last = store_bits(reads, store, last, rest + 1);
    value = value << rest | last >> 1;
    return last & 1 ? 0 - value : value;
}

LODE_INLINE void code_all(bool reads, struct coder *coder, struct store *store, const int64_t *line,
                          int64_t *differences, const int32_t *exponents, uint8_t *marks, int64_t values, int64_t most,
                          int specials, int32_t *model, int64_t *memory) {
    int recent = 0;
    for (int64_t i = 0; i < values; i++) {
        uint64_t difference = reads ? 0 : (uint64_t)differences[i];
        if (specials) {
            int mark = code_special(reads, coder, marks[i], specials, &recent, model);
            if (mark) {
                marks[i] = (uint8_t)mark;
                differences[i] = 0;
                continue;
            }
        }
        uint64_t hash = (uint64_t)line[i] * UINT64_C(0x9E3779B97F4A7C15) >> 40;
        int64_t *entry = &memory[3 * (hash & (LODE_DIFFERENCES_MEMORY - 1))]; /* filled, place, difference */
        bool known = entry[0] && entry[1] == line[i];
        if (!known || !code_by_memory(reads, coder, &difference, (uint64_t)entry[2], model)) {
            int64_t limit = most - exponents[i];
            limit = limit < 0 ? 0 : limit > 63 ? 63 : limit;
            difference = code_whole(reads, coder, store, difference, (int)limit, model);
        }
        differences[i] = (int64_t)difference;
        entry[0] = 1;
        entry[1] = line[i];
        entry[2] = (int64_t)difference;
    }
}

int64_t lode_differences(int64_t reads, const struct lode_differences *arguments) {
    const struct lode_differences call = *arguments;
    if (call.differences_count != call.line_count || call.exponents_count != call.line_count ||
        call.marks_count != call.line_count || call.most < 0 || call.most > 4095 || call.specials < 0 ||
        call.specials > LODE_MOST_SPECIALS || call.model_count != LODE_DIFFERENCES_MODEL ||
        call.memory_count != 3 * LODE_DIFFERENCES_MEMORY || call.used_count != 2)
        return LODE_REFUSED;
    for (int i = 0; i < LODE_DIFFERENCES_MODEL; i++)
        call.model[i] = LODE_NEW_CONTEXT;
    memset(call.memory, 0, (size_t)call.memory_count * sizeof *call.memory);
    struct coder coder = coder_start(reads, call.data, call.data_count);
    struct store store = {0, 0, 0, call.stored, call.stored_count};
    if (reads)
        code_all(true, &coder, &store, call.line, call.differences, call.exponents, call.marks, call.line_count,
                 call.most, (int)call.specials, call.model, call.memory);
    else
        code_all(false, &coder, &store, call.line, call.differences, call.exponents, call.marks, call.line_count,
                 call.most, (int)call.specials, call.model, call.memory);
    call.used[0] = coder.place;
    if (!reads) {
        if (store.queued)
            store_bits(false, &store, 0, 8 - store.queued);
        call.used[0] = coder_finish(&coder);
        if (call.used[0] < 0 || store.at > call.stored_count)
            return LODE_REFUSED;
    }
    call.used[1] = store.at;
    return 0;
}

int64_t lode_most_bits(const int64_t *differences, int64_t differences_count, const int32_t *exponents,
                       int64_t exponents_count, const uint8_t *marks, int64_t marks_count) {
    if (exponents_count != differences_count || marks_count != differences_count)
        return LODE_REFUSED;
    int64_t most = 0;
    for (int64_t i = 0; i < differences_count; i++) {
        if (marks[i] || !differences[i])
            continue;
        int64_t bits = length_of(magnitude_of(differences[i])) + (int64_t)exponents[i];
        most = bits > most ? bits : most;
    }
    return most;
}
