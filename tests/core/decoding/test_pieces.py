"""Containers decoded piece by piece: the surfaces that they hold."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

import lodestream as ls
from lodestream.container.reader import read_index
from lodestream.decoding import pieces
from lodestream.decoding.pieces import why_not_by_pieces
from lodestream.decoding.piecewise import PiecewiseDecoder
from lodestream.scratch import IN_MEMORY, FolderScratch, Room

from ..encoding.grid_surfaces import SURFACES, container_of


def _read(container: bytes) -> Callable[[int, int], bytes]:
    return lambda offset, length: container[offset : offset + length]


def _decoder(container: bytes, level: int | None = None) -> PiecewiseDecoder:
    read = _read(container)
    return PiecewiseDecoder(read, read_index(read, len(container)), level)


@pytest.mark.sweep(16)
@pytest.mark.parametrize("name", SURFACES)
@pytest.mark.parametrize("memory", [1, 1 << 21])
@pytest.mark.long
def test_rows_make_the_surface(name: str, memory: int, tmp_path: Path) -> None:
    container = container_of(name)
    decoder, told = _decoder(container), [0.0]
    expected = ls.decode(container)
    if decoder.header.plane is not None:
        pytest.skip("x and y are made of rules")
    room = IN_MEMORY if memory == 1 else Room(lambda: FolderScratch(tmp_path), 1)
    _check(decoder.surface(room, memory, told.append), expected)
    assert told == sorted(told)
    assert told[-1] == 1.0


def _check(found: ls.Surface, expected: ls.Surface) -> None:
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


def _check_levels(container: bytes) -> None:
    """All levels, from a part of the container and by rows."""
    decoder = ls.Decoder()
    decoder.feed(container)
    for level in range(decoder.header.levels if decoder.header else 0):
        with pytest.MonkeyPatch.context() as patch:
            patch.setattr(pieces, "_CORE_POINTS", 300)
            found = _decoder(container, level).surface(IN_MEMORY, 1, lambda fraction: None)
        expected = decoder.surface(level)
        _check(found, expected)
        if found.joints is None or expected.joints is None:
            assert found.joints is expected.joints
            continue
        for own, other in zip(found.joints.nodes or (), expected.joints.nodes or (), strict=True):
            np.testing.assert_array_equal(own[0], other[0])
            np.testing.assert_array_equal(own[1], other[1])


@pytest.mark.sweep(8)
@pytest.mark.parametrize("name", SURFACES)
def test_rows_make_every_level(name: str) -> None:
    container = container_of(name)
    if _decoder(container).header.plane is not None:
        pytest.skip("x and y are made of rules")
    _check_levels(container)


@given(
    st.tuples(st.integers(1, 150), st.integers(2, 90)),
    st.tuples(st.booleans(), st.booleans()),
    st.sampled_from([np.int16, np.uint8, np.int64, np.float32, np.float64]),
    st.sampled_from(["all", "holes", "few"]),
    st.integers(0, 2**32),
)
def test_rows_make_every_level_of_any_size(
    shape: tuple[int, int], closed: tuple[bool, bool], dtype: type[np.generic], valid: str, seed: int
) -> None:
    rng = np.random.default_rng(seed)
    y, x = np.mgrid[: shape[0], : shape[1]]
    heights = (90 + 80 * np.sin(x / 5 + seed) * np.cos(y / 7) + rng.normal(size=shape)).astype(dtype)
    mask = None
    if valid != "all":
        mask = rng.random(shape) < (0.7 if valid == "holes" else 0.01)
        mask.flat[0] = True
    surface = ls.Surface(
        heights,
        (closed[0] and shape[0] > 2, closed[1] and shape[1] > 2),
        mask=mask,
        metadata={"geotransform": [3.0, 0.5, 0.0, 7.0, 0.0, -2.0], "unit": "m"},
        attributes=None if mask is not None else {"rain": rng.integers(0, 9, shape).astype(np.uint16)},
    )
    _check_levels(ls.encode(surface))


def test_levels_of_angles_do_not_say_what_a_seam_adds() -> None:
    """The last column of the file, a full turn on, belongs to the finest level alone."""
    rng = np.random.default_rng(4)
    y, x = np.mgrid[:40, :60]
    points = np.stack([x * 6 + rng.normal(size=x.shape) / 9, y * 3 + rng.normal(size=x.shape) / 9, x * y / 99], axis=2)
    metadata = {"seam": "cols", "turn": [0, 360.0, 1], "unit": "degree"}
    container = ls.encode(ls.Surface(points.astype(np.float32), (False, True), metadata=metadata))
    _check_levels(container)
    assert _decoder(container, 1).surface(IN_MEMORY, 1, lambda fraction: None).metadata == {"unit": "degree"}
    assert _decoder(container).surface(IN_MEMORY, 1, lambda fraction: None).metadata == metadata


def test_a_flipped_bit_of_a_segment_or_a_chunk_is_found_where_it_is() -> None:
    container = container_of("floats")
    index = read_index(_read(container), len(container))
    for part, what in ((index.segments[-1], "segment"), (next(c for c in index.chunks if c.range.length), "chunk")):
        damaged = bytearray(container)
        damaged[part.range.end - 1] ^= 1
        with pytest.raises(ls.CorruptStreamError, match=f"a {what} with the checksum that the index tells") as caught:
            _decoder(bytes(damaged)).surface(IN_MEMORY, 1 << 21, lambda fraction: None)
        assert caught.value.offset == part.range.offset


def test_kept_holes_come_back() -> None:
    points = SURFACES["floats"][0].points.copy()
    points[3:60, 7:99] = np.nan
    points[100, 5:70] = np.inf
    container = ls.encode(points)
    found = _decoder(container).surface(IN_MEMORY, 1, lambda fraction: None)
    np.testing.assert_array_equal(found.points, ls.decode(container).points)


def test_damage_is_found() -> None:
    container = bytearray(container_of("integers"))
    segment = _decoder(bytes(container)).index.segments[-1]
    container[segment.range.offset] ^= 1
    with pytest.raises(ls.CorruptStreamError, match="checksum"):
        _decoder(bytes(container)).surface(IN_MEMORY, 1, lambda fraction: None)


def test_what_cannot_be_decoded_pieces_says_so() -> None:
    heights = SURFACES["integers"][0].points
    rows, columns = np.mgrid[:50, :60].astype(float)
    surface = ls.Surface(np.stack([columns, rows, np.hypot(rows, columns)], axis=-1))
    reason = why_not_by_pieces(_decoder(ls.encode(surface)).header, 1 << 30)
    assert reason is not None
    assert "rules" in reason
    assert why_not_by_pieces(_decoder(ls.encode(heights)).header, 0) is None
    header = _decoder(ls.encode(ls.Surface(blocks=[ls.Block(heights), ls.Block(heights[:90])]))).header
    needed = 40 * heights.size
    assert why_not_by_pieces(header, needed) is None
    assert why_not_by_pieces(header, needed - 1) == (
        f"its largest block is decoded as a whole, in about {-(-needed >> 20)} MiB"
    )
    assert why_not_by_pieces(header, needed - 1, header.levels - 1) is None
