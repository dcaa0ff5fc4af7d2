/* The compiled kernels of Lodestream: all that core/lodestream/kernels.py declares and calls.
 *
 * An array is a pointer and, behind it, its number of elements. Arrays of arrays are in C order; `rows` of a plane that
 * need not lie side by side come as pointer, rows, columns, and `pitch`, the elements from one row to the next. The
 * caller owns all memory and has checked types; nothing here allocates, keeps anything between calls, or calls a
 * library. A kernel with more than eight arguments takes those after its first integers in a struct, which it does not
 * change. `reads` chooses between the two directions of a coder: 1 reads `data` and fills what it describes, 0 writes.
 *
 * What comes from a stream may hold anything: results are then wrong numbers, but no access leaves an array.
 * Where lengths and places that the caller gives do not fit each other, the answer is LODE_REFUSED and arrays that
 * would have been written are undefined.
 *
 * No call takes longer than about a tenth of a second, so that whoever waits can be interrupted: the caller divides
 * what is larger.
 */
#ifndef LODESTREAM_H
#define LODESTREAM_H

#include <stdint.h>

#define LODE_REFUSED INT64_MIN

#if defined(_WIN32)
#define LODE_API __declspec(dllexport)
#else
#define LODE_API __attribute__((visibility("default")))
#endif

/* The hash of the sources that the library was compiled from, 16 hexadecimal digits and a zero. */
LODE_API const char *lode_sources(void);

/* 1 where the processor and the system run what is compiled for x86-64-v3 (AVX2), else 0. */
LODE_API int lode_runs_v3(void);

/* lifting.c ------------------------------------------------------------------------------------------------------ */

#define LODE_LIFT_STRIP 64
#define LODE_LIFT_BARE 2

/* One step of the lifting along an axis of a plane, or its inverse, in place: samples on one side, on the other nodes
 * of the coarser level and behind them the details. Exact for samples within +-2^27 and for coefficients below 2^29;
 * what is larger gives numbers without a meaning. The inverse leaves samples within +-2^27.
 *
 * inverse:   0; 1 for the inverse; LODE_LIFT_BARE for the inverse where all details are 0, whatever stands there.
 * axis:      0 along columns, 1 along rows.
 * midpoints: details, at least 1; `run`: nodes that alternate with them, `midpoints` where the axis wraps, else one
 *            more. A sample that the axis has beyond these is a node by itself.
 * table:     20 rows of two: for the ten places before the details and the ten after them, the detail that stands there
 *            and the sign, -1, 0 or 1, that it takes.
 * a, b:      of the third step, within +-127; both 0: none.
 * from:      0, or what the call before for this plane has returned.
 * work:      kept from call to call: at least 16 + (midpoints + run + 25) lines, where `lines` is LODE_LIFT_STRIP along
 *            LODE_LIFT_STRIP / 4 or more columns, otherwise 1.
 * Returns how many nodes are done: `run`, except on very long axes where the plane is one row, one column, or at most
 * LODE_LIFT_STRIP columns and at least a quarter of them. The first call of an inverse copies all nodes of a line,
 * which alone takes longer than a tenth of a second where they are more than 2^25.
 */
struct lode_lift {
    int32_t *x;
    int64_t rows, columns, pitch, midpoints, run;
    const int64_t *table;
    int64_t table_count, a, b, from;
    int32_t *work;
    int64_t work_count;
};

LODE_API int64_t lode_lift(int64_t inverse, int64_t axis, const struct lode_lift *arguments);

/* inverse.c ------------------------------------------------------------------------------------------------------ */

#define LODE_INVERSE_STEP 53
#define LODE_INVERSE_PLANE 4
#define LODE_INVERSE_NOTHING 0
#define LODE_INVERSE_REFINE 3
#define LODE_INVERSE_NODES 4
#define LODE_INVERSE_DETAILS 5

/* Inverse steps of the lifting one after another, in place, in the first rows and columns of some planes.
 *
 * steps:  rows of LODE_INVERSE_STEP: what is done, the number of the plane, the axis, rows and columns that take part,
 *         `midpoints`, `run`, `a`, `b` and `table` as lode_lift takes them, then `source`, `from`, `by` and `line`.
 * planes: rows of LODE_INVERSE_PLANE: where in `x` a plane begins, its rows and columns, and from one row to the next.
 * x:      all planes.
 * work:   as much as the step takes that needs most; LODE_INVERSE_DETAILS takes `columns` more than lode_lift.
 *
 * 1 and LODE_LIFT_BARE are done as by lode_lift, LODE_INVERSE_NOTHING does nothing. LODE_INVERSE_REFINE keeps values
 * within +-2^24 and multiplies them by 8; only rows and columns matter.
 *
 * LODE_INVERSE_NODES makes the first `columns` values of the line of number `line` along the axis those of another
 * plane's first column: of the plane `source`, from row `from` on, each `by` rows after the one before, which is 1, -1
 * or 0. LODE_INVERSE_DETAILS makes the last `midpoints` of so many values the details that a forward step finds in such
 * points, and 0 where `by` is: they are one point. For both `rows` means nothing.
 *
 * Together the steps should have no more than some million values. Returns 0. */
LODE_API int64_t lode_inverse(const int64_t *steps, int64_t steps_count, const int64_t *planes, int64_t planes_count,
                              int32_t *x, int64_t x_count, int32_t *work, int64_t work_count);

/* mask.c --------------------------------------------------------------------------------------------------------- */

/* Code groups `first` to `last` - 1 of a mask of `rows` x `columns` points: LODE_MASK_GROUP points of a row, fewer at
 * its end, in raster order.
 *
 * field:  flat, (rows + 2) x (columns + 4): two rows before and two columns at either side are zeros; 1 is valid.
 * model:  LODE_MASK_MODEL contexts; begun where `first` is 0.
 * data:   writing, at least 64 + 2 rows columns bytes; reading, all there are, those missing count as zeros.
 * state:  four numbers that are handed on from call to call, as the model is; others are refused.
 * Returns the bytes written or looked at so far, all of them once the last group is coded.
 */
struct lode_mask {
    uint8_t *field;
    int64_t field_count;
    int32_t *model;
    int64_t model_count;
    uint8_t *data;
    int64_t data_count;
    int64_t *state, state_count;
};

LODE_API int64_t lode_mask(int64_t reads, int64_t rows, int64_t columns, int64_t first, int64_t last,
                           const struct lode_mask *arguments);

#define LODE_MASK_GROUP 16
#define LODE_MASK_MODEL ((1 << 10) + 4)

/* values.c ------------------------------------------------------------------------------------------------------- */

/* Values of any type are a pointer, their number, and the number of their type: int8, int16, int32, int64, uint8,
 * uint16, uint32, uint64, float32, float64 from 0 on.
 *
 * A lattice is `decimal` (1: the value is (origin + q) / step; 0: it is origin + step q), `origin`, `step`, and
 * `scale`: q is the coordinate times `scale`. All are finite, step and scale above 0.
 */

/* Values of lattice coordinates into one channel of points, of those from `first` to `last` - 1 in raster order.
 *
 * coordinates: a plane of rows x columns.
 * points:      (rows, columns, channels).
 * Returns 0.
 */
struct lode_store_values {
    const int32_t *coordinates;
    int64_t rows, columns, pitch;
    void *points;
    int64_t points_count, points_type, channels, channel, first, last, decimal;
    double origin, step, scale;
};

LODE_API int64_t lode_store_values(const struct lode_store_values *arguments);

/* Squared distances between points and the values of lattice coordinates in the type of the points, by parts of
 * LODE_PART_ROWS x LODE_PART_COLUMNS points, fewer at the ends: those from `first` to `last` - 1 in raster order.
 *
 * points:      (rows, columns, channels); differences of integers of 64 bits are taken in integers, then rounded.
 * coordinates: (compared, height, pitch), of at most three channels from `channel` on; at least as many rows and
 *              columns as points.
 * rules:       (compared, 4): of each lattice decimal, origin, step, scale.
 * counted:     (rows, columns): 0 where a point is left out; or empty: all count.
 * figures:     (parts, 1, 2), or (parts, 1 + compared, 2) where several channels are compared: of each part the sum of
 *              the squared distances, of each column from top to bottom and then of the columns from left to right, and
 *              the largest; then the same of each channel by itself.
 *
 * Returns 0.
 */
struct lode_square_distances {
    const void *points;
    int64_t points_count, points_type;
    const int32_t *coordinates;
    int64_t coordinates_count;
    const double *rules;
    int64_t rules_count;
    const uint8_t *counted;
    int64_t counted_count;
    double *figures;
    int64_t figures_count, rows, columns, channels, channel, height, pitch, first, last;
};

LODE_API int64_t lode_square_distances(const struct lode_square_distances *arguments);

#define LODE_PART_ROWS 128
#define LODE_PART_COLUMNS 256

/* holes.c -------------------------------------------------------------------------------------------------------- */

/* Of a grid of rows x columns, `known` is 1 where a point has a value that stays, 0 in a hole. `rows_wrap` and
 * `columns_wrap` are 1 where an axis is closed. The next coarser grid has (rows + 1) / 2 x (columns + 1) / 2 points,
 * rounded down.
 */

/* Means of the known points of each 2 x 2, into points `first` to `last` - 1 of the coarser grid in raster order.
 *
 * coarser: the mean, 0 where no point is known.
 * found:   1 where all points are known, or where some are and no neighbour in the coarser grid has all of them.
 * Returns 0.
 */
LODE_API int64_t lode_pull(const double *values, int64_t values_count, const uint8_t *known, int64_t known_count,
                           int64_t rows, int64_t columns, int64_t first, int64_t last, double *coarser,
                           int64_t coarser_count, uint8_t *found, int64_t found_count);

/* Give holes, of points `first` to `last` - 1, what the coarser grid has at their place, by bilinear interpolation.
 * Returns 0.
 */
struct lode_push {
    double *values;
    int64_t values_count;
    const uint8_t *known;
    int64_t known_count, rows, columns, first, last, rows_wrap, columns_wrap;
    const double *coarser;
    int64_t coarser_count;
};

LODE_API int64_t lode_push(const struct lode_push *arguments);

/* Bring holes nearer to where a thin plate would lie through what is around them: steps `first` to `last` - 1 of a walk
 * that goes over all points in raster order, then back, and so on, at most 2^20 in a call; rows x columns are a sweep.
 * Returns 0.
 */
LODE_API int64_t lode_relax(double *values, int64_t values_count, const uint8_t *known, int64_t known_count,
                            int64_t rows, int64_t columns, int64_t first, int64_t last, int64_t rows_wrap,
                            int64_t columns_wrap);

/* coefficient_classes.c ------------------------------------------------------------------------------------------ */

/* `bands` are rows of the table of bands (band_fields.h); `relative`, `classes` and the like are the flat arrays that
 * the table describes, all of one length. Results are undefined for a band whose parents come later.
 */

#define LODE_CLASSES 30

/* Coefficients of some bands in steps, and their classes by the size of what is around them.
 *
 * steps:    of each band, at least 1.
 * relative: coefficients over their band's step; as they are, or 0, where there are none.
 * classes:  0 to LODE_CLASSES - 1.
 * Returns 0.
 */
LODE_API int64_t lode_classify(const int64_t *bands, int64_t bands_count, const int64_t *steps, int64_t steps_count,
                               const int32_t *coefficients, int64_t coefficients_count, double *relative,
                               int64_t relative_count, int8_t *classes, int64_t classes_count);

/* trellis_choice.c ----------------------------------------------------------------------------------------------- */

#define LODE_INDICES 16
#define LODE_RATES 64

/* The cheapest indices of some bands, each row of blocks from state 0 of the trellis on.
 *
 * rules:    six numbers of each band: how far below an index its point lies in the odd quantiser, 0 to 1; the weight of
 *           a squared error; what is fed back of errors one and two rows above, one and two columns to the left.
 * relative, classes: as `lode_classify` makes them.
 * rates:    (2, LODE_CLASSES, LODE_RATES): what an index costs, by quantiser and class.
 * chosen:   the indices with their signs.
 * counts:   (2, LODE_CLASSES, LODE_INDICES): increased by 1 for each index that was chosen; the last one of a class
 *           stands for all that are larger.
 * ways, above: room to work in, 64 and 2 for each column of the widest band.
 *
 * Returns 0.
 */
struct lode_choose {
    const int64_t *bands;
    int64_t bands_count;
    const float *rules;
    int64_t rules_count;
    const double *relative;
    int64_t relative_count;
    const int8_t *classes;
    int64_t classes_count;
    const float *rates;
    int64_t rates_count;
    int32_t *chosen;
    int64_t chosen_count;
    double *counts;
    int64_t counts_count;
    int16_t *ways;
    int64_t ways_count;
    float *above;
    int64_t above_count;
};

LODE_API int64_t lode_choose(const struct lode_choose *arguments);

/* lzf.c ---------------------------------------------------------------------------------------------------------- */

/* Decompress until the source ends or `budget` bytes are made, and up to 263 more.
 *
 * state: bytes of the source that were read, and bytes that were made; zeros at first, handed on from call to call.
 * Returns 1, or 0 where the data are damaged or make more than there is room for.
 */
LODE_API int64_t lode_lzf(const uint8_t *source, int64_t source_count, uint8_t *target, int64_t target_count,
                          int64_t budget, int64_t *state, int64_t state_count);

/* differences.c -------------------------------------------------------------------------------------------------- */

/* Code how far values are from the places on the line that a lattice restores, with specials that are on no line.
 *
 * line, exponents: of the restored values.
 * differences:     writing, all above -2^63; reading, filled.
 * marks:           for specials their number in a list of `specials`, from 1, else 0; writing, at most `specials`.
 * most:            what lode_most_bits says, at most 4095.
 * model, memory:   room to work in, LODE_DIFFERENCES_MODEL and 3 LODE_DIFFERENCES_MEMORY long.
 * data:            decisions in contexts; writing, at least 128 bytes a value and 64; reading, those missing are zeros.
 * stored:          lower bits; writing, at least 8 bytes a value and 16; reading, those missing are zeros.
 * used:            bytes of `data` and of `stored`, written or looked at.
 * A call takes about 50 ns a value. Returns 0.
 */
struct lode_differences {
    const int64_t *line;
    int64_t line_count;
    int64_t *differences, differences_count;
    const int32_t *exponents;
    int64_t exponents_count;
    uint8_t *marks;
    int64_t marks_count, most, specials;
    int32_t *model;
    int64_t model_count;
    int64_t *memory, memory_count;
    uint8_t *data;
    int64_t data_count;
    uint8_t *stored;
    int64_t stored_count;
    int64_t *used, used_count;
};

LODE_API int64_t lode_differences(int64_t reads, const struct lode_differences *arguments);

#define LODE_MOST_SPECIALS 15
#define LODE_DIFFERENCES_MODEL (256 + 4 + 16 + 1 + 1 + 16)
#define LODE_DIFFERENCES_MEMORY (1 << 14)

/* The largest sum of a difference's bits and its exponent, of those that have no mark; at least 0. */
LODE_API int64_t lode_most_bits(const int64_t *differences, int64_t differences_count, const int32_t *exponents,
                                int64_t exponents_count, const uint8_t *marks, int64_t marks_count);

/* offsets.c ------------------------------------------------------------------------------------------------------ */

/* Code the places of float32 values, given those that a lattice restores.
 *
 * bases:    the restored values, rounded to the lattice.
 * restored: their places.
 * bits:     of the differences of `places` from `restored`, with their signs: 0 to 34.
 * places:   writing, so close to `restored`; reading, filled.
 * model:    room to work in, LODE_OFFSETS_MODEL long.
 * data:     writing, at least 64 bytes a value and 64; reading, those missing are zeros.
 * A call takes about 100 ns a value, writing up to 1 us. Returns the bytes written or looked at.
 */
LODE_API int64_t lode_offsets(int64_t reads, const double *bases, int64_t bases_count, const int64_t *restored,
                              int64_t restored_count, int64_t bits, int64_t *places, int64_t places_count,
                              int32_t *model, int64_t model_count, uint8_t *data, int64_t data_count);

#define LODE_OFFSETS_MODEL (16 + 1 + 64 + 2 * 8 + 16 + 34)

/* predictor_fit.c ------------------------------------------------------------------------------------------------ */

/* The factors u and w of a and b in what the third step predicts, flat, for as many rows of midpoints as `details` has;
 * `nodes` has five rows more, the first of them two before that of the first midpoint. `kept` takes the details.
 *
 * Returns a number that no magnitude of u and w exceeds, at most 2^31.
 */
LODE_API int64_t lode_predictor_factors(const int32_t *nodes, int64_t rows, int64_t columns, int64_t pitch,
                                        const int32_t *details, int64_t details_rows, int64_t details_columns,
                                        int64_t details_pitch, int32_t *first, int64_t first_count, int32_t *second,
                                        int64_t second_count, int32_t *kept, int64_t kept_count);

/* Add to five moments: the sums of u u, u w, w w, u d and w d, each value weighted with 1 / (1 + |d - (a u + b w) /
 * 256|), or not at all. Good to 1e-12.
 */
LODE_API int64_t lode_predictor_moments(const int32_t *first, int64_t first_count, const int32_t *second,
                                        int64_t second_count, const int32_t *details, int64_t details_count, double a,
                                        double b, int64_t weighted, double *moments, int64_t moments_count);

/* Add to `bits`, one number, about the bits that the details take with (a, b), each within +-127: the sum of log2(1 +
 * |e|), good to 3e-6 for each sixteen values. No magnitude of u and w exceeds `largest`, nor 2^28.
 */
LODE_API int64_t lode_predictor_bits(const int32_t *first, int64_t first_count, const int32_t *second,
                                     int64_t second_count, const int32_t *details, int64_t details_count,
                                     int64_t largest, int64_t a, int64_t b, double *bits, int64_t bits_count);

/* dequantize.c --------------------------------------------------------------------------------------------------- */

/* Passes that remain of a tile that was not announced: more than any tile has. */
#define LODE_UNANNOUNCED 57

/* Put what is known of the bands `numbers` into a plane of coefficients, each within +-2^28.
 *
 * known, sign, early: of the coefficients of all bands, flat, see the section above.
 * bands:   rows of BAND_FIELDS columns (band_fields.h).
 * origins: of each band its tile, and its first row and column among all coefficients.
 * steps:   of each band its quantiser's step, below 2^26; 0 where there is none, and `known` are no indices.
 * state:   passes that remain of each tile, or LODE_UNANNOUNCED, which gives zeros.
 * finer:   coefficients of the tiles from this one on are multiplied by 8.
 * out:     begins at `first_row` and `first_column` of all coefficients. What bands have outside of it is left out.
 */
struct lode_spread {
    const int32_t *known;
    int64_t known_count;
    const int8_t *sign;
    int64_t sign_count;
    const uint8_t *early;
    int64_t early_count;
    const int64_t *bands;
    int64_t bands_count;
    const int64_t *origins;
    int64_t origins_count;
    const int64_t *steps;
    int64_t steps_count;
    const int64_t *numbers;
    int64_t numbers_count;
    const int8_t *state;
    int64_t state_count, finer;
    int32_t *out;
    int64_t rows, columns, pitch, first_row, first_column;
};

LODE_API int64_t lode_spread(const struct lode_spread *arguments);

/* bitplanes.c ---------------------------------------------------------------------------------------------------- */

/* `bands` are rows of the table of bands (band_fields.h), which says where the coefficients of each tile's bands stand
 * in flat arrays of one length, and their blocks in an array of flags. The places of a band hold its parents too.
 */

/* Code runs of passes, one after another: of plane p of a tile the passes 2 p + 1 and 2 p.
 *
 * trellis:  1 where coefficients are indices of a trellis.
 * runs:     LODE_RUN_FIELDS numbers each: the tile's first band, its bands, its model's number, the first pass and the
 *           last one (from the highest down, at most 55), where its bytes start in `data`, how many they are, and 1
 *           where the unit is a large one. Such a one is written whole, in one run.
 * Writing, there must be room for 11 bits of each decision, for 16 in a large unit; how many bytes were written takes
 * the place of the room.
 * known:    magnitudes as far as they are known, zeros around each band.
 * sign:     -1, 1, or 0 where no bit is known.
 * flags:    of blocks, 0 as long as no coefficient is known to be significant.
 * early:    1 + the plane in whose first pass a coefficient was coded last, or 0. In large units 1 + the plane in which
 *           it was found, and 128 more if that was in the second pass.
 * truth:    writing, the coefficients with their signs; reading, empty.
 * models:   LODE_MODEL or, of a trellis, LODE_TRELLIS_MODEL contexts each, at first LODE_NEW_CONTEXT, or zeros of a
 *           large unit.
 * costs:    empty; or the bits that were written when each pass had ended, by its number. Not empty where a large unit
 *           is written.
 * symbols:  where large units are written, room for the decisions of any of them: n (p + 2) + 2048 of n coefficients in
 *           p planes.
 * state:    LODE_PASSES_STATE numbers, zeros at first, handed on from call to call.
 * budget:   about so many coefficients are looked at in a call, at least one block.
 *
 * Returns how many runs are done.
 */
struct lode_passes {
    const int64_t *bands;
    int64_t bands_count;
    int64_t *runs, runs_count;
    int32_t *known;
    int64_t known_count;
    int8_t *sign;
    int64_t sign_count;
    uint8_t *flags;
    int64_t flags_count;
    uint8_t *early;
    int64_t early_count;
    const int32_t *truth;
    int64_t truth_count;
    int32_t *models;
    int64_t models_count;
    uint8_t *data;
    int64_t data_count;
    double *costs;
    int64_t costs_count;
    uint16_t *symbols;
    int64_t symbols_count;
    int64_t *state, state_count, budget;
};

LODE_API int64_t lode_passes(int64_t reads, int64_t trellis, const struct lode_passes *arguments);

#define LODE_RUN_FIELDS 8
#define LODE_RUN_LARGE 7
#define LODE_RUN_START 5
#define LODE_RUN_LENGTH 6
#define LODE_PASSES_STATE 8
#define LODE_MODEL 79
#define LODE_TRELLIS_MODEL 155
/* A context at the start: a probability of one half, and an adaptation count of 1. */
#define LODE_NEW_CONTEXT ((1 << 27) | 1)

/* gains.c -------------------------------------------------------------------------------------------------------- */

/* Squared error of a tile, by how many of its passes remain.
 *
 * bands, early: of the tile, as above; all of it was coded.
 * weights:      of each band, what a squared error of 1 counts.
 * truth:        the coefficients.
 * errors:       for 0, 1, ... passes that remain, up to all of them.
 *
 * Returns 0.
 */
LODE_API int64_t lode_pass_gains(const int64_t *bands, int64_t bands_count, const double *weights,
                                 int64_t weights_count, const int32_t *truth, int64_t truth_count, const uint8_t *early,
                                 int64_t early_count, double *errors, int64_t errors_count);

/* layers.c ------------------------------------------------------------------------------------------------------- */

/* Curves stand one after another: for each unit of each channel the bits and gains of its passes, that of the number 0
 * first, at most 64.
 *
 * ends: for each curve, where it ends; the next one begins there.
 */

/* Gain for each bit of all passes, the same for the passes of a run.
 *
 * first, last:    which curves.
 * falling, known: slopes of all passes of the stream times -1, rising, and the bits of all passes up to each; or none.
 * share_of_tile:  two runs are two only where that saves this share of the unit's bits so far, and
 * share_of_stream, segment: this share of the stream's bits at the first run's slope, but not more than `segment` bits.
 * Returns 0.
 */
struct lode_pass_slopes {
    const double *bits;
    int64_t bits_count;
    const double *gains;
    int64_t gains_count;
    const int64_t *ends;
    int64_t ends_count, first, last;
    const double *falling;
    int64_t falling_count;
    const double *known;
    int64_t known_count;
    double share_of_tile, share_of_stream, segment;
    double *slopes;
    int64_t slopes_count;
};

LODE_API int64_t lode_pass_slopes(const struct lode_pass_slopes *arguments);

/* Gives a parent's passes of a plane at least the slope of its children's, for the curves from `last` - 1 down to
 * `first`.
 *
 * parents: for each curve the number of its parent's, which is less than its own, or negative.
 * Returns 0.
 */
LODE_API int64_t lode_lift_slopes(const int64_t *ends, int64_t ends_count, const int64_t *parents,
                                  int64_t parents_count, int64_t first, int64_t last, double *slopes,
                                  int64_t slopes_count);

/* mesh.c --------------------------------------------------------------------------------------------------------- */

/* Faces are triangles and quads. In all that follows
 *
 * corners:  4 for each face, its vertices in the order round it, negative in the last place of a triangle. The faces'
 *           half-edges have the same numbers: 4 f + k runs from corner k of face f to the next one.
 * twins:    for each half-edge that of the face beside it, or negative where there is none.
 * umbrella: for each corner the number of its umbrella, a run of faces round a vertex, each beside the next; negative
 *           where there is no corner.
 * valence:  for each umbrella its faces, negative where it is open.
 * state:    what a walk hands on from call to call, zeros at first unless said otherwise. A call takes about `steps`
 *           steps, at least one.
 *
 * Walks return 1 when they are done, and 0 when they are to be called again, with the same arrays as they were left.
 * Numbers in the arrays that are no vertex, half-edge, umbrella or face are refused, as are twins that are not twins of
 * each other where a walk would not end for them.
 */

/* Count edges: adds to start[v + 1] the half-edges whose lower vertex is v. For any part of a mesh's faces.
 *
 * start: one more than vertices. */
LODE_API int64_t lode_mesh_count_edges(const int32_t *corners, int64_t corners_count, int32_t *start,
                                       int64_t start_count);

/* Sort the half-edges of faces `first` to `last` - 1 by their lower vertex.
 *
 * start: for each vertex the place in `order` of the next half-edge whose lower vertex it is.
 * order: filled from there with half-edges.
 */
LODE_API int64_t lode_mesh_sort_edges(const int32_t *corners, int64_t corners_count, int64_t first, int64_t last,
                                      int32_t *start, int64_t start_count, int32_t *order, int64_t order_count);

/* Find the twins among half-edges that are sorted by their lower vertex, for any run of them, one after another.
 *
 * met:     two for each vertex, -1 at first.
 * twins:   -1 at first; what they are where three half-edges meet is of no use.
 * crossed: one number: the lowest half-edge at an edge that already has two, if it is lower than what is there.
 * Returns the pairs that run the same way.
 */
LODE_API int64_t lode_mesh_match_edges(const int32_t *corners, int64_t corners_count, const int32_t *order,
                                       int64_t order_count, int32_t *met, int64_t met_count, int32_t *twins,
                                       int64_t twins_count, int64_t *crossed, int64_t crossed_count);

/* Part quads, `first` to `last` - 1 and those of higher numbers beside them, where attributes differ across the edge.
 *
 * attributes: for each attribute and each corner a number.
 * twins:      -1 from now on where any attribute differs.
 * torn:       one for each attribute, filled with the edges at which it differs.
 */
LODE_API int64_t lode_mesh_tear(const int32_t *attributes, int64_t attributes_count, int64_t first, int64_t last,
                                int32_t *twins, int64_t twins_count, int64_t *torn, int64_t torn_count);

/* Find the one row of values that all corners at each vertex have, for any part of a mesh's faces.
 *
 * rows:   one for each corner, not negative.
 * row_of: one for each vertex, -1 at first; filled with the row of the corners there.
 * Returns 1, or 0 where one was found that differs; `row_of` is of no use then.
 */
LODE_API int64_t lode_mesh_rows(const int32_t *corners, int64_t corners_count, const int32_t *rows, int64_t rows_count,
                                int32_t *row_of, int64_t row_of_count);

/* Number faces by the connected piece that they belong to, in the order of the pieces' first faces.
 *
 * piece: one for each face, -1 at first.
 * queue: as many.
 * state: four numbers, the last of which is that of pieces.
 */
LODE_API int64_t lode_mesh_pieces(const int32_t *twins, int64_t twins_count, int32_t *piece, int64_t piece_count,
                                  int32_t *queue, int64_t queue_count, int64_t *state, int64_t state_count,
                                  int64_t steps);

/* Find the faces to turn round so that all of a piece go round alike: the fewer of the two possible sets.
 *
 * turned: one for each face, 2 at first; filled with 0 and 1.
 * queue:  as many.
 * state:  five numbers.
 * Returns 2 + f where a surface with only one side was noticed at face f.
 */
LODE_API int64_t lode_mesh_orient(const int32_t *corners, int64_t corners_count, const int32_t *twins,
                                  int64_t twins_count, uint8_t *turned, int64_t turned_count, int32_t *queue,
                                  int64_t queue_count, int64_t *state, int64_t state_count, int64_t steps);

/* Number umbrellas, in the order of their lowest corners, of faces that go round alike.
 *
 * umbrella: -1 at first.
 * valence:  of any length; as many as corners suffice.
 * state:    six numbers, the second of which is that of umbrellas.
 */
LODE_API int64_t lode_mesh_umbrellas(const int32_t *corners, int64_t corners_count, const int32_t *twins,
                                     int64_t twins_count, int32_t *umbrella, int64_t umbrella_count, int32_t *valence,
                                     int64_t valence_count, int64_t *state, int64_t state_count, int64_t steps);

/* Trace grid lines over quads that go round alike, all one edge at a time in turn.
 *
 * whole:  1 where a line ends only at a border and at a vertex without four quads, 0 where also at other lines.
 * passed: one for each umbrella; 1 where a line begins, 0 elsewhere.
 * riders: the half-edges with which lines begin, each with a face on either side.
 * cut:    one for each half-edge, 0 at first; 1 along the lines.
 * state:  three numbers, at first 0, 0 and the lines.
 */
struct lode_mesh_trace {
    const int32_t *corners;
    int64_t corners_count;
    const int32_t *twins;
    int64_t twins_count;
    const int32_t *umbrella;
    int64_t umbrella_count;
    const int32_t *valence;
    int64_t valence_count, whole;
    uint8_t *passed;
    int64_t passed_count;
    int32_t *riders;
    int64_t riders_count;
    uint8_t *cut;
    int64_t cut_count;
    int64_t *state, state_count, steps;
};

LODE_API int64_t lode_mesh_trace(const struct lode_mesh_trace *arguments);

/* Find the poles of triangles that go round alike: vertices without which they are the halves of a grid's quads.
 *
 * leaving:  for each umbrella a half-edge that leaves it, with no face before it where the umbrella is open.
 * order:    umbrellas that may be poles.
 * together: 1 to take them one after another, each only if it fits to those before; 0 for each by itself.
 * pole:     one for each umbrella: 1 is a pole.
 * missing:  for each closed umbrella the triangles by which it is short of six; fewer once poles beside it are taken.
 * state:    four numbers.
 */
struct lode_mesh_poles {
    const int32_t *corners;
    int64_t corners_count;
    const int32_t *twins;
    int64_t twins_count;
    const int32_t *umbrella;
    int64_t umbrella_count;
    const int32_t *valence;
    int64_t valence_count;
    const int32_t *leaving;
    int64_t leaving_count;
    const int32_t *order;
    int64_t order_count, together;
    uint8_t *pole;
    int64_t pole_count;
    int32_t *missing;
    int64_t missing_count;
    int64_t *state, state_count, steps;
};

LODE_API int64_t lode_mesh_poles(const struct lode_mesh_poles *arguments);

/* Make each triangle of the fans round poles a quad whose side at the pole has two new vertices.
 *
 * starts:         a half-edge that leaves each pole, with no face before it where the fan is open.
 * folded:         one for each face; 1 where the quad's fourth corner has attributes of its own, those in the fourth
 *                 place of the triangle's.
 * attributes:     for each attribute and each corner a number.
 * vertices:       new ones are numbered from here.
 * new_corners:    as `corners`, but for the quads.
 * new_attributes: as `attributes`, but for the quads.
 * pole_of:        filled with the pole of each new vertex; as many as there are triangles in fans, and one more for
 *                 each open fan.
 * state:          four numbers, the last of which is that of new vertices.
 */
struct lode_mesh_unfold {
    const int32_t *corners;
    int64_t corners_count;
    const int32_t *twins;
    int64_t twins_count;
    const int32_t *starts;
    int64_t starts_count;
    const uint8_t *folded;
    int64_t folded_count;
    const int32_t *attributes;
    int64_t attributes_count, vertices;
    int32_t *new_corners;
    int64_t new_corners_count;
    int32_t *new_attributes;
    int64_t new_attributes_count;
    int32_t *pole_of;
    int64_t pole_of_count;
    int64_t *state, state_count, steps;
};

LODE_API int64_t lode_mesh_unfold(const struct lode_mesh_unfold *arguments);

/* mesh_lattice.c ------------------------------------------------------------------------------------------------- */

/* Lay out faces that all have so many `sides`, 3 or 4, and go round alike; arrays as above.
 *
 * piece:   one for each face, filled with its connected piece, in the order of the pieces' first faces.
 * first:   two for each face, filled with the place of its first corner.
 * heading: one for each face, -1 at first; filled with the direction of its first half-edge.
 * turns:   one for each piece, 0 at first; 1 where directions differ after a way round.
 * periods: three for each piece, 0 at first; filled with a, b, d: the ways by which one comes back to the same face are
 *          sums of (a, b) and (0, d), 0 <= a, 0 <= b < d. They wrap modulo 2^64.
 * stack:   one for each face.
 * state:   three numbers, the last of which is that of pieces.
 * Returns 2 when there are more pieces than `turns` and `periods` have room for: to be called again with larger ones.
 */
struct lode_mesh_develop {
    const int32_t *twins;
    int64_t twins_count;
    int32_t *piece;
    int64_t piece_count;
    int32_t *first;
    int64_t first_count;
    int8_t *heading;
    int64_t heading_count;
    uint8_t *turns;
    int64_t turns_count;
    int64_t *periods, periods_count;
    int32_t *stack;
    int64_t stack_count;
    int64_t *state, state_count, steps;
};

LODE_API int64_t lode_mesh_develop(int64_t sides, const struct lode_mesh_develop *arguments);

/* What there is along each of the three directions of triangles that were laid out, for any part of a mesh's faces.
 *
 * points: a row for each vertex.
 * low, high: three for each piece: the least and the largest x, y and x + y of a corner, if they are less or larger
 *            than what is there.
 * single:    three for each piece: 1 where a half-edge of direction 0, 1 or 2, or the opposite, has no twin.
 * length:    three for each piece: the lengths of all these half-edges are added.
 */
struct lode_mesh_survey {
    const int32_t *corners;
    int64_t corners_count;
    const int32_t *twins;
    int64_t twins_count;
    const double *points;
    int64_t points_rows, points_columns, points_pitch;
    const int32_t *piece;
    int64_t piece_count;
    const int32_t *first;
    int64_t first_count;
    const int8_t *heading;
    int64_t heading_count;
    int64_t *low, low_count;
    int64_t *high, high_count;
    uint8_t *single;
    int64_t single_count;
    double *length;
    int64_t length_count;
};

LODE_API int64_t lode_mesh_survey(const struct lode_mesh_survey *arguments);

/* The bounds of quads that were laid out, for any part of `faces`: the least and the largest row, the least and the
 * largest column of a quad, if they are less or larger than what `bounds` holds. */
LODE_API int64_t lode_mesh_bounds(const int64_t *faces, int64_t faces_count, const int32_t *first, int64_t first_count,
                                  const int8_t *heading, int64_t heading_count, int64_t *bounds, int64_t bounds_count);

/* Put quads that were laid out, and their corners, into their places in a grid.
 *
 * identity:  a number for each corner; at one node all are equal.
 * top, left: the row and the column of the first cell, at most 2^32 from 0. Where rows or columns are `closed`, others
 *            count modulo their number.
 * nodes:     a corner that lies there, or -1.
 * cells:     the face, or -1; as many rows and columns as nodes, but for one less where they are not closed.
 * Returns how many faces were put before one that lies on another or does not join it; all, where there is none.
 */
struct lode_mesh_fill {
    const int64_t *faces;
    int64_t faces_count;
    const int32_t *first;
    int64_t first_count;
    const int8_t *heading;
    int64_t heading_count;
    const int32_t *identity;
    int64_t identity_count, top, left, closed_rows, closed_columns;
    int32_t *nodes;
    int64_t height, width, nodes_pitch;
    int32_t *cells;
    int64_t cells_height, cells_width, cells_pitch;
};

LODE_API int64_t lode_mesh_fill(const struct lode_mesh_fill *arguments);

#endif
