"""Containers decoded by bands of rows: the surfaces that they hold."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

import lodestream as ls
from lodestream.container.reader import read_index
from lodestream.decoding.by_rows import RowsDecoder, why_not_by_rows
from lodestream.scratch import IN_MEMORY, Room, Scratch

from ..bands.test_building import SURFACES


def _read(container: bytes) -> Callable[[int, int], bytes]:
    return lambda offset, length: container[offset : offset + length]


def _decoder(container: bytes) -> RowsDecoder:
    read = _read(container)
    return RowsDecoder(read, read_index(read, len(container)))


@pytest.mark.parametrize("name", SURFACES)
@pytest.mark.parametrize("memory", [1, 1 << 21])
def test_rows_make_the_surface(name: str, memory: int, tmp_path: Path) -> None:
    surface, quality = SURFACES[name]
    container = ls.encode(surface, **quality)
    decoder, told = _decoder(container), [0.0]
    expected = ls.decode(container)
    if decoder.header.plane is not None:
        pytest.skip("x and y are made of rules")
    room = IN_MEMORY if memory == 1 else Room(lambda: Scratch(tmp_path), 1)
    found = decoder.surface(room, memory, told.append)
    assert found.metadata == expected.metadata
    assert found.closed == expected.closed
    assert found.points.dtype == expected.points.dtype
    np.testing.assert_array_equal(found.points, expected.points)
    assert (found.mask is None) == (expected.mask is None)
    if found.mask is not None:
        np.testing.assert_array_equal(found.mask, expected.mask)
    assert list(found.attributes) == list(expected.attributes)
    for attribute, values in found.attributes.items():
        np.testing.assert_array_equal(values, expected.attributes[attribute])
    assert told == sorted(told)
    assert told[-1] == 1.0


def test_kept_holes_come_back() -> None:
    points = SURFACES["floats"][0].points.copy()
    points[3:60, 7:99] = np.nan
    points[100, 5:70] = np.inf
    container = ls.encode(points)
    found = _decoder(container).surface(IN_MEMORY, 1, lambda fraction: None)
    np.testing.assert_array_equal(found.points, ls.decode(container).points)


def test_damage_is_found() -> None:
    container = bytearray(ls.encode(SURFACES["integers"][0]))
    segment = _decoder(bytes(container)).index.segments[-1]
    container[segment.range.offset] ^= 1
    with pytest.raises(ls.CorruptStreamError, match="checksum"):
        _decoder(bytes(container)).surface(IN_MEMORY, 1, lambda fraction: None)


def test_what_cannot_be_decoded_by_rows_says_so() -> None:
    heights = SURFACES["integers"][0].points
    rows, columns = np.mgrid[:50, :60].astype(float)
    cases = {
        "several": ls.Surface(blocks=[ls.Block(heights), ls.Block(heights)]),
        "rules": ls.Surface(np.stack([columns, rows, np.hypot(rows, columns)], axis=-1)),
    }
    for word, surface in cases.items():
        reason = why_not_by_rows(_decoder(ls.encode(surface)).header)
        assert reason is not None
        assert word in reason
    assert why_not_by_rows(_decoder(ls.encode(heights)).header) is None
