/* The class coder: large units, bit-plane by bit-plane (docs/format.md, "Large units").
 *
 * A pass goes through stripes of 8 rows and 64 columns. What codes a coefficient follows from the planes above and from
 * the parents, so all decisions of a stripe and their contexts are listed before the first is read; their
 * probabilities change when the stripe is done.
 */
#include "class_coder.h"

#include "class_map.h"
#include "class_starts.h"
#include "class_tables.h"
#include "rans.h"

enum {
    CLASS_REFINEMENT = CLASSES,
    CLASS_SIGNS = CLASS_REFINEMENT + 1,
    CLASS_FLAGS = CLASS_SIGNS + 15,
    CLASS_CONTEXTS = CLASS_FLAGS + 27,
    CLASS_STATES = CLASS_CONTEXTS, /* of a model: where the two states are kept */
    MOST_KEPT = 16,                /* adaptation count from one plane to the next */
    KEPT_MAPS = 32,
};

_Static_assert(CLASS_STATES + 2 <= CONTEXTS, "a model holds the contexts of either coder");

/* All ones in the first bytes: from the place 8 - n on, in n of eight. And a 1 in every other byte. */
static const uint8_t WITHIN[2 * BLOCK] = {255, 255, 255, 255, 255, 255, 255, 255};
static const uint8_t EVEN[2 * BLOCK] = {1, 0, 1, 0, 1, 0, 1, 0, 1, 0};

typedef uint32_t units4_t __attribute__((vector_size(16)));
typedef uint16_t places_t __attribute__((vector_size(16)));

/* A unit while it is coded. */
struct unit {
    const struct tiles *tiles;
    struct contexts contexts;
    struct rans rans;
    uint16_t *symbols;
    /* What the first pass of a plane has seen of the first stripes is not looked at again in the second. */
    uint32_t seen;
    struct class_map maps[KEPT_MAPS];
};

static struct stripe stripe_of(const struct band *band, int64_t number) {
    int64_t across = (band->columns + STRIPE_COLUMNS - 1) / STRIPE_COLUMNS, row = number / across;
    int64_t top = row * STRIPE_ROWS, left = (number - row * across) * STRIPE_COLUMNS;
    int64_t rows = band->rows - top, columns = band->columns - left;
    return (struct stripe){top, left, band->offset + top * band->stride + left,
                           (int)(rows < STRIPE_ROWS ? rows : STRIPE_ROWS),
                           (int)(columns < STRIPE_COLUMNS ? columns : STRIPE_COLUMNS)};
}

static int64_t stripes_in(const struct band *band) {
    return (band->rows + STRIPE_ROWS - 1) / STRIPE_ROWS * ((band->columns + STRIPE_COLUMNS - 1) / STRIPE_COLUMNS);
}

static void load_contexts(struct contexts *contexts, const int32_t *model) {
    for (int k = 0; k < CLASS_CONTEXTS; k++) {
        contexts->probability[k] = (uint16_t)(model[k] & 0xFFFF);
        contexts->adapted[k] = (uint8_t)(model[k] >> 16 & 127);
        contexts->counted[k] = 0;
        set_coded(contexts, k);
    }
}

static void start_contexts(int32_t *model) {
    for (int k = 0; k < CLASS_CONTEXTS; k++)
        model[k] = CLASS_STARTS[k] | STARTING_COUNT << 16;
}

static void store_contexts(const struct contexts *contexts, int32_t *model) {
    for (int k = 0; k < CLASS_CONTEXTS; k++)
        model[k] = contexts->probability[k] | contexts->adapted[k] << 16;
}

/* Code decisions in turn: of each the context and the bit stand at its place. */
LODE_INLINE void code_run(bool reads, struct unit *unit, const uint16_t *places, int count, const uint8_t *context,
                          uint8_t *bits) {
    if (reads)
        read_run(&unit->rans, &unit->contexts, places, count, context, bits);
    else
        unit->symbols = keep_run(unit->symbols, &unit->contexts, places, count, context, bits);
}

static inline void adapt_all(struct contexts *contexts, int first, int last) {
    for (int k = first; k < last; k++)
        if (contexts->counted[k])
            adapt(contexts, k);
}

/* Code the flags of a stripe's blocks; `flagged` and `fresh` of a block are 255 where it has a significant coefficient
 * and where it has the first one just now. Whether any has one. */
LODE_INLINE bool code_flags(bool reads, struct unit *unit, const struct band *band, const struct stripe *stripe,
                            int plane, uint8_t flagged[STRIPE_BLOCKS], uint8_t fresh[STRIPE_BLOCKS], bool coded) {
    const struct tiles *tiles = unit->tiles;
    int64_t row = stripe->top / BLOCK;
    uint8_t *flags = tiles->flags + band->flags + row * (band->across + 1) + stripe->left / BLOCK;
    bool any = false;
    for (int number = 0; number * BLOCK < stripe->columns; number++) {
        uint8_t *flag = flags + number;
        fresh[number] = 0;
        if (!*flag && coded) {
            struct block block = {stripe->top, stripe->left + number * BLOCK, stripe->rows,
                                  stripe->columns - number * BLOCK, 0};
            block.columns = block.columns < BLOCK ? block.columns : BLOCK;
            uint32_t family = parents_in(tiles, band, &block) >> plane;
            int before = (flag[-1] != 0) + (flag[-band->across - 1] != 0);
            int after = (flag[1] != 0) + (flag[band->across + 1] != 0);
            uint8_t context = (uint8_t)(CLASS_FLAGS + (before * 3 + after) * 3 + (int)(family < 2 ? family : 2));
            uint8_t bit = reads ? 0 : (uint8_t)(truth_in(tiles, band, &block) >> plane != 0);
            uint16_t place = 0;
            code_run(reads, unit, &place, 1, &context, &bit);
            *flag = bit;
            fresh[number] = *flag ? 255 : 0;
        }
        flagged[number] = *flag ? 255 : 0;
        any |= *flag != 0;
    }
    return any;
}

/* Add bits of a plane, 0 or 1 a byte, to what is known of eight coefficients. */
LODE_INLINE void add_bits(uint32_t *known, eight_t ones, int plane) {
    uint8_t bits[BLOCK];
    put_eight(bits, ones);
    units4_t low = {bits[0], bits[1], bits[2], bits[3]}, high = {bits[4], bits[5], bits[6], bits[7]}, now[2];
    memcpy(now, known, sizeof now);
    now[0] += low << (uint32_t)plane;
    now[1] += high << (uint32_t)plane;
    memcpy(known, now, sizeof now);
}

/* List the places of the 1s among eight bytes of 0 and 1; how many the list has then. */
LODE_INLINE int list_places(eight_t ones, int first, uint16_t *places, int count) {
    uint32_t bits = bits_of(ones);
    places_t eight;
    memcpy(&eight, SET_BITS[bits], sizeof eight);
    eight += (uint16_t)first;
    memcpy(places + count, &eight, sizeof eight);
    return count + __builtin_popcount(bits);
}

/* List what a pass visits, in raster order. `possible` and `fresh` are 255 for columns of blocks that are significant,
 * and that became so in this pass. */
LODE_INLINE int list_visited(bool first_pass, const struct class_map *map, const struct stripe *stripe,
                             const uint8_t *possible, const uint8_t *fresh, uint16_t *places) {
    int count = 0;
    for (int i = 0; i < stripe->rows; i++)
        for (int j = 0; j < stripe->columns; j += 2 * BLOCK) {
            bytes_t weight = bytes_at(map->weights[i + MARGIN] + MARGIN + j), context = bytes_at(map->context[i] + j);
            bytes_t zero = (bytes_t)(weight == 0), near = (bytes_t)(context >= DISTANT), visited = zero & near;
            if (!first_pass)
                visited = (zero & (~near | bytes_at(fresh + j))) | (bytes_t)(weight == 2);
            visited &= bytes_at(possible + j) & 1;
            uint8_t ones[2 * BLOCK];
            memcpy(ones, &visited, sizeof ones);
            count = list_places(eight_at(ones), i * STRIPE_COLUMNS + j, places, count);
            count = list_places(eight_at(ones + BLOCK), i * STRIPE_COLUMNS + j + BLOCK, places, count);
        }
    return count;
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
                            const uint16_t *places, int count) {
    const struct tiles *tiles = unit->tiles;
    struct run run;
    run.rans = &unit->rans;
    if (reads)
        begin_run(&run, count);
    for (int i = 0; i < count; i++) {
        int64_t at = stripe->first + places[i] / STRIPE_COLUMNS * band->stride + places[i] % STRIPE_COLUMNS;
        int flip, context = sign_context(band, tiles->sign + at, &flip);
        int bit = reads ? 0 : (tiles->truth[at] < 0) ^ flip;
        if (reads)
            bit = next_bit(&run, unit->contexts.coded[context]);
        else
            *unit->symbols++ = (symbol_t)(unit->contexts.coded[context] | bit << 15);
        unit->contexts.counted[context] += 1 + ((uint32_t)bit << 16);
        tiles->sign[at] = (int8_t)(1 - 2 * (bit ^ flip));
    }
    if (reads)
        end_run(&run);
}

/* Take bits of a plane, 0 or 1 for each coefficient of the stripe, into what is known, and list what they find: at
 * places whose row and column have an even sum, and at the others. */
LODE_INLINE void take_bits(bool reads, const struct tiles *tiles, const struct band *band, const struct stripe *stripe,
                           int plane, const struct class_map *map, const uint8_t *bits, uint8_t mark,
                           uint16_t found[2][STRIPE_SIZE + BLOCK], int counts[2]) {
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
            counts[0] = list_places(new & even, place, found[0], counts[0]);
            counts[1] = list_places(new & ~even, place, found[1], counts[1]);
        }
}

/* The bits of a stripe that is written. */
static void stripe_bits(const struct tiles *tiles, const struct band *band, const struct stripe *stripe, int plane,
                        const uint16_t *places, int count, uint8_t *bits) {
    for (int i = 0; i < count; i++) {
        int64_t at = stripe->first + places[i] / STRIPE_COLUMNS * band->stride + places[i] % STRIPE_COLUMNS;
        bits[places[i]] = (uint8_t)(tiles->known[at] >> plane & 1);
    }
}

LODE_INLINE void code_stripe(bool reads, bool first_pass, struct unit *unit, const struct band *band,
                             const struct stripe *stripe, int64_t number, int plane) {
    const struct tiles *tiles = unit->tiles;
    uint8_t flagged[STRIPE_BLOCKS] = {0}, fresh[STRIPE_BLOCKS] = {0};
    if (code_flags(reads, unit, band, stripe, plane, flagged, fresh, !first_pass)) {
        uint32_t kept = number < KEPT_MAPS - 1 ? UINT32_C(1) << number : 0;
        struct class_map *map = &unit->maps[kept ? number : KEPT_MAPS - 1];
        uint8_t possible[STRIPE_COLUMNS], new[STRIPE_COLUMNS];
        bool any_fresh = false;
        for (int block = 0; block < STRIPE_BLOCKS; block++) {
            int columns = stripe->columns - block * BLOCK;
            eight_t within = columns >= BLOCK ? ~UINT64_C(0) : columns > 0 ? eight_at(WITHIN + BLOCK - columns) : 0;
            put_eight(possible + block * BLOCK, flagged[block] * EACH & within);
            put_eight(new + block * BLOCK, fresh[block] * EACH);
            any_fresh |= fresh[block] != 0;
        }
        bool looks = first_pass || any_fresh || !(unit->seen & kept);
        if (looks) {
            const uint32_t *parents = tiles->known + band->parent +
                                      (stripe->top >> band->row_shift) * band->parent_stride +
                                      (stripe->left >> band->column_shift);
            see_stripe(tiles->early + stripe->first, band->stride, stripe, parents, band->parent_stride,
                       band->row_shift, band->column_shift, plane, possible, map);
            unit->seen |= kept;
        }
        uint16_t visited[STRIPE_SIZE + BLOCK], found[2][STRIPE_SIZE + BLOCK];
        uint8_t bits[STRIPE_SIZE];
        int counts[2], count = list_visited(first_pass, map, stripe, possible, new, visited);
        if (count) {
            memset(bits, 0, sizeof bits);
            if (!reads)
                stripe_bits(tiles, band, stripe, plane, visited, count, bits);
            code_run(reads, unit, visited, count, map->context[0], bits);
            take_bits(reads, tiles, band, stripe, plane, map, bits,
                      (uint8_t)(plane + 1 + (first_pass ? 0 : FOUND_SECOND)), found, counts);
            adapt_all(&unit->contexts, 0, CLASS_SIGNS);
            if (counts[0] + counts[1]) {
                code_signs(reads, unit, band, stripe, found[0], counts[0]);
                code_signs(reads, unit, band, stripe, found[1], counts[1]);
                adapt_all(&unit->contexts, CLASS_SIGNS, CLASS_FLAGS);
            }
        }
    }
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

/* Bits of a plane of eight coefficients in a row, 0 or 1 each. */
LODE_INLINE eight_t true_bits(const uint32_t *magnitudes, int plane) {
    units4_t all[2];
    memcpy(all, magnitudes, sizeof all);
    units4_t low = all[0] >> (uint32_t)plane & 1, high = all[1] >> (uint32_t)plane & 1;
    uint8_t bits[BLOCK];
    for (int k = 0; k < BLOCK / 2; k++) {
        bits[k] = (uint8_t)low[k];
        bits[k + BLOCK / 2] = (uint8_t)high[k];
    }
    return eight_at(bits);
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
            eight_t ones = true_bits(tiles->known + place, plane);
            uint32_t coming = (uint32_t)((255 * ones & eight_at(RANKS[chosen])) * EACH >> 56) << (bits & 7);
            uint8_t *byte = data + (bits >> 3);
            byte[0] |= (uint8_t)coming;
            if (coming >> 8)
                byte[1] |= (uint8_t)(coming >> 8);
            bits += __builtin_popcount(chosen);
        }
    return bits;
}

static void begin_pass(struct unit *unit, int64_t number) {
    struct contexts *contexts = &unit->contexts;
    if (!(number & 1))
        return;
    unit->seen = 0;
    for (int k = 0; k < CLASS_CONTEXTS; k++)
        contexts->adapted[k] = contexts->adapted[k] < MOST_KEPT ? contexts->adapted[k] : MOST_KEPT;
}

/* The bytes of raw bits, past the end of which there are zeros. */
static int64_t past(int64_t place, int64_t bits, int64_t size) {
    place += (bits + 7) >> 3;
    return place < size ? place : size;
}

bool lode_class_read(const struct tiles *tiles, const int64_t *bands, int64_t count, int64_t first, int64_t last,
                     const uint8_t *data, int64_t size, struct class_place *at, int64_t *budget) {
    struct unit unit;
    uint32_t *states = (uint32_t *)tiles->model + CLASS_STATES;
    unit.tiles = tiles;
    unit.seen = 0;
    if (states[0] == 0) { /* the unit's first segment */
        uint8_t bytes[STATE_BYTES] = {0};
        at->bytes = size < STATE_BYTES ? size : STATE_BYTES;
        memcpy(bytes, data, (size_t)at->bytes);
        for (int k = 0; k < 2; k++) {
            const uint8_t *b = bytes + 4 * k;
            uint32_t state = b[0] | (uint32_t)b[1] << 8 | (uint32_t)b[2] << 16 | (uint32_t)b[3] << 24;
            states[k] = state < LOWEST_STATE ? LOWEST_STATE : state;
        }
        start_contexts(tiles->model);
    }
    load_contexts(&unit.contexts, tiles->model);
    unit.rans = (struct rans){states[0], states[1], data + at->bytes, data + size};
    for (; at->passes <= first - last; at->passes++, at->band = 0) {
        int64_t number = first - at->passes;
        int plane = (int)(number >> 1);
        bool first_pass = number & 1;
        int64_t rounds = first_pass ? count : 2 * count;
        if (at->band == 0 && at->stripe == 0)
            begin_pass(&unit, number);
        int64_t before = 0;
        for (int64_t b = 0; b < at->band && b < count; b++) {
            struct band band = band_of(bands + b * BAND_FIELDS);
            before += stripes_in(&band);
        }
        for (; at->band < rounds; at->band++, at->stripe = 0) {
            bool raw = at->band >= count;
            struct band band = band_of(bands + (raw ? at->band - count : at->band) * BAND_FIELDS);
            int64_t stripes = stripes_in(&band);
            for (; at->stripe < stripes; at->stripe++) {
                if (*budget <= 0)
                    goto pause;
                struct stripe stripe = stripe_of(&band, at->stripe);
                *budget -= stripe.rows * stripe.columns;
                if (raw)
                    at->bits =
                        read_raw(tiles, &band, &stripe, plane, unit.rans.at, unit.rans.end - unit.rans.at, at->bits);
                else if (first_pass)
                    code_stripe(true, true, &unit, &band, &stripe, before + at->stripe, plane);
                else
                    code_stripe(true, false, &unit, &band, &stripe, before + at->stripe, plane);
            }
            before += stripes;
        }
        unit.rans.at = data + past(unit.rans.at - data, at->bits, size);
        at->bits = 0;
    }
pause:
    at->bytes = unit.rans.at - data;
    states[0] = unit.rans.next;
    states[1] = unit.rans.other;
    store_contexts(&unit.contexts, tiles->model);
    return at->passes > first - last;
}

/* List the decisions of a pass, forwards; how many raw bits it has, or -1 where there is no room. */
static int64_t list_pass(struct unit *unit, const int64_t *bands, int64_t count, int64_t number, const symbol_t *end) {
    int plane = (int)(number >> 1);
    int64_t bits = 0, done = 0;
    begin_pass(unit, number);
    for (int64_t b = 0; b < count; b++) {
        struct band band = band_of(bands + b * BAND_FIELDS);
        for (int64_t s = 0, stripes = stripes_in(&band); s < stripes; s++, done++) {
            struct stripe stripe = stripe_of(&band, s);
            if (end - unit->symbols < 2 * MOST_IN_RUN + STRIPE_BLOCKS)
                return -1;
            if (number & 1)
                code_stripe(false, true, unit, &band, &stripe, done, plane);
            else {
                code_stripe(false, false, unit, &band, &stripe, done, plane);
                bits += count_raw(unit->tiles, &band, &stripe, plane);
            }
        }
    }
    return bits;
}

/* Write the raw bits of a pass into zeros. */
static void write_raw_bits(const struct tiles *tiles, const int64_t *bands, int64_t count, int plane, uint8_t *data) {
    int64_t bits = 0;
    for (int64_t b = 0; b < count; b++) {
        struct band band = band_of(bands + b * BAND_FIELDS);
        for (int64_t s = 0, stripes = stripes_in(&band); s < stripes; s++) {
            struct stripe stripe = stripe_of(&band, s);
            bits = write_raw(tiles, &band, &stripe, plane, data, bits);
        }
    }
}

/* All magnitudes: what is known when all passes are done. Contexts of the unit itself follow from marks alone. */
static void know_all(const struct tiles *tiles, const int64_t *bands, int64_t count) {
    for (int64_t b = 0; b < count; b++) {
        struct band band = band_of(bands + b * BAND_FIELDS);
        for (int64_t i = 0; i < band.rows; i++)
            for (int64_t j = 0, at = band.offset + i * band.stride; j < band.columns; j++)
                tiles->known[at + j] = magnitude(tiles->truth[at + j]);
    }
}

int64_t lode_class_write(const struct tiles *tiles, const int64_t *bands, int64_t count, int64_t first,
                         const struct class_output *output) {
    struct unit unit;
    int64_t decisions[MOST_PASSES + 1], bits[MOST_PASSES];
    unit.tiles = tiles;
    unit.seen = 0;
    start_contexts(tiles->model);
    load_contexts(&unit.contexts, tiles->model);
    unit.symbols = output->symbols;
    know_all(tiles, bands, count);
    decisions[first + 1] = 0;
    for (int64_t number = first; number >= 0; number--) {
        bits[number] = list_pass(&unit, bands, count, number, output->symbols + output->symbols_count);
        if (bits[number] < 0)
            return -1;
        decisions[number] = unit.symbols - output->symbols;
    }
    uint32_t states[2] = {LOWEST_STATE, LOWEST_STATE};
    uint8_t *end = output->data + output->data_count, *begin = end;
    for (int64_t number = 0; number <= first; number++) {
        int64_t bytes = (bits[number] + 7) >> 3, room = begin - output->data;
        if (room < bytes + WORD * (decisions[number] - decisions[number + 1] + 1) + STATE_BYTES)
            return -1;
        output->costs[number] = (double)(end - begin); /* behind the end of this pass */
        begin -= bytes;
        memset(begin, 0, (size_t)bytes);
        if (bytes)
            write_raw_bits(tiles, bands, count, (int)(number >> 1), begin);
        begin = write_symbols(output->symbols, decisions[number + 1], decisions[number], states, begin);
    }
    for (int k = STATE_BYTES; k-- > 0;)
        *--begin = (uint8_t)(states[k / 4] >> 8 * (k % 4));
    int64_t size = end - begin;
    for (int64_t number = 0; number <= first; number++)
        output->costs[number] = 8.0 * ((double)size - output->costs[number]);
    memmove(output->data, begin, (size_t)size);
    return size;
}
