"""Read and write files: one table of formats, selected by content.

The first bytes of a file decide its format; the suffix only helps with text. No reader opens another file that the
first one names. Every reader checks what a header announces before it allocates memory. Libraries are imported when a
file needs them.

`table` has a row for each format; `reading` and `writing` find the row and do what is the same for all. To add a
format, write a module with ``sniff`` and ``read`` or ``write``, and give it a row.
"""

from .reading import read, sniff
from .source import DEFAULT_MAX_VERTICES, check_allowed
from .table import Format, formats
from .writing import check_blocks, for_writing, write, write_stream, written

__all__ = [
    "DEFAULT_MAX_VERTICES",
    "Format",
    "check_allowed",
    "check_blocks",
    "for_writing",
    "formats",
    "read",
    "sniff",
    "write",
    "write_stream",
    "written",
]
