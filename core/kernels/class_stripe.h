/* A stripe of a large unit in one pass (docs/format.md, "Large units").
 *
 * What codes a coefficient follows from the planes above and from the parents, so all decisions of a stripe and their
 * contexts are listed before the first is read; their probabilities change when the stripe is done.
 *
 * Each function with `reads` is compiled for reading and for writing.
 */
#ifndef LODE_CLASS_STRIPE_H
#define LODE_CLASS_STRIPE_H

#include "block_coder.h"
#include "class_map.h"
#include "class_tables.h"
#include "inlining.h"
#include "rans.h"

/* The contexts of a large unit: significance, refinement, signs, flags. */
enum {
    CLASS_REFINEMENT = CLASSES,
    CLASS_SIGNS = CLASS_REFINEMENT + 1,
    CLASS_FLAGS = CLASS_SIGNS + 15,
    CLASS_CONTEXTS = CLASS_FLAGS + 27,
    KEPT_MAPS = 32, /* of the first stripes; the last one is that of all others */
};

_Static_assert((int)CLASS_CONTEXTS <= (int)MOST_CONTEXTS &&
                   CLASS_CONTEXTS == sizeof CLASS_STARTS / sizeof *CLASS_STARTS,
               "each context has a place and begins somewhere");
_Static_assert((int)STRIPE_SIZE <= (int)MOST_IN_RUN, "the decisions of a stripe are one run, the signs another");

/* All ones in the first bytes: from the place 8 - n on, in n of eight. And a 1 in every other byte. */
static const uint8_t WITHIN[2 * BLOCK] = {255, 255, 255, 255, 255, 255, 255, 255};
static const uint8_t EVEN[BLOCK + 1] = {1, 0, 1, 0, 1, 0, 1, 0, 1};

typedef uint16_t places_t __attribute__((vector_size(16)));
typedef uint32_t units_of_four_t __attribute__((vector_size(16)));

/* A unit while it is read, or written: then its decisions are kept.
 *
 * What the first pass of a plane has seen of the first stripes of all bands is not looked at again in the second.
 */
struct unit {
    const struct tiles *tiles;
    struct contexts contexts;
    struct rans rans;
    symbol_t *symbols; /* where the next one will stand */
    uint32_t seen;     /* a bit for each map that holds what this plane's first pass has seen */
    struct class_map maps[KEPT_MAPS];
};

/* Code decisions in turn: of each the context and the bit stand at its place. */
LODE_INLINE void code_decisions(bool reads, struct unit *unit, const uint16_t *places, int many, const uint8_t *context,
                                uint8_t *bits) {
    if (reads)
        read_run(&unit->rans, &unit->contexts, places, many, context, bits);
    else
        unit->symbols = keep_run(unit->symbols, &unit->contexts, places, many, context, bits);
}

/* Adapt contexts that have coded decisions, from number `first` to the one before `last`. */
static inline void adapt_all(struct contexts *contexts, int first, int last) {
    for (int k = first; k < last; k++)
        if (contexts->counted[k])
            adapt(contexts, k);
}

/* Code whether a block that has no significant coefficient so far gets one in this plane. */
LODE_INLINE uint8_t code_class_flag(bool reads, struct unit *unit, const struct band *band, const struct block *block,
                                    const uint8_t *flag, int plane) {
    uint32_t family = parents_in(unit->tiles, band, block) >> plane;
    int before = (flag[-1] != 0) + (flag[-band->across - 1] != 0);
    int after = (flag[1] != 0) + (flag[band->across + 1] != 0);
    uint8_t context = (uint8_t)(CLASS_FLAGS + (before * 3 + after) * 3 + (int)(family < 2 ? family : 2));
    uint8_t bit = (uint8_t)(!reads && truth_in(unit->tiles, band, block) >> plane != 0);
    uint16_t place = 0;
    code_decisions(reads, unit, &place, 1, &context, &bit);
    return bit;
}

/* Of each column of a stripe whether its block is significant, and whether it became so in this pass: 255, else 0. */
struct columns {
    uint8_t possible[STRIPE_COLUMNS], fresh[STRIPE_COLUMNS];
    bool any_fresh;
};

/* Look at the blocks of a stripe, whose flags a second pass codes; whether any is significant. */
LODE_INLINE bool code_flags(bool reads, bool first_pass, struct unit *unit, const struct band *band,
                            const struct stripe *stripe, int plane, struct columns *columns) {
    int64_t row = stripe->top / BLOCK;
    uint8_t *flags = unit->tiles->flags + band->flags + row * (band->across + 1) + stripe->left / BLOCK;
    bool any = false;
    memset(columns, 0, sizeof *columns);
    for (int number = 0; number * BLOCK < stripe->columns; number++) {
        uint8_t *flag = flags + number;
        int left = number * BLOCK, rest = stripe->columns - left, wide = rest < BLOCK ? rest : BLOCK;
        if (!*flag && !first_pass) {
            struct block block = {stripe->top, stripe->left + left, stripe->rows, wide, 0};
            *flag = code_class_flag(reads, unit, band, &block, flag, plane);
            if (*flag) {
                memset(columns->fresh + left, 255, BLOCK);
                columns->any_fresh = true;
            }
        }
        if (*flag) {
            memset(columns->possible + left, 255, (size_t)wide);
            any = true;
        }
    }
    return any;
}

/* In the k-th of four numbers a 1 in the byte that comes k-th in memory. */
LODE_INLINE units_of_four_t one_in_each(void) {
    static const uint8_t bytes[16] = {1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1};
    units_of_four_t ones;
    memcpy(&ones, bytes, sizeof ones);
    return ones;
}

/* Add bits of a plane, 0 or 1 a byte, to what is known of eight coefficients. */
LODE_INLINE void add_bits(uint32_t *known, eight_t ones, int plane) {
    uint32_t halves[2], bit = UINT32_C(1) << plane;
    units_of_four_t each = one_in_each(), now[2];
    memcpy(halves, &ones, sizeof halves);
    memcpy(now, known, sizeof now);
    for (int k = 0; k < 2; k++) {
        units_of_four_t bits = {halves[k], halves[k], halves[k], halves[k]};
        now[k] += (units_of_four_t)((bits & each) != 0) & bit;
    }
    memcpy(known, now, sizeof now);
}

/* List the places of the 1s among eight bytes of 0 and 1 behind `many` others; how many there are then. Seven more
 * places of the list are overwritten. */
LODE_INLINE int list_places(eight_t ones, int first, uint16_t *places, int many) {
    uint32_t bits = bits_of(ones);
    places_t eight;
    memcpy(&eight, SET_BITS[bits], sizeof eight);
    eight += (uint16_t)first;
    memcpy(places + many, &eight, sizeof eight);
    return many + __builtin_popcount(bits);
}

/* List what a pass visits, in raster order; how many these are. */
LODE_INLINE int list_visited(bool first_pass, const struct class_map *map, const struct stripe *stripe,
                             const struct columns *columns, uint16_t *places) {
    int many = 0;
    for (int i = 0; i < stripe->rows; i++)
        for (int j = 0; j < stripe->columns; j += 2 * BLOCK) {
            bytes_t weight = bytes_at(map->weights[i + MARGIN] + MARGIN + j), context = bytes_at(map->context[i] + j);
            bytes_t zero = (bytes_t)(weight == 0), near = (bytes_t)(context >= DISTANT), visited = zero & near;
            if (!first_pass)
                visited = (zero & (~near | bytes_at(columns->fresh + j))) | (bytes_t)(weight == 2);
            visited &= bytes_at(columns->possible + j) & 1;
            uint8_t ones[2 * BLOCK];
            memcpy(ones, &visited, sizeof ones);
            many = list_places(eight_at(ones), i * STRIPE_COLUMNS + j, places, many);
            many = list_places(eight_at(ones + BLOCK), i * STRIPE_COLUMNS + j + BLOCK, places, many);
        }
    return many;
}

/* The context of a sign by those of its neighbours, and whether the opposite case shares it. */
LODE_INLINE int sign_context(const struct band *band, const int8_t *sign, int *flip) {
    int x = clamped(sign[-1] + sign[1], -1, 1), y = clamped(sign[-band->stride] + sign[band->stride], -1, 1);
    int sum = band->kind == 2 ? 3 * y + x : 3 * x + y;
    *flip = sum < 0;
    return CLASS_SIGNS + 3 * (sum < 0 ? -sum : sum) + (band->kind > 1 ? band->kind - 1 : 0);
}

/* Code the signs of coefficients found in a stripe, those at even or at odd places. */
LODE_INLINE void code_signs(bool reads, struct unit *unit, const struct band *band, const struct stripe *stripe,
                            const uint16_t *places, int many) {
    const struct tiles *tiles = unit->tiles;
    struct run run;
    run.rans = &unit->rans;
    if (reads)
        begin_run(&run, many);
    for (int i = 0; i < many; i++) {
        int64_t at = stripe->first + places[i] / STRIPE_COLUMNS * band->stride + places[i] % STRIPE_COLUMNS;
        int flip, context = sign_context(band, tiles->sign + at, &flip);
        int bit = reads ? next_bit(&run, unit->contexts.coded[context]) : (tiles->truth[at] < 0) ^ flip;
        if (!reads)
            *unit->symbols++ = symbol_of(&unit->contexts, context, bit);
        count(&unit->contexts, context, bit);
        tiles->sign[at] = (int8_t)(1 - 2 * (bit ^ flip));
    }
    if (reads)
        end_run(&run);
}

/* Places of a list, and room for what the last step of listing overwrites. */
typedef uint16_t list_t[STRIPE_SIZE + BLOCK];

/* Take bits of a plane, 0 or 1 for each coefficient of the stripe, into what is known, and list what they find: at
 * places whose row and column have an even sum, and at the others. */
LODE_INLINE void take_bits(bool reads, bool first_pass, const struct tiles *tiles, const struct band *band,
                           const struct stripe *stripe, int plane, const struct class_map *map, const uint8_t *bits,
                           list_t found[2], int counts[2]) {
    uint64_t mark = (uint64_t)(plane + 1 + (first_pass ? 0 : FOUND_SECOND));
    counts[0] = counts[1] = 0;
    for (int i = 0; i < stripe->rows; i++)
        for (int j = 0; j < stripe->columns; j += BLOCK) {
            int place = i * STRIPE_COLUMNS + j;
            eight_t ones = eight_at(bits + place);
            if (!ones)
                continue;
            int64_t at = stripe->first + i * band->stride + j;
            if (reads)
                add_bits(tiles->known + at, ones, plane);
            eight_t new = ones & ~reaching(eight_at(map->weights[i + MARGIN] + MARGIN + j), 1);
            if (!new)
                continue;
            put_eight(tiles->early + at, (eight_at(tiles->early + at) & ~(255 * new)) + mark * new);
            eight_t even = eight_at(EVEN + (i & 1));
            counts[0] = list_places(new &even, place, found[0], counts[0]);
            counts[1] = list_places(new & ~even, place, found[1], counts[1]);
        }
}

/* The bits of a stripe that is written, all of whose magnitudes are known. */
static void stripe_bits(const struct tiles *tiles, const struct band *band, const struct stripe *stripe, int plane,
                        const uint16_t *places, int many, uint8_t *bits) {
    for (int i = 0; i < many; i++) {
        int64_t at = stripe->first + places[i] / STRIPE_COLUMNS * band->stride + places[i] % STRIPE_COLUMNS;
        bits[places[i]] = (uint8_t)(tiles->known[at] >> plane & 1);
    }
}

/* What is known of a stripe, by its number in the pass. */
LODE_INLINE const struct class_map *map_of(bool first_pass, struct unit *unit, const struct band *band,
                                           const struct stripe *stripe, int64_t number, int plane,
                                           const struct columns *columns) {
    uint32_t kept = number < KEPT_MAPS - 1 ? UINT32_C(1) << number : 0;
    struct class_map *map = &unit->maps[kept ? number : KEPT_MAPS - 1];
    if (!first_pass && !columns->any_fresh && unit->seen & kept)
        return map;
    const uint32_t *parents = unit->tiles->known + band->parent +
                              (stripe->top >> band->row_shift) * band->parent_stride +
                              (stripe->left >> band->column_shift);
    see_stripe(unit->tiles->early + stripe->first, band->stride, stripe, parents, band->parent_stride, band->row_shift,
               band->column_shift, plane, columns->possible, map);
    unit->seen |= kept;
    return map;
}

/* Code the bits of a stripe some of whose blocks are significant, and their signs. */
LODE_INLINE void code_bits(bool reads, bool first_pass, struct unit *unit, const struct band *band,
                           const struct stripe *stripe, int64_t number, int plane, const struct columns *columns) {
    const struct tiles *tiles = unit->tiles;
    const struct class_map *map = map_of(first_pass, unit, band, stripe, number, plane, columns);
    list_t visited, found[2];
    int counts[2], many = list_visited(first_pass, map, stripe, columns, visited);
    if (many == 0)
        return;
    uint8_t bits[STRIPE_SIZE] = {0};
    if (!reads)
        stripe_bits(tiles, band, stripe, plane, visited, many, bits);
    code_decisions(reads, unit, visited, many, map->context[0], bits);
    adapt_all(&unit->contexts, 0, CLASS_SIGNS);
    take_bits(reads, first_pass, tiles, band, stripe, plane, map, bits, found, counts);
    if (counts[0] + counts[1] == 0)
        return;
    code_signs(reads, unit, band, stripe, found[0], counts[0]);
    code_signs(reads, unit, band, stripe, found[1], counts[1]);
    adapt_all(&unit->contexts, CLASS_SIGNS, CLASS_FLAGS);
}

/* Code a stripe, of which the number in the pass is given, without the raw bits. */
LODE_INLINE void code_stripe(bool reads, bool first_pass, struct unit *unit, const struct band *band,
                             const struct stripe *stripe, int64_t number, int plane) {
    struct columns columns;
    if (code_flags(reads, first_pass, unit, band, stripe, plane, &columns))
        code_bits(reads, first_pass, unit, band, stripe, number, plane, &columns);
    if (!first_pass)
        adapt_all(&unit->contexts, CLASS_FLAGS, CLASS_CONTEXTS);
}

/* A 1 for each of eight coefficients in a row whose two highest bits stand above a plane: all further ones are raw. */
LODE_INLINE eight_t refined_in(const uint8_t *marks, int plane, int64_t columns) {
    eight_t refined = reaching(eight_at(marks) & 127 * EACH, plane + 3);
    return columns < BLOCK ? refined & eight_at(WITHIN + BLOCK - columns) : refined;
}

/* Read the raw bits of a stripe from `data`, of which `bits` are taken; those that are taken then. */
static int64_t read_raw(const struct tiles *tiles, const struct band *band, const struct stripe *stripe, int plane,
                        const uint8_t *data, int64_t size, int64_t bits) {
    uint8_t rest[STRIPE_SIZE / 8 + 8];
    int64_t left = size - (bits >> 3);
    const uint8_t *from = left > 0 ? data + (bits >> 3) : rest;
    if (left < (int64_t)sizeof rest) {
        memset(rest, 0, sizeof rest);
        if (left > 0)
            memcpy(rest, from, (size_t)left);
        from = rest;
    }
    int start = (int)(bits & 7), at = start;
    for (int i = 0; i < stripe->rows; i++)
        for (int j = 0; j < stripe->columns; j += BLOCK) {
            int64_t place = stripe->first + i * band->stride + j;
            eight_t refined = refined_in(tiles->early + place, plane, stripe->columns - j);
            if (!refined)
                continue;
            uint32_t chosen = bits_of(refined);
            const uint8_t *byte = from + (at >> 3);
            uint32_t coming = (byte[0] | (uint32_t)byte[1] << 8) >> (at & 7) & 255;
            at += __builtin_popcount(chosen);
            /* Each chosen byte keeps the bit that is its own, and becomes 1 if that is not 0. */
            eight_t own = coming * EACH & eight_at(RANKS[chosen]);
            own = (((own & 127 * EACH) + 127 * EACH) | own) >> 7 & EACH;
            add_bits(tiles->known + place, own, plane);
        }
    return bits + at - start;
}

/* How many raw bits a stripe has. */
static int64_t count_raw(const struct tiles *tiles, const struct band *band, const struct stripe *stripe, int plane) {
    int64_t bits = 0;
    for (int i = 0; i < stripe->rows; i++)
        for (int j = 0; j < stripe->columns; j += BLOCK)
            bits +=
                (int64_t)(refined_in(tiles->early + stripe->first + i * band->stride + j, plane, stripe->columns - j) *
                              EACH >>
                          56);
    return bits;
}

/* Bits of a plane of eight magnitudes in a row, 0 or 1 each. */
LODE_INLINE eight_t bits_in(const uint32_t *magnitudes, int plane) {
    units_of_four_t all[2];
    memcpy(all, magnitudes, sizeof all);
    units_of_four_t each = one_in_each();
    uint32_t halves[2];
    for (int k = 0; k < 2; k++) {
        units_of_four_t ones = (0 - (all[k] >> (uint32_t)plane & 1)) & each;
        halves[k] = ones[0] | ones[1] | ones[2] | ones[3];
    }
    eight_t bits;
    memcpy(&bits, halves, sizeof bits);
    return bits;
}

/* Write the raw bits of a stripe behind `bits` others into zeros; those that are there then. */
static int64_t write_raw(const struct tiles *tiles, const struct band *band, const struct stripe *stripe, int plane,
                         uint8_t *data, int64_t bits) {
    for (int i = 0; i < stripe->rows; i++)
        for (int j = 0; j < stripe->columns; j += BLOCK) {
            int64_t place = stripe->first + i * band->stride + j;
            uint32_t chosen = bits_of(refined_in(tiles->early + place, plane, stripe->columns - j));
            if (!chosen)
                continue;
            eight_t ones = bits_in(tiles->known + place, plane);
            uint32_t coming = (uint32_t)((255 * ones & eight_at(RANKS[chosen])) * EACH >> 56) << (bits & 7);
            uint8_t *byte = data + (bits >> 3);
            byte[0] |= (uint8_t)coming;
            if (coming >> 8)
                byte[1] |= (uint8_t)(coming >> 8);
            bits += __builtin_popcount(chosen);
        }
    return bits;
}

#endif
