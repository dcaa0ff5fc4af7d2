/* The compiled kernels of Lodestream: all that core/lodestream/kernels.py declares and calls.
 *
 * An array is a pointer and, behind it, its number of elements. Arrays of arrays are in C order; `rows` of a plane that
 * need not lie side by side come as pointer, rows, columns, and `pitch`, the elements from one row to the next. The
 * caller owns all memory and has checked types; nothing here allocates, keeps anything between calls, or calls a
 * library. `reads` chooses between the two directions of a coder: 1 reads `data` and fills what it describes, 0 writes.
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

/* lifting.c ------------------------------------------------------------------------------------------------------ */

#define LODE_LIFT_STRIP 64

/* One step of the lifting along an axis of a plane, or its inverse, in place: samples on one side, on the other nodes
 * of the coarser level and behind them the details. Exact for samples within +-2^27 and for coefficients below 2^29;
 * what is larger gives numbers without a meaning. The inverse leaves samples within +-2^27.
 *
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
 * LODE_LIFT_STRIP columns and at least a quarter of them.
 */
LODE_API int64_t lode_lift(int64_t inverse, int64_t axis, int32_t *x, int64_t rows, int64_t columns, int64_t pitch,
                           int64_t midpoints, int64_t run, const int64_t *table, int64_t table_count, int64_t a,
                           int64_t b, int64_t from, int32_t *work, int64_t work_count);

/* mask.c --------------------------------------------------------------------------------------------------------- */

/* Code rows `first` to `last` - 1 of a mask of `rows` x `columns` points.
 *
 * field:  flat, (rows + 2) x (columns + 6): two rows before and three columns at either side are zeros; 1 is valid.
 * model:  LODE_MASK_MODEL contexts and weights; begun where `first` is 0.
 * data:   writing, at least 64 + 2 rows columns bytes; reading, all there are, those missing count as zeros.
 * state:  four numbers that are handed on from call to call.
 * Returns the bytes written or looked at so far, all of them once `last` is `rows`.
 */
LODE_API int64_t lode_mask(int64_t reads, int64_t rows, int64_t columns, int64_t first, int64_t last, uint8_t *field,
                           int64_t field_count, int32_t *model, int64_t model_count, uint8_t *data, int64_t data_count,
                           int64_t *state, int64_t state_count);

#define LODE_MASK_MODEL ((1 << 16) + (1 << 10) + 4 + 2)

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

/* spreading.c ---------------------------------------------------------------------------------------------------- */

/* Passes that remain of a tile that was not announced: more than any tile has. */
#define LODE_UNANNOUNCED 57

/* Put what is known of the bands `numbers` into a plane of coefficients, each within +-2^28.
 *
 * known, sign, early: of the coefficients of all bands, flat, see the section above.
 * bands:   rows of BAND_FIELDS columns (band_fields.h).
 * windows: of each band its tile, and its first row and column among all coefficients.
 * steps:   of each band its quantiser's step, below 2^26; 0 where there is none, and `known` are no indices.
 * state:   passes that remain of each tile, or LODE_UNANNOUNCED, which gives zeros.
 * finer:   coefficients of the tiles from this one on are multiplied by 8.
 * out:     begins at `first_row` and `first_column` of all coefficients; the bands lie inside.
 */
LODE_API int64_t lode_spread(const int32_t *known, int64_t known_count, const int8_t *sign, int64_t sign_count,
                             const uint8_t *early, int64_t early_count, const int64_t *bands, int64_t bands_count,
                             const int64_t *windows, int64_t windows_count, const int64_t *steps, int64_t steps_count,
                             const int64_t *numbers, int64_t numbers_count, const int8_t *state, int64_t state_count,
                             int64_t finer, int32_t *out, int64_t rows, int64_t columns, int64_t pitch,
                             int64_t first_row, int64_t first_column);

#endif
