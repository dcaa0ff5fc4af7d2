"""Containers with something else in one of their fields, and all lengths and checksums that enclose it made right."""

from __future__ import annotations

import random
import zlib
from collections.abc import Callable
from dataclasses import dataclass, field

from lodestream.container import sections
from lodestream.container.fields import FieldReader, FieldWriter
from lodestream.container.frames import FrameReader
from tests.torture.targets import EDGES, mutate

__all__ = ["Anatomy", "mutant"]


@dataclass
class Anatomy:
    """A container taken apart.

    Attributes
    ----------
    patches : list of (kind, payload)
        All sections but the pages and the root of the index.
    lengths : list of int
        Those in the root: layers, start, residual, metadata.
    errors : list of bytes
        Those in the root, of layers and then of levels.
    optional : list of (kind, offset, length)
        As the root tells.
    pages : two lists of bytes
    """

    patches: list[tuple[int, bytes]]
    lengths: list[int]
    errors: list[bytes]
    optional: list[tuple[int, int, int]]
    pages: list[list[bytes]]
    counts: list[int] = field(default_factory=list)

    @classmethod
    def of(cls, data: bytes, channels: int) -> Anatomy:
        """Take a sound container apart."""
        frames = list(FrameReader().feed(data))
        *others, pages, root = [(frame.kind, bytes(frame.payload)) for frame in frames]
        fields, size = FieldReader(root[1], 0), 8 + (4 * channels if channels > 1 else 0)
        lengths, errors, counts = [], [], [fields.varint()]
        for _ in range(counts[0]):
            lengths.append(fields.varint())
            errors.append(bytes(fields.take(size)))
        counts.append(fields.varint())
        errors += [bytes(fields.take(size)) for _ in range(counts[1])]
        lengths += [fields.varint() for _ in range(3)]
        counts.append(fields.varint())
        optional = [(fields.byte(), fields.varint(), fields.varint()) for _ in range(counts[2])]
        place = 0
        found: list[list[bytes]] = []
        for _ in range(2):
            counts.append(fields.varint())
            found.append([])
            for _ in range(counts[-1]):
                length = fields.varint()
                fields.take(4)
                found[-1].append(pages[1][place : place + length])
                place += length
        return cls(others, lengths, errors, optional, found, counts)

    def built(self) -> bytes:
        """The container again."""
        out, root = bytearray(sections.SIGNATURE), FieldWriter()
        for kind, payload in self.patches:
            out += sections.section(kind, payload)
        start = len(out)
        out += sections.section(sections.PAGES, b"".join(self.pages[0] + self.pages[1]))
        layers = len(self.lengths) - 3
        root.varint(self.counts[0])
        for length, errors in zip(self.lengths, self.errors, strict=False):
            if layers:
                root.varint(length)
                root.data += errors
            layers -= 1
            if layers <= 0:
                break
        root.varint(self.counts[1])
        root.data += b"".join(self.errors[len(self.lengths) - 3 :])
        for length in self.lengths[-3:]:
            root.varint(length)
        root.varint(self.counts[2])
        for kind, offset, length in self.optional:
            root.byte(kind)
            root.varint(offset)
            root.varint(length)
        for pages, count in zip(self.pages, self.counts[3:], strict=True):
            root.varint(count)
            for page in pages:
                root.varint(len(page))
                root.pack("I", zlib.crc32(page))
        made = sections.section(sections.INDEX, bytes(root.data))
        out += made
        return bytes(out + sections.serialize_footer(len(out) - start, len(made)))

    def _longer(self, number: int, more: int) -> None:
        self.lengths[number] = max(0, self.lengths[number] + more)

    def follow(self, number: int, payload: bytes) -> None:
        """Give a section another payload, and the root its length."""
        kind, old = self.patches[number]
        more = len(sections.section(kind, payload)) - len(sections.section(kind, old))
        self.patches[number] = kind, payload
        layers = len(self.lengths) - 3
        before = [other for other, _ in self.patches[:number]]
        if kind == sections.LAYER:
            self._longer(before.count(sections.LAYER), more)
        elif kind in (sections.RESIDUAL, sections.METADATA):
            self._longer(layers + (2 if kind == sections.METADATA else 1), more)
        elif kind < 128:
            self._longer(layers, more)
        where = len(sections.SIGNATURE) + sum(len(sections.section(*patch)) for patch in self.patches[:number])
        self.optional = [
            (k, max(0, at + more * (at > where)), max(0, length + more * (k == kind and at == where)))
            for k, at, length in self.optional
        ]


def _number(value: int, chance: random.Random) -> int:
    """Another one, which a varint holds."""
    near = value + chance.choice((-2, -1, 1, 2, 64, 128, -64, value, 256))
    return min(abs(chance.choice((near, near, *EDGES[:-1]))), 2**63 - 1)


def mutant(data: bytes, channels: int, chance: random.Random) -> bytes:
    """A container with one thing changed, or several."""
    anatomy = Anatomy.of(data, channels)

    def payload() -> None:
        number = chance.randrange(len(anatomy.patches))
        if chance.random() < 0.5:  # those of which there are few
            number = chance.choice([k for k, (kind, _) in enumerate(anatomy.patches) if kind != sections.LAYER])
        anatomy.follow(number, mutate(anatomy.patches[number][1], chance))

    def page() -> None:
        pages = anatomy.pages[chance.random() < 0.4] or anatomy.pages[0]
        number = chance.randrange(len(pages))
        pages[number] = mutate(pages[number], chance)

    def length() -> None:
        number = chance.randrange(len(anatomy.lengths))
        anatomy.lengths[number] = _number(anatomy.lengths[number], chance)

    def count() -> None:
        number = chance.randrange(len(anatomy.counts))
        anatomy.counts[number] = _number(anatomy.counts[number], chance)

    def errors() -> None:
        number = chance.randrange(len(anatomy.errors))
        anatomy.errors[number] = mutate(anatomy.errors[number], chance)[:64].ljust(len(anatomy.errors[number]), b"\0")

    def optional() -> None:
        if not anatomy.optional or chance.random() < 0.2:
            anatomy.optional.append((chance.randrange(256), _number(50, chance), _number(50, chance)))
            anatomy.counts[2] += 1
            return
        entry = list(chance.choice(anatomy.optional))
        place = chance.randrange(3)
        number = anatomy.optional.index((entry[0], entry[1], entry[2]))
        entry[place] = chance.randrange(256) if place == 0 else _number(entry[place], chance)
        anatomy.optional[number] = entry[0], entry[1], entry[2]

    def exchanged() -> None:
        one, other = (chance.randrange(len(anatomy.patches)) for _ in range(2))
        anatomy.patches[one], anatomy.patches[other] = anatomy.patches[other], anatomy.patches[one]

    def repeated() -> None:
        number = chance.randrange(len(anatomy.patches))
        anatomy.patches.insert(number, anatomy.patches[number])

    def kind() -> None:
        number = chance.randrange(len(anatomy.patches))
        anatomy.patches[number] = chance.choice((1, 2, 3, 4, 6, 7, 128, 200)), anatomy.patches[number][1]

    changes: list[Callable[[], None]] = [payload] * 4 + [page] * 4 + [length, count, errors, optional] * 2
    for change in chance.choices([*changes, exchanged, repeated, kind], k=chance.choice((1, 1, 1, 2))):
        change()
    return anatomy.built()
