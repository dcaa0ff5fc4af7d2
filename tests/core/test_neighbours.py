from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray

import lodestream as ls
from lodestream.errors import CorruptStreamError
from lodestream.exactness import NEIGHBOURS, decode_piece
from lodestream.lattice import Lattice, find_lattice
from lodestream.neighbours import decode_window, encode_window
from lodestream.selection import Wish

from .coding import uncompiled
from .surfaces import errors, index_of, terrain

Values = NDArray[Any]

SHAPES = [(1, 1), (1, 2), (1, 57), (2, 1), (33, 1), (2, 3), (5, 4), (17, 23)]
KINDS = ["constant", "terraces", "noise", "far", "spikes"]
DTYPES = ["int8", "int16", "int32", "int64", "uint8", "uint16", "uint32", "uint64", "float32", "float64"]


def steps_of(kind: str, shape: tuple[int, int]) -> Values:
    """Whole numbers from 0 to 100, or to 2**24 - 3."""
    rng = np.random.default_rng(shape)
    row, column = np.mgrid[: shape[0], : shape[1]]
    found = {
        "constant": np.full(shape, 7),
        "terraces": np.floor(40 + 5 * np.sin(row / 5) + 5 * np.cos(column / 7 + row / 9)),
        "noise": rng.integers(0, 101, shape),
        "far": rng.integers(0, 2**24 - 3, shape),
        "spikes": 100 * (rng.random(shape) < 0.05),
    }[kind]
    return np.asarray(found, np.int64)


def assert_comes_back(original: Values, restored: Values, valid: Values | None, lattice: Lattice) -> bytes:
    data = encode_window(original, restored, valid, lattice)
    found = decode_window(restored, valid, lattice, data, 0)
    chosen = np.ones(original.shape, bool) if valid is None else valid
    assert found.dtype == original.dtype
    assert found[chosen].tobytes() == original[chosen].tobytes()
    return data


@pytest.mark.parametrize("dtype", DTYPES)
@pytest.mark.parametrize("kind", KINDS)
def test_windows_of_all_shapes_and_types_come_back(kind: str, dtype: str) -> None:
    for number, shape in enumerate(SHAPES):
        steps = steps_of(kind, shape)
        small = np.dtype(dtype).itemsize == 1 or (np.dtype(dtype).itemsize == 2 and kind == "far")
        original = (steps % 100 if small else steps).astype(dtype)
        if dtype == "float64":
            original = original / 10
        lattice = find_lattice(original)
        assert lattice is not None
        rng = np.random.default_rng(number)
        near = (original + rng.integers(0, 3, shape).astype(dtype)).astype(dtype)
        holes = rng.random(shape) < 0.3
        for restored in (original, near, np.full_like(original, original.ravel()[0])):
            for valid in (None, ~holes, np.zeros(shape, bool)):
                assert_comes_back(original, restored, valid, lattice)


@given(st.data())
def test_any_numbers_restore_any_others(data: st.DataObject) -> None:
    shape = data.draw(st.tuples(st.integers(1, 6), st.integers(1, 6)))
    size = shape[0] * shape[1]

    def drawn() -> Values:
        numbers = st.integers(1 - 2**24, 2**24 - 1)
        return np.array(data.draw(st.lists(numbers, min_size=size, max_size=size)), np.int32).reshape(shape)

    valid = np.array(data.draw(st.lists(st.booleans(), min_size=size, max_size=size))).reshape(shape)
    assert_comes_back(drawn(), drawn(), valid, Lattice("affine", 0.0, 1.0))


@pytest.mark.parametrize("lattice", [Lattice("affine", 1e300, 5e-324), Lattice("decimal", -1e308, 1e308)])
def test_values_off_the_lattice_are_taken_as_far_as_they_go(lattice: Lattice) -> None:
    restored = np.array([[1e300, -1e300, 0.0], [np.finfo(np.float64).max, -1.0, 5e-324]])
    data = encode_window(restored, restored, None, lattice)
    assert np.isfinite(decode_window(restored, None, lattice, data, 0)).all()


LATTICE = Lattice("affine", 3.0, 2.0)


@given(st.binary(max_size=200), st.integers(1, 9), st.integers(1, 9))
def test_any_bytes_give_values_or_a_refusal(data: bytes, rows: int, columns: int) -> None:
    restored = (3 + 2 * np.arange(rows * columns).reshape(rows, columns)).astype(np.float32)
    try:
        found = decode_window(restored, None, LATTICE, data, 0)
    except CorruptStreamError:
        return
    assert (found.dtype, found.shape) == (restored.dtype, restored.shape)
    assert np.isfinite(found).all()


def test_bytes_that_are_missing_or_too_many_are_refused_with_their_place() -> None:
    restored = np.full((20, 20), 3.0)
    data = encode_window(3 + 2.0 * steps_of("noise", (20, 20)), restored, None, LATTICE)
    with pytest.raises(CorruptStreamError, match="at least 24 bytes") as short:
        decode_window(restored, None, LATTICE, data[:23], 500)
    assert short.value.offset == 500
    with pytest.raises(CorruptStreamError, match="at most") as long:
        decode_window(restored, None, LATTICE, data + bytes(10), 500)
    assert 500 + len(data) <= long.value.offset < 500 + len(data) + 10


def test_a_list_of_values_has_no_neighbours() -> None:
    with pytest.raises(CorruptStreamError, match="rule of exactness"):
        decode_piece(np.zeros(4, np.float32), NEIGHBOURS + bytes(40), 0)


def samples() -> list[tuple[Values, Values, Values]]:
    """Originals, what layers might restore of them, and which are valid."""
    found = []
    for kind in KINDS:
        steps = steps_of(kind, (14, 19)).astype(np.int32)
        rough = np.full_like(steps, int(steps.mean()))
        found.append((steps, rough, np.random.default_rng(3).random(steps.shape) > 0.1))
    return found


def test_the_compiled_coder_does_what_the_plain_one_does() -> None:
    script = (
        "from lodestream.lattice import Lattice\n"
        "from lodestream.neighbours import decode_window, encode_window\n"
        "from tests.core.test_neighbours import samples\n"
        "lattice = Lattice('affine', 0.0, 1.0)\n"
        "for values, restored, valid in samples():\n"
        "    data = encode_window(values, restored, valid, lattice)\n"
        "    found = decode_window(restored, valid, lattice, data, 0)\n"
        "    assert found[valid].tobytes() == values[valid].tobytes()\n"
        "    print(data.hex())"
    )
    lattice = Lattice("affine", 0.0, 1.0)
    assert uncompiled(script).split() == [encode_window(*sample, lattice).hex() for sample in samples()]


def pieces_of(container: bytes) -> list[bytes]:
    return [container[piece.range.offset : piece.range.end] for piece in index_of(container).pieces]


def heights(shape: tuple[int, int] = (140, 300)) -> Values:
    return np.floor(terrain(shape, 4) / 15)


@pytest.mark.parametrize("dtype", ["int8", "uint16", "int64", "float32", "float64"])
@pytest.mark.parametrize("closed", [(False, False), (True, False), (False, True), (True, True)])
def test_terraces_come_back_by_their_neighbours(dtype: str, closed: tuple[bool, bool]) -> None:
    points = (heights((70, 61)) + 20).astype(dtype)
    container = ls.encode(ls.Surface(points, closed))
    assert all(piece[:1] == NEIGHBOURS for piece in pieces_of(container))
    decoded = ls.decode(container)
    assert decoded.points.tobytes() == points.tobytes()
    assert index_of(container).header.exact
    assert (index_of(container).levels[-1].rms, index_of(container).levels[-1].max_error) == (0.0, 0.0)


def test_holes_have_no_part_in_it() -> None:
    points = heights((90, 80)).astype(np.int16)
    mask = np.hypot(*np.mgrid[-40:50, -30:50]) > 20
    surface = ls.Surface(np.where(mask, points, -9999), mask=mask, metadata={"nodata": -9999})
    container = ls.encode(surface)
    assert pieces_of(container)[0][:1] == NEIGHBOURS
    decoded = ls.decode(container)
    assert np.array_equal(decoded.points, surface.points)
    assert decoded.blocks[0].mask is not None
    assert np.array_equal(decoded.blocks[0].mask, mask)


def test_a_precision_holds_with_fewer_bytes_and_its_errors_are_told() -> None:
    points = terrain((140, 300), 5).astype(np.float32)
    container = ls.encode(points, 8.0)
    assert all(piece[:1] == NEIGHBOURS for piece in pieces_of(container))
    decoder = ls.Decoder()
    views = decoder.feed(container)
    rms, largest = errors(points, views[-1].points)
    assert views[-1].complete
    assert largest <= 8.0
    assert views[-1].rms == pytest.approx(rms)
    assert views[-1].max_error == pytest.approx(largest)
    index = index_of(container)
    assert not index.header.exact
    assert (index.levels[-1].rms, index.levels[-1].max_error) == (views[-1].rms, views[-1].max_error)


@pytest.mark.parametrize("dtype", ["float32", "float64"])
def test_a_stream_made_for_one_error_is_brief_where_that_is_shorter(dtype: str) -> None:
    rng = np.random.default_rng(6)
    points = np.cumsum(np.cumsum(rng.normal(size=(130, 90)), 0), 1).astype(dtype)
    container = ls.encode(points, rms=0.3)
    assert all(piece[:1] == NEIGHBOURS for piece in pieces_of(container))
    told = index_of(container).levels[-1]
    rms, largest = errors(points, ls.decode(container).points)
    assert 0.25 < rms <= 0.3
    assert told.rms == pytest.approx(rms)
    assert told.max_error == pytest.approx(largest)


def test_a_window_is_that_of_the_whole() -> None:
    points = heights().astype(np.int16)
    container = ls.encode(points)
    assert len(pieces_of(container)) > 1
    for region in (((0, 20), (0, 30)), ((100, 140), (250, 300)), ((7, 8), (0, 300))):
        place = slice(*region[0]), slice(*region[1])
        decoder = ls.Decoder(Wish(region))
        decoder.feed(container)
        assert np.array_equal(decoder.surface().points, points[place])


def test_smooth_heights_and_small_ones_keep_their_layers() -> None:
    row, column = np.mgrid[:80, :90]
    smooth = np.rint(1e5 * np.sin(row / 30) * np.cos(column / 20)).astype(np.int32)
    for points in (smooth, heights((60, 60)).astype(np.uint8), np.stack([heights((70, 70))] * 3, axis=2)):
        assert not any(piece[:1] == NEIGHBOURS for piece in pieces_of(ls.encode(points)))
