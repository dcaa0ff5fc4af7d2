"""Columns of the table that describes the bands of tiles to the kernels; one row for each band.

``OFFSET`` and ``STRIDE``: where a band's first coefficient stands in the flat arrays, and the way to the next row.
``FLAGS``: where its first block stands in the array of block flags (stride: blocks across + 1, with a row before and
one behind). ``PARENT`` and ``PARENT_STRIDE``: where the parent of the first coefficient stands, and the way to its
next row; ``ROW_SHIFT`` and ``COLUMN_SHIFT`` take a row and a column to the parent's. ``KIND``: 1 for details along
the columns' axis plus 2 for details along the rows' axis.
"""

from __future__ import annotations

__all__ = [
    "BAND_FIELDS",
    "COLUMNS",
    "COLUMN_SHIFT",
    "FLAGS",
    "KIND",
    "OFFSET",
    "PARENT",
    "PARENT_STRIDE",
    "ROWS",
    "ROW_SHIFT",
    "STRIDE",
]

BAND_FIELDS = 10
OFFSET, STRIDE, ROWS, COLUMNS, FLAGS, PARENT, PARENT_STRIDE, ROW_SHIFT, COLUMN_SHIFT, KIND = range(BAND_FIELDS)
