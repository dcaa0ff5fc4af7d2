/* The embedded coder: tiles, bit-plane by bit-plane (docs/format.md, "Passes" and "Numbers of contexts").
 *
 * A plane takes two passes over a tile's bands, each over the blocks of 8 x 8 coefficients in raster order. The first
 * visits insignificant coefficients with a significant neighbour, the second all others. What contexts see is summed up
 * for a row of a block before the row is coded; only what its own bits add follows from coefficient to coefficient.
 */
#include "band_fields.h"
#include "binary_coder.h"
#include "logarithm.h"
#include "surroundings.h"
#include "trellis.h"

enum {
    KINDS = 4,
    /* Contexts, and the weights behind them: across, around, signs, flags. */
    ACROSS_OF_CLASS = 5 * 5 * KINDS,
    AROUND = 4 * ACROSS_OF_CLASS,
    AROUND_OF_CLASS = 7 * 6,
    SIGNS = AROUND + 2 * AROUND_OF_CLASS,
    FLAGS = SIGNS + 9 * KINDS,
    WEIGHTS = FLAGS + 27,
    /* Of a trellis, those of the lowest plane: across and around for either quantiser and classes 0 and 1. */
    TRELLIS_ACROSS = WEIGHTS + 4,
    TRELLIS_AROUND = TRELLIS_ACROSS + 2 * 2 * ACROSS_OF_CLASS,
    TRELLIS_WEIGHTS = TRELLIS_AROUND + 2 * 2 * AROUND_OF_CLASS,
    TRELLIS_END = TRELLIS_WEIGHTS + 8,
    MOST_PASSES = 2 * 28,
    /* Of a block's flags: whether a coefficient is significant, or all are. */
    SOME_FOUND = 1,
    ALL_FOUND = 2,
};

_Static_assert(LODE_MODEL == TRELLIS_ACROSS && LODE_TRELLIS_MODEL == TRELLIS_END, "models as lodestream.h has them");

/* A first pass; a second one; the only one of the lowest plane of indices. */
enum pass { FIRST, SECOND, LOWEST };

struct tiles {
    uint32_t *known;
    int8_t *sign;
    uint8_t *flags, *early;
    const int32_t *truth;
    int32_t *model; /* of the tile */
};

struct band {
    int64_t offset, stride, rows, columns, flags, across, parent, parent_stride;
    int row_shift, column_shift, kind;
};

/* One row of a block on its way. */
struct visit {
    uint32_t left, seen; /* a bit for each coefficient that is still to be visited, that was or is to be */
    uint32_t zeros;      /* in first passes, the insignificant ones */
    uint32_t bits;       /* writing, those of the plane */
    int64_t at;          /* where the first coefficient stands */
};

LODE_INLINE uint32_t magnitude(int32_t value) {
    uint32_t sign = value < 0 ? UINT32_MAX : 0;
    return ((uint32_t)value ^ sign) - sign;
}

static const uint32_t PLACES[BLOCK] = {1, 2, 4, 8, 16, 32, 64, 128};

/* Bits of a plane of eight coefficients. */
LODE_INLINE uint32_t plane_bits(const int32_t *truth, int plane) {
    uint32_t bits = 0;
    for (int j = 0; j < BLOCK; j++)
        bits |= (0 - (magnitude(truth[j]) >> plane & 1)) & PLACES[j];
    return bits;
}

LODE_INLINE void add_known(uint32_t *known, uint32_t bits, int plane) {
    for (int j = 0; j < BLOCK; j++)
        known[j] += ((bits & PLACES[j]) == PLACES[j] ? UINT32_C(1) : 0) << plane;
}

LODE_INLINE void code_sign(bool reads, struct coder *coder, const struct tiles *tiles, const struct band *band,
                           int64_t at) {
    int8_t *sign = tiles->sign + at;
    int x = clamped(sign[-1] + sign[1], -1, 1), y = clamped(sign[-band->stride] + sign[band->stride], -1, 1);
    int bit = reads ? 0 : tiles->truth[at] < 0;
    bit = code_bit(reads, coder, bit, &tiles->model[SIGNS + KINDS * (3 * (x + 1) + y + 1) + band->kind]);
    *sign = (int8_t)(1 - 2 * bit);
}

/* Code a row whose visited coefficients are all of the classes 2 and 3; its bits. */
LODE_INLINE uint32_t refine_row(bool reads, struct coder *coder, const struct tiles *tiles, const struct band *band,
                                const struct row *row, const struct visit *visit) {
    int32_t *across = tiles->model + band->kind;
    uint32_t ones = 0; /* one place up */
    for (uint32_t left = visit->left; left; left &= left - 1) {
        int j = __builtin_ctz(left);
        int32_t slot = row->across[j] + 5 * (int32_t)((ones & row->room) >> j & 1);
        int bit = code_bit(reads, coder, (int)(visit->bits >> j & 1), across + KINDS * slot);
        ones |= (uint32_t)bit << j << 1;
    }
    return ones >> 1;
}

/* Code any row; its bits. `state` is that of the trellis. */
LODE_INLINE uint32_t code_row(bool reads, enum pass pass, struct coder *coder, const struct tiles *tiles,
                              const struct band *band, const struct row *row, struct visit *visit, int32_t *weights,
                              int *state) {
    int32_t *model = tiles->model;
    uint32_t ones = 0; /* one place up */
    while (visit->left) {
        int j = __builtin_ctz(visit->left), own = pass == FIRST ? 0 : row->own[j], bit = (int)(visit->bits >> j & 1);
        visit->left &= visit->left - 1;
        int32_t slot = KINDS * (row->across[j] + 5 * (int32_t)((ones & row->room) >> j & 1)) + band->kind;
        if (own > 1) {
            bit = code_bit(reads, coder, bit, model + slot);
            ones |= (uint32_t)bit << j << 1;
        } else {
            int odd = pass == LOWEST ? ODD[*state] : 0;
            int32_t *across = model + slot, *around = model + AROUND, *pair = weights + 4 * odd;
            if (pass == LOWEST) {
                across += TRELLIS_ACROSS + 2 * ACROSS_OF_CLASS * odd;
                around += TRELLIS_AROUND - AROUND + 2 * AROUND_OF_CLASS * odd;
            }
            around += row->around[j] + RING[SEVENTEEN[row->far[j]] + row->sides[j] + 2 * (2 * ones >> j & 1)];
            if (own == 1) {
                bit = code_mixed_bit(reads, coder, bit, across, around, pair + 2);
                ones |= (uint32_t)bit << j << 1;
            } else {
                bit = code_guessed_bit(reads, coder, bit, across, around, pair);
                if (bit) {
                    ones |= UINT32_C(2) << j;
                    code_sign(reads, coder, tiles, band, visit->at + j);
                    if (pass == FIRST) {
                        visit->left |= visit->zeros & UINT32_C(2) << j;
                        visit->seen |= visit->zeros & UINT32_C(2) << j;
                    }
                }
            }
        }
        if (pass == LOWEST)
            *state = TRANSITIONS[*state][bit];
    }
    return ones >> 1;
}

/* The state of the trellis after so many indices of 0: after four it is the same again. */
static int after_zeros(int state, int64_t count) {
    for (int64_t i = 0; i < (count & 3); i++)
        state = TRANSITIONS[state][0];
    return state;
}

/* A block of a band. */
struct block {
    int64_t top, left, rows, columns, flag;
};

/* Code whether a block gets a significant coefficient, which has none so far. */
LODE_INLINE int code_flag(bool reads, struct coder *coder, const struct tiles *tiles, const struct band *band,
                          const struct block *block, int plane) {
    int64_t first = block->top >> band->row_shift, last = (block->top + block->rows - 1) >> band->row_shift;
    int64_t left = block->left >> band->column_shift, right = (block->left + block->columns - 1) >> band->column_shift;
    const uint32_t *parents = tiles->known + band->parent;
    uint32_t family = 0, seen = 0;
    for (int64_t i = first; i <= last; i++)
        for (int64_t j = left; j <= right; j++)
            family |= parents[i * band->parent_stride + j];
    family >>= plane;
    if (!reads) {
        const int32_t *truth = tiles->truth + band->offset + block->top * band->stride + block->left;
        for (int64_t i = 0; i < block->rows; i++, truth += band->stride)
            for (int64_t j = 0; j < block->columns; j++)
                seen |= magnitude(truth[j]);
    }
    const uint8_t *flag = tiles->flags + block->flag;
    int before = (flag[-1] != 0) + (flag[-band->across - 1] != 0);
    int after = (flag[1] != 0) + (flag[band->across + 1] != 0);
    int slot = FLAGS + (before * 3 + after) * 3 + (int)(family < 2 ? family : 2);
    return code_bit(reads, coder, seen >> plane != 0, &tiles->model[slot]);
}

/* Sum up what is around a row, the i-th with the margin, before its bits. */
LODE_INLINE void see_row(enum pass pass, struct surroundings *s, const struct tiles *tiles, const struct band *band,
                         const struct block *block, int64_t i, int plane, struct row *row) {
    if (!s->around) {
        int64_t first = block->top >> band->row_shift, last = (block->top + block->rows - 1) >> band->row_shift;
        int64_t corner = band->parent + (first - 1) * band->parent_stride + (block->left >> band->column_shift) - 1;
        see_around(s, block->rows);
        load_units(tiles->known + corner, band->parent_stride, last - first + 3, plane, MOST_OF_PARENTS, s->parents);
    }
    int64_t parent_row = ((block->top + i - MARGIN) >> band->row_shift) - (block->top >> band->row_shift);
    eight_t around = families(s, parent_row);
    if (band->column_shift)
        around = band->column_shift == NO_PARENT ? repeated(around) : doubled(around);
    if (pass != FIRST)
        around += AROUND_OF_CLASS * (s->own[i] >> 1 & EACH);
    put_eight(row->around, around);
    put_eight(row->far, s->far[i - 2] + s->far[i + 2]);
    put_eight(row->sides, s->sides[i - 1] + s->sides[i + 1] + 2 * s->sides[i]);
}

/* Code the row of a block that has so many columns, the i-th with the margin. */
LODE_INLINE void visit_row(bool reads, enum pass pass, struct coder *coder, const struct tiles *tiles,
                           const struct band *band, const struct block *block, struct surroundings *s, int64_t i,
                           int plane, int32_t *weights, int *state) {
    int64_t at = band->offset + (block->top + i - MARGIN) * band->stride + block->left;
    uint32_t inside = (UINT32_C(1) << block->columns) - 1;
    struct visit visit = {0, 0, 0, 0, at};
    struct row row;
    if (pass == FIRST) {
        visit.zeros = ~(s->found[i] >> 1) & inside;
        visit.left = to_visit_first(s, i, visit.zeros);
    } else if (pass == SECOND) {
        eight_t unlike = eight_at(tiles->early + at) ^ (uint64_t)(plane + 1) * EACH;
        visit.left = bits_of(reaching(unlike & 127 * EACH, 1)) & inside;
    } else {
        visit.left = inside;
    }
    if (visit.left == 0)
        return;
    visit.seen = visit.left;
    if (!reads)
        visit.bits = plane_bits(tiles->truth + at, plane);
    eight_t side = eight_at(s->units[i] + 1) + eight_at(s->units[i] + 3), full = reaching(side, 4);
    eight_t across = 5 * at_most(side, 4) + at_most(s->own[i - 1] + s->own[i + 1], 4);
    row.room = ~bits_of(full);
    uint32_t low = UINT32_MAX; /* coefficients of the classes 0 and 1 */
    if (pass != FIRST) {
        eight_t two = reaching(s->own[i], 4), own = reaching(s->own[i], 2) + two + reaching(s->own[i], 8);
        put_eight(row.own, own);
        across += 25 * own;
        low = ~bits_of(two);
    }
    put_eight(row.across, across);
    uint32_t ones;
    if (pass == LOWEST || visit.left & low) {
        see_row(pass, s, tiles, band, block, i, plane, &row);
        ones = code_row(reads, pass, coder, tiles, band, &row, &visit, weights, state);
    } else {
        ones = refine_row(reads, coder, tiles, band, &row, &visit);
    }
    add_bits(s, i, ones);
    add_known(tiles->known + at, ones, plane);
    if (pass == FIRST) {
        s->found[i] |= ones << 1;
        eight_t seen = ones_of(visit.seen), marks = eight_at(tiles->early + at);
        put_eight(tiles->early + at, (marks & ~(255 * seen)) + (uint64_t)(plane + 1) * seen);
    }
}

/* Whether all coefficients of a block are significant. */
static bool all_found(const struct surroundings *s, const struct block *block) {
    uint32_t inside = ((UINT32_C(1) << block->columns) - 1) << 1, found = inside;
    for (int64_t i = MARGIN; i < block->rows + MARGIN; i++)
        found &= s->found[i];
    return found == inside;
}

/* Code a block. */
LODE_INLINE void code_block(bool reads, enum pass pass, struct coder *coder, const struct tiles *tiles,
                            const struct band *band, const struct block *block, int plane, int32_t *weights,
                            int *state) {
    uint8_t *flag = tiles->flags + block->flag;
    if (pass == FIRST && *flag != SOME_FOUND)
        return;
    if (!*flag) {
        if (!code_flag(reads, coder, tiles, band, block, plane)) {
            if (pass == LOWEST)
                *state = after_zeros(*state, block->rows * block->columns);
            return;
        }
        *flag = SOME_FOUND;
    }
    struct surroundings s;
    see_block(&s, tiles->known + band->offset + block->top * band->stride + block->left, band->stride, block->rows,
              plane);
    if (pass == FIRST) {
        see_found(&s, block->rows);
        if (all_found(&s, block)) {
            *flag = ALL_FOUND;
            return;
        }
    }
    for (int64_t i = MARGIN; i < block->rows + MARGIN; i++)
        visit_row(reads, pass, coder, tiles, band, block, &s, i, plane, weights, state);
}

/* Code the blocks of a band, from number `first` on, until all are done or so many coefficients were looked at as
 * `budget` says, which becomes less; the first block that is not done. */
LODE_INLINE int64_t code_blocks(bool reads, enum pass pass, struct coder *kept, const struct tiles *tiles,
                                const struct band *band, int64_t first, int plane, int *state, int64_t *budget) {
    struct coder coder = *kept;
    int32_t *model_weights = tiles->model + (pass == LOWEST ? TRELLIS_WEIGHTS : WEIGHTS), weights[8];
    int count = pass == LOWEST ? 8 : 4, own_state = *state;
    for (int i = 0; i < count; i++)
        weights[i] = clamped(model_weights[i], -HEAVIEST, HEAVIEST);
    int64_t down = (band->rows + BLOCK - 1) / BLOCK, number = first, spent = 0;
    for (; number < down * band->across && spent < *budget; number++) {
        int64_t row = number / band->across, top = row * BLOCK, left = (number - row * band->across) * BLOCK;
        int64_t rows = band->rows - top, columns = band->columns - left;
        struct block block = {top, left, rows < BLOCK ? rows : BLOCK, columns < BLOCK ? columns : BLOCK,
                              band->flags + number + row};
        code_block(reads, pass, &coder, tiles, band, &block, plane, weights, &own_state);
        spent += tiles->flags[block.flag] == SOME_FOUND ? BLOCK * BLOCK : BLOCK;
    }
    for (int i = 0; i < count; i++)
        model_weights[i] = weights[i];
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

static struct band band_of(const int64_t *fields) {
    return (struct band){
        .offset = fields[BAND_OFFSET],
        .stride = fields[BAND_STRIDE],
        .rows = fields[BAND_ROWS],
        .columns = fields[BAND_COLUMNS],
        .flags = fields[BAND_FLAGS],
        .across = (fields[BAND_COLUMNS] + BLOCK - 1) / BLOCK,
        .parent = fields[BAND_PARENT],
        .parent_stride = fields[BAND_PARENT_STRIDE],
        .row_shift = (int)fields[BAND_ROW_SHIFT],
        .column_shift = (int)fields[BAND_COLUMN_SHIFT],
        .kind = (int)fields[BAND_KIND],
    };
}

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
    if (!is_shift(fields[BAND_ROW_SHIFT]) || !is_shift(fields[BAND_COLUMN_SHIFT]) || fields[BAND_KIND] >= KINDS)
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
    int64_t band, bands, model, first, last, start, length;
};

static struct run run_of(const int64_t *fields) {
    return (struct run){
        fields[0], fields[1], fields[2], fields[3], fields[4], fields[LODE_RUN_START], fields[LODE_RUN_LENGTH]};
}

static bool run_fits(const struct run *run, int64_t bands, int64_t models, int64_t data, int64_t costs) {
    return run->band >= 0 && run->bands >= 0 && run->band <= bands && run->bands <= bands - run->band &&
           run->model >= 0 && run->model < models && run->last >= 0 && run->first >= -1 && run->first < MOST_PASSES &&
           (costs == 0 || run->first < costs) && run->start >= 0 && run->length >= 0 && run->start <= data &&
           run->length <= data - run->start;
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
        for (; at->band < run->bands && !skipped; at->band++, at->block = 0, at->trellis = 0) {
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
           coder_can_go_on(reads, coder, 0, 0);
}

int64_t lode_passes(int64_t reads, int64_t trellis, const int64_t *bands, int64_t bands_count, int64_t *runs,
                    int64_t runs_count, int32_t *known, int64_t known_count, int8_t *sign, int64_t sign_count,
                    uint8_t *flags, int64_t flags_count, uint8_t *early, int64_t early_count, const int32_t *truth,
                    int64_t truth_count, int32_t *models, int64_t models_count, uint8_t *data, int64_t data_count,
                    double *costs, int64_t costs_count, int64_t *state, int64_t state_count, int64_t budget) {
    int64_t model = trellis ? LODE_TRELLIS_MODEL : LODE_MODEL, all = runs_count / LODE_RUN_FIELDS;
    if (bands_count % BAND_FIELDS || runs_count % LODE_RUN_FIELDS || sign_count != known_count ||
        early_count != known_count || (!reads && truth_count != known_count) || models_count % model ||
        state_count != LODE_PASSES_STATE || state[AT_RUN] < 0 || state[AT_RUN] > all || budget < 1)
        return LODE_REFUSED;
    for (int64_t number = state[AT_RUN]; number < all; number++) {
        struct run run = run_of(runs + number * LODE_RUN_FIELDS);
        if (!run_fits(&run, bands_count / BAND_FIELDS, models_count / model, data_count, costs_count))
            return LODE_REFUSED;
        for (int64_t band = run.band; band < run.band + run.bands; band++)
            if (!band_fits(bands + band * BAND_FIELDS, known_count, flags_count))
                return LODE_REFUSED;
    }
    struct position at = {state[AT_RUN], state[AT_PASSES], state[AT_BAND], state[AT_BLOCK],
                          (int)(state[AT_TRELLIS] & (TRELLIS_STATES - 1))};
    for (; at.run < all && budget > 0; at = (struct position){at.run + 1, 0, 0, 0, 0}) {
        int64_t *fields = runs + at.run * LODE_RUN_FIELDS;
        struct run run = run_of(fields);
        struct tiles tiles = {(uint32_t *)known, sign, flags, early, truth, models + run.model * model};
        struct coder coder;
        if (!go_on(reads, &run, &at, state, data, &coder))
            return LODE_REFUSED;
        if (!code_run(reads, trellis, &coder, &tiles, bands, &run, &at, costs_count ? costs : 0, &budget)) {
            state[AT_LOW] = (int64_t)coder.low;
            state[AT_WIDTH] = coder.width;
            state[AT_PLACE] = coder.place;
            break;
        }
        if (!reads)
            fields[LODE_RUN_LENGTH] = coder_finish(&coder);
        if (fields[LODE_RUN_LENGTH] < 0)
            return LODE_REFUSED;
    }
    state[AT_RUN] = at.run;
    state[AT_PASSES] = at.passes;
    state[AT_BAND] = at.band;
    state[AT_BLOCK] = at.block;
    state[AT_TRELLIS] = at.trellis;
    return at.run;
}

int64_t lode_new_models(int64_t trellis, int32_t *models, int64_t models_count) {
    int64_t size = trellis ? LODE_TRELLIS_MODEL : LODE_MODEL;
    if (models_count % size)
        return LODE_REFUSED;
    for (int64_t i = 0; i < models_count; i++) {
        int64_t slot = i % size;
        bool weight = (slot >= WEIGHTS && slot < TRELLIS_ACROSS) || slot >= TRELLIS_WEIGHTS;
        models[i] = weight ? FIRST_WEIGHT : UNKNOWN_CONTEXT;
    }
    return 0;
}
