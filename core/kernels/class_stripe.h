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
#include "class_raw.h"
#include "class_tables.h"
#include "inlining.h"
#include "rans.h"

/* The contexts of a large unit: significance, refinement, signs, flags. */
enum {
    CLASS_REFINEMENT = CLASSES,
    CLASS_SIGNS = CLASS_REFINEMENT + 1,
    CLASS_FLAGS = CLASS_SIGNS + 15,
    CLASS_CONTEXTS = CLASS_FLAGS + 27,
};

_Static_assert((int)CLASS_CONTEXTS == (int)MOST_CONTEXTS &&
                   CLASS_CONTEXTS == sizeof CLASS_STARTS / sizeof *CLASS_STARTS,
               "each context has a place and begins somewhere");

typedef uint16_t places_t __attribute__((vector_size(16)));

LODE_INLINE void code_decision(bool reads, uint8_t number, const uint16_t *coded, uint16_t *counts, uint32_t *state,
                               const uint8_t **at, uint8_t *bit, symbol_t *symbol) {
    uint32_t probability = coded[number], own = reads ? read_bit(state, at, probability) : *bit;
    if (reads)
        *bit = (uint8_t)own;
    else
        *symbol = symbol_of(probability, own);
    counts[2 * number + own]++;
}

/* Code decisions in turn: of each the context and the bit stand at its place. */
LODE_INLINE void code_in_turn(bool reads, struct unit *unit, const uint16_t *places, int many, const uint8_t *context,
                              uint8_t *bits) {
    const uint16_t *coded = unit->contexts.coded;
    uint16_t *counts = unit->contexts.counts[0], *more = unit->contexts.counts[1];
    uint32_t even = unit->rans.states[0], odd = unit->rans.states[1];
    const uint8_t *at = unit->rans.at;
    symbol_t *symbols = reads ? 0 : unit->symbols;
    int i = 0;
    for (; i < many - 1; i += 2) {
        int one = places[i], two = places[i + 1];
        code_decision(reads, context[one], coded, counts, &even, &at, bits + one, reads ? 0 : symbols + i);
        code_decision(reads, context[two], coded, more, &odd, &at, bits + two, reads ? 0 : symbols + i + 1);
    }
    if (i < many)
        code_decision(reads, context[places[i]], coded, counts, &even, &at, bits + places[i], reads ? 0 : symbols + i);
    unit->rans.states[0] = many & 1 ? odd : even;
    unit->rans.states[1] = many & 1 ? even : odd;
    unit->rans.at = at;
    if (!reads)
        unit->symbols = symbols + many;
}

/* These loops need all registers. */
static LODE_ALONE void read_decisions(struct unit *unit, const uint16_t *places, int many, const uint8_t *context,
                                      uint8_t *bits) {
    code_in_turn(true, unit, places, many, context, bits);
}

static LODE_ALONE void keep_decisions(struct unit *unit, const uint16_t *places, int many, const uint8_t *context,
                                      uint8_t *bits) {
    code_in_turn(false, unit, places, many, context, bits);
}

LODE_INLINE void code_decisions(bool reads, struct unit *unit, const uint16_t *places, int many, const uint8_t *context,
                                uint8_t *bits) {
    if (reads)
        read_decisions(unit, places, many, context, bits);
    else
        keep_decisions(unit, places, many, context, bits);
}

/* All bits of the parents of a block. */
LODE_INLINE uint32_t family_of(const struct tiles *tiles, const struct band *band, const struct block *block) {
    if (band->row_shift != 1 || band->column_shift != 1 || block->rows != BLOCK || block->columns != BLOCK)
        return parents_in(tiles, band, block);
    const uint32_t *parents =
        tiles->known + band->parent + (block->top >> 1) * band->parent_stride + (block->left >> 1);
    units_of_four_t all = {0}, row;
    for (int i = 0; i < BLOCK / 2; i++, parents += band->parent_stride) {
        memcpy(&row, parents, sizeof row);
        all |= row;
    }
    return all[0] | all[1] | all[2] | all[3];
}

/* Code whether a block that has no significant coefficient so far gets one in this plane. */
LODE_INLINE uint8_t code_class_flag(bool reads, struct unit *unit, const struct band *band, const struct block *block,
                                    const uint8_t *flag, int plane) {
    uint32_t family = family_of(unit->tiles, band, block) >> plane;
    int before = (flag[-1] != 0) + (flag[-band->across - 1] != 0);
    int after = (flag[1] != 0) + (flag[band->across + 1] != 0);
    uint8_t context = (uint8_t)(CLASS_FLAGS + (before * 3 + after) * 3 + (int)(family < 2 ? family : 2));
    uint8_t bit = (uint8_t)(!reads && truth_in(unit->tiles, band, block) >> plane != 0);
    uint16_t place = 0;
    code_decisions(reads, unit, &place, 1, &context, &bit);
    return bit;
}

/* Columns of a stripe whose blocks are significant, and those whose blocks became so in this pass. */
struct columns {
    uint64_t possible, fresh;
};

/* Look at the blocks of a stripe, whose flags a second pass codes. */
LODE_INLINE struct columns code_flags(bool reads, bool first_pass, struct unit *unit, const struct band *band,
                                      const struct stripe *stripe, int plane) {
    uint8_t *flags = unit->tiles->flags + band->flags + stripe->top / BLOCK * (band->across + 1) + stripe->left / BLOCK;
    struct columns columns = {0, 0};
    bool any = false;
    for (int left = 0; left < stripe->columns; left += BLOCK, flags++) {
        uint64_t own = UINT64_C(255) << left;
        if (!*flags && !first_pass) {
            int rest = stripe->columns - left;
            struct block block = {stripe->top, stripe->left + left, stripe->rows, rest < BLOCK ? rest : BLOCK, 0};
            *flags = code_class_flag(reads, unit, band, &block, flags, plane);
            columns.fresh |= *flags ? own : 0;
            any = true;
        }
        columns.possible |= *flags ? own : 0;
    }
    if (any)
        adapt(&unit->contexts, CLASS_FLAGS, CLASS_CONTEXTS, 1);
    columns.possible &= columns_of(stripe);
    return columns;
}

/* List the places of the 1s among `width` bits of a mask, `step` apart from place `first` on, behind `many` others; how
 * many there are then. Seven more places of the list are overwritten. */
LODE_INLINE int list_places(uint64_t mask, int width, int first, int step, uint16_t *places, int many) {
    for (int j = 0; j < width; j += BLOCK, mask >>= BLOCK, first += step * BLOCK) {
        uint8_t numbers __attribute__((vector_size(8)));
        memcpy(&numbers, SET_BITS[mask & 255], sizeof numbers);
        places_t eight = __builtin_convertvector(numbers, places_t) * (uint16_t)step + (uint16_t)first;
        memcpy(places + many, &eight, sizeof eight);
        many += __builtin_popcount(mask & 255);
    }
    return many;
}

/* The even bits of a mask side by side. */
LODE_INLINE uint64_t even_bits(uint64_t mask) {
    mask &= UINT64_C(0x5555555555555555);
    mask = (mask | mask >> 1) & UINT64_C(0x3333333333333333);
    mask = (mask | mask >> 2) & UINT64_C(0x0F0F0F0F0F0F0F0F);
    mask = (mask | mask >> 4) & UINT64_C(0x00FF00FF00FF00FF);
    mask = (mask | mask >> 8) & UINT64_C(0x0000FFFF0000FFFF);
    return (mask | mask >> 16) & UINT32_MAX;
}

/* By the sums of the signs beside, x, and of those above and below, y, each modulo 8: twice what a context's number is
 * beyond that of the kind, three times a class, and 1 more where the opposite case shares it. Other sums have no
 * meaning. And where both change places. */
#define CUT(n) ((n) < -1 ? -1 : (n) > 1 ? 1 : (n))
#define CASE(sum) (uint8_t)((sum) < 0 ? -6 * (sum) + 1 : 6 * (sum))
#define CASES_OF(x, y) CASE(3 * CUT(x) + CUT(y))
#define ROW_OF(x) {CASES_OF(x, 0), CASES_OF(x, 1), CASES_OF(x, 2), 0, 0, 0, CASES_OF(x, -2), CASES_OF(x, -1)}
#define TURNED_ROW_OF(y) {CASES_OF(0, y), CASES_OF(1, y), CASES_OF(2, y), 0, 0, 0, CASES_OF(-2, y), CASES_OF(-1, y)}
static const uint8_t SIGN_CASES[2][8][8] = {
    {ROW_OF(0), ROW_OF(1), ROW_OF(2), {0}, {0}, {0}, ROW_OF(-2), ROW_OF(-1)},
    {TURNED_ROW_OF(0), TURNED_ROW_OF(1), TURNED_ROW_OF(2), {0}, {0}, {0}, TURNED_ROW_OF(-2), TURNED_ROW_OF(-1)},
};

/* Which of the contexts of signs are those of a band, the first and every third one. */
enum { SIGN_KINDS = 3 };

LODE_INLINE int sign_kind(const struct band *band) {
    return band->kind > 1 ? band->kind - 1 : 0;
}

/* Code the sign at a place of a stripe, and mark the coefficient. Contexts are those of the band's kind. */
LODE_INLINE void code_class_sign(bool reads, int8_t *sign, int64_t stride, const uint8_t cases[8][8],
                                 const uint16_t *coded, uint16_t *counts, uint32_t *state, const uint8_t **bytes,
                                 int32_t truth, symbol_t *symbol) {
    int x = sign[-1] + sign[1], y = sign[-stride] + sign[stride];
    size_t found = cases[x & 7][y & 7], flip = found & 1, number = found >> 1;
    uint32_t bit;
    if (reads)
        bit = read_bit(state, bytes, coded[number]);
    else
        *symbol = symbol_of(coded[number], bit = (truth < 0) ^ (uint32_t)flip);
    counts[2 * number + bit]++;
    *sign = (int8_t)(1 - 2 * (int)(bit ^ flip));
}

/* Code the signs of coefficients found in a stripe, those at even or at odd places. */
LODE_INLINE void code_signs_in_turn(bool reads, struct unit *unit, const struct band *band, int64_t first,
                                    const uint16_t *places, int many, uint8_t mark) {
    int base = CLASS_SIGNS + sign_kind(band);
    const uint16_t *coded = unit->contexts.coded + base;
    uint16_t *counts = unit->contexts.counts[0] + 2 * base, *more = unit->contexts.counts[1] + 2 * base;
    const uint8_t (*cases)[8] = SIGN_CASES[band->kind == 2];
    int8_t *sign = unit->tiles->sign + first;
    uint8_t *marks = unit->tiles->early + first;
    const int32_t *truth = reads ? 0 : unit->tiles->truth + first;
    uint32_t even = unit->rans.states[0], odd = unit->rans.states[1];
    const uint8_t *at = unit->rans.at;
    symbol_t *symbols = reads ? 0 : unit->symbols;
    int64_t stride = band->stride, down = stride - STRIPE_COLUMNS;
    for (int i = 0; i < many; i += 2) {
        int64_t one = places[i] + places[i] / STRIPE_COLUMNS * down;
        marks[one] = mark;
        code_class_sign(reads, sign + one, stride, cases, coded, counts, &even, &at, reads ? 0 : truth[one],
                        reads ? 0 : symbols + i);
        if (i + 1 == many)
            break;
        int64_t two = places[i + 1] + places[i + 1] / STRIPE_COLUMNS * down;
        marks[two] = mark;
        code_class_sign(reads, sign + two, stride, cases, coded, more, &odd, &at, reads ? 0 : truth[two],
                        reads ? 0 : symbols + i + 1);
    }
    unit->rans.states[0] = many & 1 ? odd : even;
    unit->rans.states[1] = many & 1 ? even : odd;
    unit->rans.at = at;
    if (!reads)
        unit->symbols = symbols + many;
}

static LODE_ALONE void read_signs(struct unit *unit, const struct band *band, int64_t first, const uint16_t *places,
                                  int many, uint8_t mark) {
    code_signs_in_turn(true, unit, band, first, places, many, mark);
}

static LODE_ALONE void keep_signs(struct unit *unit, const struct band *band, int64_t first, const uint16_t *places,
                                  int many, uint8_t mark) {
    code_signs_in_turn(false, unit, band, first, places, many, mark);
}

LODE_INLINE void code_signs(bool reads, struct unit *unit, const struct band *band, int64_t first,
                            const uint16_t *places, int many, uint8_t mark) {
    if (reads)
        read_signs(unit, band, first, places, many, mark);
    else
        keep_signs(unit, band, first, places, many, mark);
}

/* What is known of a stripe. */
LODE_INLINE struct class_map *map_of(struct unit *unit, const struct band *band, const struct stripe *stripe,
                                     int64_t number, int plane) {
    struct class_map *map = &unit->maps[map_number(number)];
    if (unit->seen & kept_bit(number))
        return map;
    const uint32_t *parents = unit->tiles->known + band->parent +
                              (stripe->top >> band->row_shift) * band->parent_stride +
                              (stripe->left >> band->column_shift);
    see_stripe(unit->tiles->early + stripe->first, band->stride, stripe, parents, band->parent_stride, band->row_shift,
               band->column_shift, plane, map);
    unit->seen |= kept_bit(number);
    return map;
}

/* Bits of a plane of a row that is written, all of whose magnitudes are known. */
LODE_INLINE void take_row(const uint32_t *known, int columns, int plane, uint8_t *bits) {
    for (int j = 0; j < columns; j++)
        bits[j] = (uint8_t)(known[j] >> plane & 1);
}

/* Code the bits of a stripe some of whose blocks are significant, and their signs. */
LODE_INLINE void code_bits(bool reads, bool first_pass, struct unit *unit, const struct band *band,
                           const struct stripe *stripe, int64_t number, int plane, struct columns columns) {
    uint32_t *known = unit->tiles->known + stripe->first;
    struct class_map *map = map_of(unit, band, stripe, number, plane);
    uint64_t visited[STRIPE_ROWS];
    uint16_t places[STRIPE_SIZE + BLOCK], found[2][STRIPE_SIZE / 2 + BLOCK];
    uint8_t bits[STRIPE_SIZE] = {0};
    int many = 0, counts[2] = {0, 0};
    for (int i = 0; i < stripe->rows; i++) {
        uint64_t zero = map->zero[i], near = map->near[i];
        visited[i] = (first_pass ? zero & near : (zero & (~near | columns.fresh)) | map->young[i]) & columns.possible;
        many = list_places(visited[i], STRIPE_COLUMNS, i * STRIPE_COLUMNS, 1, places, many);
        if (!reads && stripe->columns == STRIPE_COLUMNS)
            take_row(known + i * band->stride, STRIPE_COLUMNS, plane, bits + i * STRIPE_COLUMNS);
        else if (!reads)
            take_row(known + i * band->stride, stripe->columns, plane, bits + i * STRIPE_COLUMNS);
    }
    if (many == 0)
        return;
    code_decisions(reads, unit, places, many, map->context[0], bits);
    if (!first_pass) /* visits what has no neighbour, and what is refined; others only in fresh blocks */
        adapt(&unit->contexts, 0, DISTANT, 1);
    if (first_pass || columns.fresh)
        adapt(&unit->contexts, DISTANT, CLASS_REFINEMENT, 1);
    if (!first_pass)
        adapt(&unit->contexts, CLASS_REFINEMENT, CLASS_SIGNS, 1);
    bool kept = kept_bit(number) != 0;
    for (int i = 0; i < stripe->rows; i++) {
        uint64_t ones = 0;
        for (int j = 0; j < STRIPE_COLUMNS; j += LANES)
            ones |= negative_lanes((lanes_t)(lanes_at(bits + i * STRIPE_COLUMNS + j) > 0)) << j;
        ones &= visited[i];
        if (reads && kept)
            map->ones[i] |= ones;
        else if (reads)
            add_ones(known + i * band->stride, ones, stripe->columns, plane);
        uint64_t new = ones & map->zero[i];
        if (!new)
            continue;
        int odd = i & 1, place = i * STRIPE_COLUMNS;
        counts[0] = list_places(even_bits(new >> odd), STRIPE_COLUMNS / 2, place + odd, 2, found[0], counts[0]);
        counts[1] =
            list_places(even_bits(new >> (1 - odd)), STRIPE_COLUMNS / 2, place + 1 - odd, 2, found[1], counts[1]);
    }
    if (reads)
        unit->pending |= kept_bit(number);
    if (counts[0] + counts[1] == 0)
        return;
    uint8_t mark = (uint8_t)(plane + 1 + (first_pass ? 0 : FOUND_SECOND));
    code_signs(reads, unit, band, stripe->first, found[0], counts[0], mark);
    code_signs(reads, unit, band, stripe->first, found[1], counts[1], mark);
    adapt(&unit->contexts, CLASS_SIGNS + sign_kind(band), CLASS_FLAGS, SIGN_KINDS);
}

/* Code a stripe, of which the number in the pass is given, without the raw bits. */
LODE_INLINE void code_stripe(bool reads, bool first_pass, struct unit *unit, const struct band *band,
                             const struct stripe *stripe, int64_t number, int plane) {
    if (reads)
        find_bytes(unit);
    struct columns columns = code_flags(reads, first_pass, unit, band, stripe, plane);
    if (columns.possible)
        code_bits(reads, first_pass, unit, band, stripe, number, plane, columns);
}

#endif
