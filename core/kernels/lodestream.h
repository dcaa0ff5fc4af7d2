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
 * state:  four numbers that are handed on from call to call.
 * Returns the bytes written or looked at so far, all of them once `last` is `rows`.
 */
LODE_API int64_t lode_mask(int64_t reads, int64_t rows, int64_t columns, int64_t first, int64_t last, uint8_t *field,
                           int64_t field_count, int32_t *model, int64_t model_count, uint8_t *data, int64_t data_count,
                           int64_t *state, int64_t state_count);

#define LODE_MASK_MODEL ((1 << 16) + (1 << 10) + 4 + 2)

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
