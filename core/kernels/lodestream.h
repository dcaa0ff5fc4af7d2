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

/* mask.c --------------------------------------------------------------------------------------------------------- */

/* Code rows `first` to `last` - 1 of a mask of `rows` x `columns` points.
 *
 * field:  flat, (rows + 2) x (columns + 6): two rows before and three columns at either side are zeros; 1 is valid.
 * model:  LODE_MASK_MODEL contexts and weights; begun where `first` is 0.
 * data:   writing, at least 64 + 2 rows columns bytes; reading, all there are, those missing count as zeros.
 * state:  four numbers that are handed on from call to call, as the model is; others are refused.
 * Returns the bytes written or looked at so far, all of them once `last` is `rows`.
 */
LODE_API int64_t lode_mask(int64_t reads, int64_t rows, int64_t columns, int64_t first, int64_t last, uint8_t *field,
                           int64_t field_count, int32_t *model, int64_t model_count, uint8_t *data, int64_t data_count,
                           int64_t *state, int64_t state_count);

#define LODE_MASK_MODEL ((1 << 16) + (1 << 10) + 4 + 2)

/* bitplanes.c ---------------------------------------------------------------------------------------------------- */

/* `bands` are rows of the table of bands (band_fields.h), which says where the coefficients of each tile's bands stand
 * in flat arrays of one length, and their blocks in an array of flags. The places of a band hold its parents too.
 */

/* Code runs of passes, one after another: of plane p of a tile the passes 2 p + 1 and 2 p.
 *
 * trellis:  1 where coefficients are indices of a trellis.
 * runs:     LODE_RUN_FIELDS numbers each: the tile's first band, its bands, its model's number, the first pass and the
 *           last one (from the highest down, at most 55), where its bytes start in `data`, and how many they are.
 * Writing, there must be room for 11 bits of each decision; how many were written takes the place of the last number.
 * known:    magnitudes as far as they are known, zeros around each band.
 * sign:     -1, 1, or 0 where no bit is known.
 * flags:    of blocks, 0 as long as no coefficient is known to be significant.
 * early:    1 + the plane in whose first pass a coefficient was coded last, or 0.
 * truth:    writing, the coefficients with their signs; reading, empty.
 * models:   LODE_MODEL or, of a trellis, LODE_TRELLIS_MODEL contexts and weights each, see `lode_new_models`.
 * costs:    empty; or the bits that were written when each pass had ended, by its number.
 * state:    LODE_PASSES_STATE numbers, zeros at first, handed on from call to call.
 * budget:   about so many coefficients are looked at in a call, at least one block.
 *
 * Returns how many runs are done.
 */
LODE_API int64_t lode_passes(int64_t reads, int64_t trellis, const int64_t *bands, int64_t bands_count, int64_t *runs,
                             int64_t runs_count, int32_t *known, int64_t known_count, int8_t *sign, int64_t sign_count,
                             uint8_t *flags, int64_t flags_count, uint8_t *early, int64_t early_count,
                             const int32_t *truth, int64_t truth_count, int32_t *models, int64_t models_count,
                             uint8_t *data, int64_t data_count, double *costs, int64_t costs_count, int64_t *state,
                             int64_t state_count, int64_t budget);

#define LODE_RUN_FIELDS 7
#define LODE_RUN_START 5
#define LODE_RUN_LENGTH 6
#define LODE_PASSES_STATE 8
#define LODE_MODEL 551
#define LODE_TRELLIS_MODEL 1127

/* Models before their tiles' first passes. Returns 0. */
LODE_API int64_t lode_new_models(int64_t trellis, int32_t *models, int64_t models_count);

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

#endif
