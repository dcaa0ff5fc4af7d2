/* Columns of the table that describes the bands of tiles, int64, one row a band.
 *
 * BAND_OFFSET and BAND_STRIDE: where a band's first coefficient stands in the flat arrays, and the way to the next row.
 * BAND_FLAGS: where its first block stands in the array of block flags (stride: blocks across + 1, with a row before
 * and one behind). BAND_PARENT and BAND_PARENT_STRIDE: where the parent of the first coefficient stands, and the way to
 * its next row; BAND_ROW_SHIFT and BAND_COLUMN_SHIFT take a row and a column to the parent's. BAND_KIND: 1 for details
 * along the columns' axis plus 2 for details along the rows' axis.
 */
#ifndef LODE_BAND_FIELDS_H
#define LODE_BAND_FIELDS_H

enum {
    BAND_OFFSET,
    BAND_STRIDE,
    BAND_ROWS,
    BAND_COLUMNS,
    BAND_FLAGS,
    BAND_PARENT,
    BAND_PARENT_STRIDE,
    BAND_ROW_SHIFT,
    BAND_COLUMN_SHIFT,
    BAND_KIND,
    BAND_FIELDS,
};

#endif
