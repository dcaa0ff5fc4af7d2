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
LODE_API int64_t lode_store_values(const int32_t *coordinates, int64_t rows, int64_t columns, int64_t pitch,
                                   void *points, int64_t points_count, int64_t points_type, int64_t channels,
                                   int64_t channel, int64_t first, int64_t last, int64_t decimal, double origin,
                                   double step, double scale);

/* Squared distances between points and the values of lattice coordinates in the type of the points, by parts of
 * LODE_PART_ROWS x LODE_PART_COLUMNS points, fewer at the ends: those from `first` to `last` - 1 in raster order.
 *
 * points:      (rows, columns, channels); no integers of 64 bits, which float64 cannot tell apart.
 * coordinates: (geometric, height, pitch), of the first channels; at least as many rows and columns as points.
 * rules:       (geometric, 4): of each lattice decimal, origin, step, scale.
 * counted:     (rows, columns): 0 where a point is left out; or empty: all count.
 * figures:     (parts, 2): of each part the sum of the squared distances, of each column from top to bottom and then
 *              of the columns from left to right; and the largest.
 *
 * Returns 0.
 */
LODE_API int64_t lode_square_distances(const void *points, int64_t points_count, int64_t points_type,
                                       const int32_t *coordinates, int64_t coordinates_count, const double *rules,
                                       int64_t rules_count, const uint8_t *counted, int64_t counted_count,
                                       double *figures, int64_t figures_count, int64_t rows, int64_t columns,
                                       int64_t channels, int64_t height, int64_t pitch, int64_t first, int64_t last);

#define LODE_PART_ROWS 128
#define LODE_PART_COLUMNS 512

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
LODE_API int64_t lode_push(double *values, int64_t values_count, const uint8_t *known, int64_t known_count,
                           int64_t rows, int64_t columns, int64_t first, int64_t last, int64_t rows_wrap,
                           int64_t columns_wrap, const double *coarser, int64_t coarser_count);

/* Bring holes nearer to where a thin plate would lie through what is around them: steps `first` to `last` - 1 of a walk
 * that goes over all points in raster order, then back, and so on; rows x columns steps are a sweep.
 * Returns 0.
 */
LODE_API int64_t lode_relax(double *values, int64_t values_count, const uint8_t *known, int64_t known_count,
                            int64_t rows, int64_t columns, int64_t first, int64_t last, int64_t rows_wrap,
                            int64_t columns_wrap);

/* trellis_choice.c ----------------------------------------------------------------------------------------------- */

/* `bands` are rows of the table of bands (band_fields.h); `relative`, `classes` and the like are the flat arrays that
 * the table describes, all of one length. Results are undefined for a band whose parents come later.
 */

#define LODE_CLASSES 30
#define LODE_INDICES 16

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

/* The cheapest indices of some bands, each from state 0 of the trellis on.
 *
 * relative, classes: as `lode_classify` makes them.
 * bits:   (2, LODE_CLASSES, LODE_INDICES): what an index takes without its sign, by quantiser and class; the last one
 *         stands for all that are larger.
 * worth:  the squared error, in squared steps, that a bit is worth.
 * chosen: the indices with their signs.
 * counts: as `bits`: increased by 1 for each index that was chosen.
 * indices, ways: room to work in, 4 and 1 for each coefficient of the largest band.
 *
 * Returns 0.
 */
LODE_API int64_t lode_choose(const int64_t *bands, int64_t bands_count, const double *relative, int64_t relative_count,
                             const int8_t *classes, int64_t classes_count, const double *bits, int64_t bits_count,
                             double worth, int32_t *chosen, int64_t chosen_count, double *counts, int64_t counts_count,
                             int32_t *indices, int64_t indices_count, uint8_t *ways, int64_t ways_count);

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
LODE_API int64_t lode_differences(int64_t reads, const int64_t *line, int64_t line_count, int64_t *differences,
                                  int64_t differences_count, const int32_t *exponents, int64_t exponents_count,
                                  uint8_t *marks, int64_t marks_count, int64_t most, int64_t specials, int32_t *model,
                                  int64_t model_count, int64_t *memory, int64_t memory_count, uint8_t *data,
                                  int64_t data_count, uint8_t *stored, int64_t stored_count, int64_t *used,
                                  int64_t used_count);

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

#endif
