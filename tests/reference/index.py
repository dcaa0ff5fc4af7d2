"""Where all sections, segments and chunks stand: sections 11 and 12 of docs/format.md."""

from dataclasses import dataclass

from lodestream.errors import CorruptStreamError

from . import limits
from .container import PAGES, ROOT, Container, Segment, check_optional, read_section, windows_of
from .fields import Errors, Fields, crc

END = b"LODEEND\n"
FOOTER = 28
PAGE = 256
"""Tiles, or windows, of a page."""


@dataclass(frozen=True)
class Entry:
    """A segment or a chunk.

    `start`, `length` (int): where it stands in the container; `check` (int): the lower half of its CRC; `unit`,
    `passes`, `top` (int): of a segment; 0 of a chunk.
    """

    start: int
    length: int
    check: int
    unit: int = 0
    passes: int = 0
    top: int = 0

    def take(self, data: bytes) -> Segment:
        """Take it out of a container; raises CorruptStreamError if its check does not fit."""
        found = data[self.start : self.start + self.length]
        if len(found) != self.length or (self.length and crc(found) & 0xFFFF != self.check):
            raise CorruptStreamError("the CRC of a segment or chunk is another one", self.start)
        return Segment(self.unit, self.passes, self.top, found)


@dataclass(frozen=True)
class Index:
    """The index.

    `layer_errors`, `level_errors` (list of Errors): after each layer, and of each level; `segments` (list of list of
    Entry): for each layer its segments by rising number of the unit; `chunks` (list of Entry): in the order of the
    residual section; `optional` (list of (int, int, int)): of each optional section its kind, offset and length.
    """

    layer_errors: list[Errors]
    level_errors: list[Errors]
    segments: list[list[Entry]]
    chunks: list[Entry]
    optional: list[tuple[int, int, int]]


def read_index(data: bytes, container: Container) -> Index:
    """Read the index of a whole container.

    `data` (bytes): the file; `container` (Container): what `read_container` found in it. Raises CorruptStreamError if
    footer, root or pages are damaged or contradict each other; TruncatedStreamError if a section is not all there.
    """
    header = container.header
    channels = len(header.types)
    end = len(data) - FOOTER
    if end < 0 or data[-8:] != END or crc(data[end : end + 16]) != int.from_bytes(data[end + 16 : end + 20], "little"):
        raise CorruptStreamError("no footer", max(end, 0))
    both, own = (int.from_bytes(data[at : at + 8], "little") for at in (end, end + 8))
    if not own <= both <= end:
        raise CorruptStreamError("the index is longer than the file", end)
    pages, root = read_section(data, end - both), read_section(data, end - own)
    if (pages.kind, pages.end, root.kind, root.end) != (PAGES, end - own, ROOT, end):
        raise CorruptStreamError("pages and root are not where the footer tells", end)
    fields = Fields(root.payload, root.offset)
    if fields.count(9) != header.layers:
        raise fields.damaged("another number of layers than in the header")
    lengths, layer_errors = [], []
    for _ in range(header.layers):
        lengths.append(fields.varint())
        layer_errors.append(fields.errors(channels))
    if fields.count(8) != header.finest + 1:
        raise fields.damaged("another number of levels than the header has")
    level_errors = [fields.errors(channels) for _ in range(header.finest + 1)]
    position = fields.varint()
    lengths += [fields.varint(), fields.varint()]
    directory = [(fields.u8(), fields.varint(), fields.varint()) for _ in range(fields.count(3, limits.OPTIONAL))]
    check_optional([kind for kind, _, _ in directory], root.offset)
    optional = {place: length for _, place, length in directory}
    tables = []
    for count in (len(header.tiles), len(windows_of(header, container.masks)) if lengths[-2] else 0):
        if fields.varint() != -(-count // PAGE):
            raise fields.damaged("another number of pages than there are tiles or windows for")
        tables.append([(fields.varint(), fields.number("I")) for _ in range(-(-count // PAGE))])
    fields.end()
    ends = []
    for length in [*lengths, 0]:
        while position in optional:
            position += optional.pop(position)
        position += length
        ends.append(position)
    if position != end - both or optional:
        raise fields.damaged("the sections do not fill the file up to the index")
    book = Fields(pages.payload, pages.offset)
    parts = [[_page(book, *entry) for entry in table] for table in tables]
    book.end()
    segments = _segments(parts[0], container, [ends[layer] - 4 for layer in range(header.layers)])
    fields.require(header.layers == 1 or all(segments), "a layer without segments that is not the only one")
    return Index(layer_errors, level_errors, segments, _chunks(parts[1], container, ends[-3] - 4), directory)


def _page(book: Fields, length: int, told: int) -> Fields:
    offset = book.offset + book.position
    data = book.take(length)
    if crc(data) != told:
        raise CorruptStreamError("the CRC of a page is another one", offset)
    return Fields(data, offset)


def _segments(pages: list[Fields], container: Container, ends: list[int]) -> list[list[Entry]]:
    """Read the pages of segments; `ends` is where the segments of each layer end."""
    header = container.header
    units = len(header.types) * len(header.tiles)
    found: list[list[Entry]] = [[] for _ in ends]
    places: list[int] = []
    for number, fields in enumerate(pages):
        starts = [end - fields.varint() for end in ends]
        if number and starts != places:
            raise fields.damaged("a page does not begin where the one before it ends")
        places = starts
        unit = PAGE * number * len(header.types)
        last = min(unit + PAGE * len(header.types), units)
        while fields.left:
            count = fields.varint()
            if not count:
                unit += 1 + fields.varint()
                continue
            top, layer = fields.u8(), -1
            for _ in range(count):
                first = fields.u8()
                passes, skipped = (first & 7) + 1, first >> 3
                passes += fields.varint() if passes == 8 else 0
                layer += 1 + skipped + (fields.varint() if skipped == 31 else 0)
                length, check = fields.varint(), fields.number("H")
                if layer >= len(ends) or unit >= last:
                    raise fields.damaged("a page names a layer or a unit that does not exist")
                found[layer].append(Entry(places[layer], length, check, unit, passes, top))
                places[layer] += length
            unit += 1
    if places != ends:
        raise CorruptStreamError("segments of the index do not fill their layers", ends[0])
    return found


def _chunks(pages: list[Fields], container: Container, end: int) -> list[Entry]:
    """Read the pages of chunks; `end` is where the chunks end."""
    count = len(windows_of(container.header, container.masks))
    found: list[Entry] = []
    place = end
    for number, fields in enumerate(pages):
        start = end - fields.varint()
        if number and start != place:
            raise fields.damaged("a page does not begin where the one before it ends")
        place = start
        for _ in range(min(PAGE, count - PAGE * number) * len(container.header.types)):
            length = fields.varint()
            found.append(Entry(place, length, fields.number("H") if length else 0))
            place += length
        fields.end()
    if place != end:
        raise CorruptStreamError("chunks of the index do not fill their section", end)
    return found
