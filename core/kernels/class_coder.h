/* The class coder: passes of a large unit (docs/format.md, "Large units"). */
#ifndef LODE_CLASS_CODER_H
#define LODE_CLASS_CODER_H

#include <stdbool.h>

#include "band_fields.h"
#include "block_coder.h"
#include "class_unit.h"

/* Where the walk over a unit stands. Its second passes go through all bands twice: for what is coded, and for raw
 * bits. */
struct class_place {
    int64_t passes, band, stripe; /* that are done */
    int64_t bytes;                /* that are read of the segment, */
    int bits;                     /* and raw bits of the byte behind them */
};

/* Decisions and bytes of a unit that is written. */
struct class_output {
    uint16_t *symbols;
    int64_t symbols_count;
    uint8_t *data;
    int64_t data_count;
    double *costs; /* bits of the string when each pass has ended, by its number */
};

/* Both take the rows of the table of bands (band_fields.h) that are the unit's, and its model: zeros at first, contexts
 * and the two states of the coder then. */

/* Read passes `first` to `last` of a unit until all are done or the budget is spent; whether they are done. The call
 * `goes_on` if the one before it with this `unit` read the same one. */
bool lode_class_read(struct unit *unit, bool goes_on, const struct tiles *tiles, const int64_t *bands, int64_t count,
                     int64_t first, int64_t last, const uint8_t *data, int64_t size, struct class_place *at,
                     int64_t *budget);

/* Write all passes of a unit from `first` on, whatever the budget, which becomes less; the bytes of its string, or -1
 * where there is no room. */
int64_t lode_class_write(struct unit *unit, const struct tiles *tiles, const int64_t *bands, int64_t count,
                         int64_t first, const struct class_output *output, int64_t *budget);

#endif
