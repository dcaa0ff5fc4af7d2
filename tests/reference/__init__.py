"""A decoder in plain Python and numpy, written from docs/format.md alone: the page as a program.

Slow, and correct on every machine. It shares nothing with the package but the classes of errors, so that tests can hold
the compiled decoder to it. Sections of the page and modules: 1 `fields`; 2, 6 and 10 `container`; 3 to 3.2 `header`;
3.3 and 7.5 `masks`; 4 `levels`; 5 `tiles`; 7 `bands`; 7.1 and 7.2 `range_coder`; 7.3 and 7.4 `small_units`; 7.6
`large_units`; 8 `coefficients`, `lifting`, `reconstruction` and `decoder`; 9 to 9.2 `residual`; 9.3 `offsets`; 11 and
12 `index`; 14 `limits`.
"""

from .container import Container, Residual, Section, Segment, read_container, read_section
from .decoder import Decoder, Shown, decode
from .header import Header, read_header
from .index import Entry, Index, read_index
from .masks import decode_mask
from .residual import restore

__all__ = [
    "Container",
    "Decoder",
    "Entry",
    "Header",
    "Index",
    "Residual",
    "Section",
    "Segment",
    "Shown",
    "decode",
    "decode_mask",
    "read_container",
    "read_header",
    "read_index",
    "read_section",
    "restore",
]
