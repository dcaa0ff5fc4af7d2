/* The embedded coder: tiles, bit-plane by bit-plane (docs/format.md, "Passes").
 *
 * A plane takes two passes over a tile's bands, each over the blocks of 8 x 8 coefficients in raster order. The first
 * visits insignificant coefficients with a significant neighbour, the second all others.
 */
#include "band_fields.h"
#include "block_coder.h"
#include "class_coder.h"
#include "logarithm.h"

_Static_assert(LODE_MODEL == CONTEXTS && LODE_TRELLIS_MODEL == TRELLIS_CONTEXTS, "models as lodestream.h has them");

/* Code the blocks of a band, from number `first` on, until all are done or so many coefficients were looked at as
 * `budget` says, which becomes less; the first block that is not done. */
LODE_INLINE int64_t code_blocks(bool reads, enum pass pass, struct coder *kept, const struct tiles *tiles,
                                const struct band *band, int64_t first, int plane, int *state, int64_t *budget) {
    struct coder coder = *kept;
    int own_state = *state;
    int64_t down = (band->rows + BLOCK - 1) / BLOCK, number = first, spent = 0;
    for (; number < down * band->across && spent < *budget; number++) {
        int64_t row = number / band->across, top = row * BLOCK, left = (number - row * band->across) * BLOCK;
        int64_t rows = band->rows - top, columns = band->columns - left;
        own_state = left == 0 ? 0 : own_state;
        struct block block = {top, left, rows < BLOCK ? rows : BLOCK, columns < BLOCK ? columns : BLOCK,
                              band->flags + number + row};
        code_block(reads, pass, &coder, tiles, band, &block, plane, &own_state);
        spent += tiles->flags[block.flag] ? BLOCK * BLOCK : BLOCK;
    }
    *kept = coder;
    *state = own_state;
    *budget -= spent;
    return number;
}

/* Each kind of pass is compiled for itself. */
#define COMPILED(name, reads, pass)                                                                                    \
    static int64_t name(struct coder *coder, const struct tiles *tiles, const struct band *band, int64_t first,        \
                        int plane, int *state, int64_t *budget) {                                                      \
        return code_blocks(reads, pass, coder, tiles, band, first, plane, state, budget);                              \
    }

COMPILED(read_first, true, FIRST)
COMPILED(read_second, true, SECOND)
COMPILED(read_lowest, true, LOWEST)
COMPILED(write_first, false, FIRST)
COMPILED(write_second, false, SECOND)
COMPILED(write_lowest, false, LOWEST)

typedef int64_t (*blocks_t)(struct coder *, const struct tiles *, const struct band *, int64_t, int, int *, int64_t *);

static const blocks_t BLOCKS_OF[2][3] = {{write_first, write_second, write_lowest},
                                         {read_first, read_second, read_lowest}};

static bool is_shift(int64_t shift) {
    return shift == 0 || shift == 1 || shift == NO_PARENT;
}

/* Whether all that is looked at of a band, its flags and its parents lies in arrays of these lengths. */
static bool band_fits(const int64_t *fields, int64_t size, int64_t flags) {
    for (int i = 0; i < BAND_FIELDS; i++)
        if (fields[i] < 0 || fields[i] > INT64_C(1)
                                             << (i == BAND_OFFSET || i == BAND_FLAGS || i == BAND_PARENT ? 40 : 31))
            return false;
    struct band band = band_of(fields);
    if (band.stride < 1 || band.stride < band.columns || !is_shift(fields[BAND_ROW_SHIFT]) ||
        !is_shift(fields[BAND_COLUMN_SHIFT]) || fields[BAND_KIND] >= KINDS)
        return false;
    if (band.rows == 0 || band.columns == 0)
        return true;
    int64_t down = (band.rows + BLOCK - 1) / BLOCK, left = BLOCK * (band.across - 1);
    int64_t parent_row = ((band.rows - 1) >> band.row_shift) + 1, parent_column = (left >> band.column_shift) - 1;
    return band.offset - MARGIN * band.stride - MARGIN >= 0 &&
           band.offset + (band.rows + 1) * band.stride + left - MARGIN + WIDE <= size &&
           band.flags - band.across - 1 >= 0 && band.flags + down * (band.across + 1) + band.across <= flags &&
           band.parent - band.parent_stride - 1 >= 0 &&
           band.parent + parent_row * band.parent_stride + parent_column + WIDE <= size;
}

/* Passes of one tile: a row of the table of runs. */
struct run {
    int64_t band, bands, model, first, last, start, length, large;
};

static struct run run_of(const int64_t *fields) {
    return (struct run){fields[0],
                        fields[1],
                        fields[2],
                        fields[3],
                        fields[4],
                        fields[LODE_RUN_START],
                        fields[LODE_RUN_LENGTH],
                        fields[LODE_RUN_LARGE]};
}

static bool run_fits(const struct run *run, int64_t bands, int64_t models, int64_t data, int64_t costs) {
    return run->band >= 0 && run->bands >= 0 && run->band <= bands && run->bands <= bands - run->band &&
           run->model >= 0 && run->model < models && run->last >= 0 && run->last < MOST_PASSES && run->first >= -1 &&
           run->first < MOST_PASSES && (costs == 0 || run->first < costs) && run->start >= 0 && run->length >= 0 &&
           run->start <= data && run->length <= data - run->start && (run->large & ~INT64_C(1)) == 0;
}

/* Where the walk stands: the run, and in it passes that are done, band, block, state of the trellis. */
struct position {
    int64_t run, passes, band, block;
    int trellis;
};

enum { AT_RUN, AT_PASSES, AT_BAND, AT_BLOCK, AT_TRELLIS, AT_LOW, AT_WIDTH, AT_PLACE, AT_END };

_Static_assert(AT_END == LODE_PASSES_STATE && sizeof(struct run) == sizeof(int64_t) * LODE_RUN_FIELDS,
               "as lodestream.h has them");

/* Go on with a run until it is done or the budget is spent; whether it is done. */
static bool code_run(bool reads, bool trellis, struct coder *coder, const struct tiles *tiles, const int64_t *bands,
                     const struct run *run, struct position *at, double *costs, int64_t *budget) {
    for (; at->passes <= run->first - run->last; at->passes++, at->band = 0) {
        int64_t number = run->first - at->passes;
        int plane = (int)(number >> 1);
        enum pass pass = number & 1 ? FIRST : trellis && plane == 0 ? LOWEST : SECOND;
        bool skipped = trellis && number == 1;
        for (; at->band < run->bands && !skipped; at->band++, at->block = 0) {
            struct band band = band_of(bands + (run->band + at->band) * BAND_FIELDS);
            at->block = BLOCKS_OF[reads][pass](coder, tiles, &band, at->block, plane, &at->trellis, budget);
            if (at->block < (band.rows + BLOCK - 1) / BLOCK * band.across)
                return false;
        }
        if (costs)
            costs[number] = 8.0 * (double)coder->place + 32.0 - log2_of((double)coder->width);
    }
    return true;
}

/* The coder of a run: a new one, or as it was kept. */
static bool go_on(bool reads, const struct run *run, const struct position *at, const int64_t *state, uint8_t *data,
                  struct coder *coder) {
    *coder = coder_start(reads, data + run->start, run->length);
    if (!(at->passes || at->band || at->block))
        return true;
    coder->low = (uint64_t)state[AT_LOW];
    coder->width = (uint32_t)state[AT_WIDTH];
    coder->place = state[AT_PLACE];
    return at->passes >= 0 && at->band >= 0 && at->block >= 0 && (uint64_t)state[AT_WIDTH] <= WIDEST &&
           coder_can_go_on(reads, coder);
}

enum outcome { DONE, PAUSED, REFUSED };

/* Go on with a run of a large unit until it is done or the budget is spent. */
static enum outcome read_large(struct unit *unit, bool goes_on, const struct run *run, const struct tiles *tiles,
                               const int64_t *bands, const uint8_t *data, struct position *at, int64_t *state,
                               int64_t *budget) {
    struct class_place place = {at->passes, at->band, at->block, 0, 0};
    if (at->passes || at->band || at->block) {
        place.bytes = state[AT_PLACE];
        place.bits = (int)(state[AT_LOW] & 7);
        if (state[AT_LOW] != place.bits)
            return REFUSED;
    }
    if (place.passes < 0 || place.band < 0 || place.stripe < 0 || place.bytes < 0 || place.bytes > run->length)
        return REFUSED;
    bool done = lode_class_read(unit, goes_on, tiles, bands + run->band * BAND_FIELDS, run->bands, run->first,
                                run->last, data + run->start, run->length, &place, budget);
    *at = (struct position){at->run, place.passes, place.band, place.stripe, 0};
    state[AT_PLACE] = place.bytes;
    state[AT_LOW] = place.bits;
    return done ? DONE : PAUSED;
}

int64_t lode_passes(int64_t reads, int64_t trellis, const struct lode_passes *arguments) {
    const struct lode_passes call = *arguments;
    int64_t budget = call.budget;
    int64_t model = trellis ? LODE_TRELLIS_MODEL : LODE_MODEL, all = call.runs_count / LODE_RUN_FIELDS;
    if (call.bands_count % BAND_FIELDS || call.runs_count % LODE_RUN_FIELDS || call.sign_count != call.known_count ||
        call.early_count != call.known_count || (!reads && call.truth_count != call.known_count) ||
        call.models_count % model || call.state_count != LODE_PASSES_STATE || call.state[AT_RUN] < 0 ||
        call.state[AT_RUN] > all || budget < 1)
        return LODE_REFUSED;
    struct position at = {call.state[AT_RUN], call.state[AT_PASSES], call.state[AT_BAND], call.state[AT_BLOCK],
                          (int)(call.state[AT_TRELLIS] & (TRELLIS_STATES - 1))};
    struct unit unit;
    struct run before = {0};
    for (; at.run < all && budget > 0; at = (struct position){at.run + 1, 0, 0, 0, 0}) {
        int64_t *fields = call.runs + at.run * LODE_RUN_FIELDS;
        struct run run = run_of(fields);
        if (!run_fits(&run, call.bands_count / BAND_FIELDS, call.models_count / model, call.data_count,
                      call.costs_count))
            return LODE_REFUSED;
        for (int64_t band = run.band; band < run.band + run.bands; band++)
            if (!band_fits(call.bands + band * BAND_FIELDS, call.known_count, call.flags_count))
                return LODE_REFUSED;
        struct tiles tiles = {(uint32_t *)call.known,         call.sign, call.flags, call.early, call.truth,
                              call.models + run.model * model};
        if (run.large && trellis)
            return LODE_REFUSED;
        if (run.large && reads) {
            bool goes_on =
                before.large && before.band == run.band && before.bands == run.bands && before.model == run.model;
            before = run;
            enum outcome outcome =
                read_large(&unit, goes_on, &run, &tiles, call.bands, call.data, &at, call.state, &budget);
            if (outcome == REFUSED)
                return LODE_REFUSED;
            if (outcome == PAUSED)
                break;
            continue;
        }
        if (run.large) {
            struct class_output output = {call.symbols, call.symbols_count, call.data + run.start, run.length,
                                          call.costs};
            fields[LODE_RUN_LENGTH] = -1;
            if (run.first >= 0 && run.last == 0 && run.first < call.costs_count)
                fields[LODE_RUN_LENGTH] = lode_class_write(&unit, &tiles, call.bands + run.band * BAND_FIELDS,
                                                           run.bands, run.first, &output, &budget);
            if (fields[LODE_RUN_LENGTH] < 0)
                return LODE_REFUSED;
            continue;
        }
        before = run;
        struct coder coder;
        if (!go_on(reads, &run, &at, call.state, call.data, &coder))
            return LODE_REFUSED;
        if (!code_run(reads, trellis, &coder, &tiles, call.bands, &run, &at, call.costs_count ? call.costs : 0,
                      &budget)) {
            call.state[AT_LOW] = (int64_t)coder.low;
            call.state[AT_WIDTH] = coder.width;
            call.state[AT_PLACE] = coder.place;
            break;
        }
        if (!reads)
            fields[LODE_RUN_LENGTH] = coder_finish(&coder);
        if (fields[LODE_RUN_LENGTH] < 0)
            return LODE_REFUSED;
    }
    call.state[AT_RUN] = at.run;
    call.state[AT_PASSES] = at.passes;
    call.state[AT_BAND] = at.band;
    call.state[AT_BLOCK] = at.block;
    call.state[AT_TRELLIS] = at.trellis;
    return at.run;
}
