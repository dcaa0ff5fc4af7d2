/* The class coder: large units, bit-plane by bit-plane (docs/format.md, "Large units").
 *
 * A pass goes through stripes of 8 rows and 64 columns. All passes of a unit are one string, which rANS writes from its
 * end; so a unit is written at once, and its string is cut where passes end.
 */
#include "class_coder.h"

#include "class_stripe.h"

enum {
    CLASS_STATES = CLASS_CONTEXTS, /* of a model: where the two states are kept */
    MOST_KEPT = 16,                /* adaptation count from one plane to the next */
};

_Static_assert(CLASS_STATES + 2 <= CONTEXTS, "a model holds the contexts of either coder");

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
        set_coded(contexts, k);
    }
    memset(contexts->counts, 0, sizeof contexts->counts);
}

static void start_contexts(int32_t *model) {
    for (int k = 0; k < CLASS_CONTEXTS; k++)
        model[k] = CLASS_STARTS[k] | STARTING_COUNT << 16;
}

static void store_contexts(const struct contexts *contexts, int32_t *model) {
    for (int k = 0; k < CLASS_CONTEXTS; k++)
        model[k] = contexts->probability[k] | contexts->adapted[k] << 16;
}

/* Before a pass: each plane forgets, but the highest, which has one pass. */
static void begin_pass(struct unit *unit, int64_t number) {
    struct contexts *contexts = &unit->contexts;
    if (!(number & 1))
        return;
    for (int k = 0; k < CLASS_CONTEXTS; k++)
        contexts->adapted[k] = contexts->adapted[k] < MOST_KEPT ? contexts->adapted[k] : MOST_KEPT;
}

static int64_t stripes_before(const int64_t *bands, int64_t count) {
    int64_t stripes = 0;
    for (int64_t b = 0; b < count; b++) {
        struct band band = band_of(bands + b * BAND_FIELDS);
        stripes += stripes_in(&band);
    }
    return stripes;
}

/* Begin a unit: its states from its first bytes, of which zeros follow those that are there; how many are taken. */
static int64_t start_unit(int32_t *model, uint32_t states[2], const uint8_t *data, int64_t size) {
    uint8_t bytes[STATE_BYTES] = {0};
    int64_t taken = size < STATE_BYTES ? size : STATE_BYTES;
    memcpy(bytes, data, (size_t)taken);
    for (int k = 0; k < 2; k++) {
        const uint8_t *b = bytes + 4 * k;
        uint32_t state = b[0] | (uint32_t)b[1] << 8 | (uint32_t)b[2] << 16 | (uint32_t)b[3] << 24;
        states[k] = state < LOWEST_STATE ? LOWEST_STATE : state;
    }
    start_contexts(model);
    return taken;
}

/* What is known of stripes is that before a plane. */
static void enter_plane(struct unit *unit, int plane) {
    if (unit->plane != plane)
        unit->seen = 0;
    unit->plane = plane;
}

/* Let what was read of the plane be known. */
static void know_pending(struct unit *unit, const int64_t *bands, int64_t count) {
    for (int64_t b = 0, number = 0; b < count && unit->pending; b++) {
        struct band band = band_of(bands + b * BAND_FIELDS);
        for (int64_t s = 0, stripes = stripes_in(&band); s < stripes && unit->pending; s++, number++) {
            struct stripe stripe = stripe_of(&band, s);
            if (unit->pending & kept_bit(number))
                add_pending(unit, &band, &stripe, number);
        }
    }
}

/* Read a pass from where the walk stands until it is done or the budget is spent; whether it is done. */
static bool read_pass(struct unit *unit, const int64_t *bands, int64_t count, int64_t number, struct class_place *at,
                      int64_t *budget) {
    int plane = (int)(number >> 1);
    bool first_pass = number & 1;
    enter_plane(unit, plane);
    if (at->band == 0 && at->stripe == 0)
        begin_pass(unit, number);
    int64_t rounds = first_pass ? count : 2 * count;
    int64_t before = at->band < rounds ? stripes_before(bands, at->band % count) : 0; /* forged: any band */
    for (; at->band < rounds; at->band++, at->stripe = 0) {
        bool raw = at->band >= count;
        if (at->band == count)
            before = 0;
        struct band band = band_of(bands + (raw ? at->band - count : at->band) * BAND_FIELDS);
        int64_t stripes = stripes_in(&band);
        for (; at->stripe < stripes; at->stripe++) {
            if (*budget <= 0)
                return false;
            struct stripe stripe = stripe_of(&band, at->stripe);
            *budget -= stripe.rows * stripe.columns;
            if (raw)
                at->bits = read_raw(unit, &band, &stripe, before + at->stripe, plane, at->bits);
            else if (first_pass)
                code_stripe(true, true, unit, &band, &stripe, before + at->stripe, plane);
            else
                code_stripe(true, false, unit, &band, &stripe, before + at->stripe, plane);
        }
        before += stripes;
    }
    if (at->bits > 0 && unit->rans.at < unit->rans.end)
        unit->rans.at++;
    at->bits = 0;
    return true;
}

bool lode_class_read(struct unit *unit, bool goes_on, const struct tiles *tiles, const int64_t *bands, int64_t count,
                     int64_t first, int64_t last, const uint8_t *data, int64_t size, struct class_place *at,
                     int64_t *budget) {
    uint32_t *states = (uint32_t *)tiles->model + CLASS_STATES;
    if (states[0] == 0) /* that of a unit is never 0 once it has begun */
        at->bytes = start_unit(tiles->model, states, data, size);
    load_contexts(&unit->contexts, tiles->model);
    unit->tiles = tiles;
    unit->plane = goes_on ? unit->plane : -1;
    unit->pending = 0;
    unit->near_end = false;
    unit->rans = (struct rans){{states[0], states[1]}, data + at->bytes, data + size};
    while (at->passes <= first - last && read_pass(unit, bands, count, first - at->passes, at, budget)) {
        at->passes++;
        at->band = 0;
    }
    know_pending(unit, bands, count);
    int64_t left = unit->rans.end - unit->rans.at;
    at->bytes = size - (left > 0 ? left : 0);
    states[0] = unit->rans.states[0];
    states[1] = unit->rans.states[1];
    store_contexts(&unit->contexts, tiles->model);
    return at->passes > first - last;
}

/* Coefficients of a unit; more than `most` where there are more. */
static int64_t count_coefficients(const int64_t *bands, int64_t count, int64_t most) {
    int64_t coefficients = 0;
    for (int64_t b = 0; b < count && coefficients <= most; b++)
        coefficients += bands[b * BAND_FIELDS + BAND_ROWS] * bands[b * BAND_FIELDS + BAND_COLUMNS];
    return coefficients;
}

/* List the decisions of a pass, forwards; how many raw bits it has, or -1 where there is no room. */
static int64_t list_pass(struct unit *unit, const int64_t *bands, int64_t count, int64_t number, const symbol_t *end) {
    int plane = (int)(number >> 1);
    int64_t bits = 0, done = 0;
    enter_plane(unit, plane);
    begin_pass(unit, number);
    for (int64_t b = 0; b < count; b++) {
        struct band band = band_of(bands + b * BAND_FIELDS);
        for (int64_t s = 0, stripes = stripes_in(&band); s < stripes; s++, done++) {
            struct stripe stripe = stripe_of(&band, s);
            if (end - unit->symbols < MOST_IN_STRIPE)
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

int64_t lode_class_write(struct unit *unit, const struct tiles *tiles, const int64_t *bands, int64_t count,
                         int64_t first, const struct class_output *output, int64_t *budget) {
    int64_t decisions[MOST_PASSES + 1], bits[MOST_PASSES];
    int64_t coefficients = count_coefficients(bands, count, output->symbols_count);
    if (coefficients > output->symbols_count / ((first >> 1) + 1)) /* else no more work than memory */
        return -1;
    *budget -= coefficients * (first + 1);
    unit->tiles = tiles;
    unit->plane = -1;
    unit->symbols = output->symbols;
    unit->rans = (struct rans){{0, 0}, 0, 0};
    start_contexts(tiles->model);
    load_contexts(&unit->contexts, tiles->model);
    know_all(tiles, bands, count);
    decisions[first + 1] = 0;
    for (int64_t number = first; number >= 0; number--) {
        bits[number] = list_pass(unit, bands, count, number, output->symbols + output->symbols_count);
        if (bits[number] < 0)
            return -1;
        decisions[number] = unit->symbols - output->symbols;
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
