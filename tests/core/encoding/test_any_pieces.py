"""A part is the part of the whole: whatever the pieces, the scratch and the threads are, the bytes are the same."""

from __future__ import annotations

import io
import tempfile
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from pathlib import Path
from typing import Any
from unittest import mock

import numpy as np
import pytest
from hypothesis import assume, example, given
from hypothesis import strategies as st
from numpy.typing import NDArray

import lodestream as ls
from lodestream.container.reader import read_index
from lodestream.decoding import inspection
from lodestream.decoding.inspection import inspect
from lodestream.decoding.piecewise import PiecewiseDecoder
from lodestream.encoding import folder_build, memory
from lodestream.encoding import prepared as preparing
from lodestream.encoding.build import Build
from lodestream.encoding.effort import CHOICES
from lodestream.encoding.executing import Execution
from lodestream.encoding.lattice_coordinates import exact_lattices
from lodestream.encoding.phases import Phases
from lodestream.encoding.prepared import Prepared, prepare
from lodestream.quality import EFFORTS, Quality
from lodestream.scratch import IN_MEMORY, FolderScratch, MemoryScratch, Scratch
from tests.examples import examples

from .block_surfaces import KINDS, block_surface
from .grid_surfaces import SURFACES, container_of, some_large

#: What a container does not keep is another matter, see test_losses.
pytestmark = pytest.mark.filterwarnings("ignore:values of attributes at:lodestream.FormatWarning")

DTYPES = ["int8", "uint16", "int32", "int64", "uint64", "float32", "float64"]

#: More points than any surface here has.
WHOLE = 1 << 30


def built(prepared: Prepared, points: int, core_points: int, threads: int = 1, folder: bool = True) -> bytes:
    """The first stream that is tried, built by pieces of about so many points, in a folder or in memory."""
    with tempfile.TemporaryDirectory() as path:
        scratch: Scratch = FolderScratch(path) if folder else MemoryScratch()
        build, out = Build(scratch, prepared, exact_lattices(prepared), points, core_points), io.BytesIO()
        Phases(build, Execution(build, None, threads), lambda fraction: None).write(out)
    return out.getvalue()


@pytest.mark.sweep(7)
@pytest.mark.parametrize("name", SURFACES)
@pytest.mark.long
def test_any_pieces_of_a_grid_give_the_container(name: str) -> None:
    surface, quality = SURFACES[name]
    with some_large():
        prepared = prepare(surface, Quality.of(**quality))
        assert built(prepared, 1, 600, threads=2) == container_of(name)
        assert built(prepared, 12_000, 600, folder=False) == container_of(name)


def _values(dtype: str, shape: tuple[int, ...], kind: str, rng: np.random.Generator) -> NDArray[Any]:
    """Smooth ones, or any of which integers go to the ends of their range."""
    if kind == "ends":
        if dtype[0] == "f":
            return (rng.normal(size=shape) * 10.0 ** rng.integers(-30, 30, shape)).astype(dtype)
        limits = np.iinfo(dtype)
        ends = rng.choice(np.array([limits.min, limits.min + 1, 0, limits.max - 1, limits.max], dtype), shape)
        return np.where(rng.random(shape) < 0.3, ends, rng.integers(limits.min, limits.max, shape, dtype, True))
    waves = 60 + 50 * np.sin(np.arange(shape[0]) / 9)[:, None] * np.cos(np.arange(shape[1]) / 7)
    found = (waves.reshape(*shape[:2], *[1] * (len(shape) - 2)) + rng.normal(size=shape)).astype(dtype)
    if kind == "far":  # neighbours that float64 cannot tell apart, where integers are that wide
        found += np.array(np.iinfo(dtype).max - 120 if dtype[0] != "f" else 2**20, dtype)
    return found


def _grid(
    dtype: str, shape: tuple[int, int], channels: int, closed: tuple[bool, bool], kind: str, more: str, seed: int
) -> ls.Surface:
    rng = np.random.default_rng(seed)
    points = _values(dtype, shape if channels == 1 else (*shape, channels), kind, rng)
    mask, attributes = None, {}
    if "holes" in more:
        mask = rng.random(shape) < 0.9
        mask[rng.integers(0, shape[0]) :, : rng.integers(0, shape[1]) // 2] = False
        mask[0, -1] = True
    if "attributes" in more:
        attributes = {
            "id": _values("int64", shape, "ends", rng),
            "count": _values("uint64", (*shape, 2), "smooth", rng),
            "speed": _values("float32", shape, "smooth", rng),
        }
    return ls.Surface(points, closed, mask=mask, attributes=attributes)


def _check(
    surface: ls.Surface, precision: Any, tile: tuple[int, int] | None, points: int, core: int, threads: int, seed: int
) -> None:
    """Pieces give the bytes of one piece; and decoded and inspected in pieces these are what they are as a whole.

    With a ``tile``, in exponents of two, tiles are so small, and units of any size are large where that is worth it.
    """
    effort = EFFORTS[seed % len(EFFORTS)]
    with pytest.MonkeyPatch.context() as patch:
        if tile is not None:
            patch.setattr(preparing, "tile_exponents", lambda *_: tile)
            patch.setattr(preparing, "square", lambda bits: tile)
            patch.setitem(CHOICES, effort, replace(CHOICES[effort], large_points=200))
        try:
            prepared = prepare(surface, Quality.of(precision, effort=effort))
            container = built(prepared, WHOLE, WHOLE, folder=False)
        except ls.InputError:
            assume(False)  # this precision is too small for the values
        assert built(prepared, points, core, threads, folder=bool(seed % 2)) == container
    whole = ls.Decoder()
    whole.feed(container)
    assert whole.header is not None
    if whole.header.plane is None:
        for level in (seed % (whole.header.levels + 1), None):
            _check_decoded(
                _decoder(container, level).surface(IN_MEMORY, 1, lambda fraction: None), whole.surface(level)
            )
        if prepared.arrangement is None:
            _check_window(whole, np.random.default_rng(seed))
    with mock.patch.object(inspection, "why_not_by_pieces", return_value=None):
        inspect(io.BytesIO(container), max_vertices=1 << 20, memory=1)


def _decoder(container: bytes, level: int | None = None) -> PiecewiseDecoder:
    def read(offset: int, length: int) -> bytes:
        return container[offset : offset + length]

    return PiecewiseDecoder(read, read_index(read, len(container)), level)


def _check_decoded(found: ls.Surface, expected: ls.Surface) -> None:
    assert found.metadata == expected.metadata
    assert repr(found.joints) == repr(expected.joints)
    for own, other in zip(found.blocks, expected.blocks, strict=True):
        assert own.closed == other.closed
        assert own.points.tobytes() == other.points.tobytes()
        assert (own.mask is None) == (other.mask is None)
        if own.mask is not None and other.mask is not None:
            assert own.mask.tobytes() == other.mask.tobytes()
        assert list(own.attributes) == list(other.attributes)
        for name, values in own.attributes.items():
            assert values.tobytes() == other.attributes[name].tobytes()


def _check_window(whole: ls.Decoder, rng: np.random.Generator) -> None:
    expected = whole.surface()
    top, bottom = sorted(int(k) for k in rng.integers(0, expected.shape[0] + 1, 2))
    left, right = sorted(int(k) for k in rng.integers(0, expected.shape[1] + 1, 2))
    place = slice(top, bottom), slice(left, right)
    if (bottom - top) * (right - left) > 1 and (expected.mask is None or expected.mask[place].any()):
        window = whole.layers[-1].window(((top, bottom), (left, right)))
        assert window.points.tobytes() == np.ascontiguousarray(expected.points[place]).tobytes()


rows, columns = st.integers(1, 40) | st.integers(1, 150), st.integers(1, 60)
#: Small tiles make pieces of small surfaces; of the usual ones a row has 128 rows of points.
tiles = st.sampled_from([None, (4, 4), (3, 5), (5, 3)])


@examples(8)
@given(
    dtype=st.sampled_from(DTYPES),
    shape=st.tuples(rows, columns),
    channels=st.sampled_from([1, 1, 3]),
    closed=st.tuples(st.booleans(), st.booleans()),
    kind=st.sampled_from(["smooth", "far", "ends"]),
    more=st.sampled_from(["", "", "holes", "attributes", "holes and attributes"]),
    precision=st.sampled_from([None, "0.1%", 0.5]),
    tile=tiles,
    points=st.integers(1, 3000),
    core=st.integers(1, 600),
    threads=st.integers(1, 3),
    seed=st.integers(0, 2**32 - 1),
)
@example("int64", (100, 30), 1, (True, True), "ends", "holes", None, (4, 4), 1, 9, 2, 0)
@example("uint64", (298, 66), 1, (True, False), "far", "attributes", None, None, 1, 9, 1, 1)
@example("int16", (150, 9), 3, (True, True), "smooth", "", "0.1%", (5, 3), 1000, 9, 1, 2)
@example("float64", (149, 33), 3, (True, True), "smooth", "holes and attributes", None, (3, 5), 1, 9, 1, 3)
@example("uint64", (131, 40), 3, (False, False), "ends", "holes", None, (4, 4), 300, 9, 1, 4)
def test_any_pieces_of_any_grid(
    dtype: str,
    shape: tuple[int, int],
    channels: int,
    closed: tuple[bool, bool],
    kind: str,
    more: str,
    precision: Any,
    tile: tuple[int, int] | None,
    points: int,
    core: int,
    threads: int,
    seed: int,
) -> None:
    assume(shape[0] * shape[1] > 2)
    _check(_grid(dtype, shape, channels, closed, kind, more, seed), precision, tile, points, core, threads, seed)


sides = st.integers(4, 20) | st.integers(4, 60)


@examples(5)
@given(
    kind=st.sampled_from(KINDS),
    shape=st.tuples(sides, sides),
    count=st.integers(1, 4),
    dtype=st.sampled_from(["float32", "float64", "int32", "int64"]),
    more=st.sampled_from(["", "", "holes", "attributes", "holes and attributes"]),
    precision=st.sampled_from([None, "0.1%", 0.02]),
    tile=tiles,
    points=st.integers(1, 2000),
    core=st.integers(1, 300),
    threads=st.integers(1, 3),
    seed=st.integers(0, 2**32 - 1),
)
@example("plates", (60, 50), 2, "float32", "holes and attributes", None, (4, 4), 1, 9, 2, 1)
@example("plates", (90, 80), 3, "float64", "", "0.1%", None, 1, 1, 2, 2)
@example("cylinders", (80, 60), 3, "float32", "", None, (3, 5), 1, 1, 1, 3)
@example("sphere", (60, 70), 1, "float32", "attributes", None, (4, 4), 1, 1, 1, 4)
@example("seam", (60, 63), 1, "float32", "", "0.1%", None, 1, 1, 1, 5)
@example("moebius", (24, 90), 3, "int32", "", None, (3, 5), 1, 9, 1, 6)
@example("heights", (120, 40), 3, "int64", "holes", None, (4, 4), 1, 1, 1, 7)
@pytest.mark.long
def test_any_pieces_of_any_blocks(
    kind: str,
    shape: tuple[int, int],
    count: int,
    dtype: str,
    more: str,
    precision: Any,
    tile: tuple[int, int] | None,
    points: int,
    core: int,
    threads: int,
    seed: int,
) -> None:
    surface = block_surface(kind, shape, count, dtype, more, np.random.default_rng(seed))
    _check(surface, precision, tile, points, core, threads, seed)


#: A grid and blocks with everything that is in files of their own.
_LARGER_THAN_MEMORY = {
    "a torus": _grid("float64", (149, 33), 3, (True, True), "smooth", "holes and attributes", 3),
    "integers of 64 bits": _grid("uint64", (150, 40), 1, (True, False), "far", "holes and attributes", 1),
    "plates": block_surface("plates", (90, 80), 2, "float32", "holes and attributes", np.random.default_rng(1)),
    "cylinders": block_surface("cylinders", (80, 60), 3, "float64", "attributes", np.random.default_rng(3)),
}


@pytest.mark.sweep(2)
@pytest.mark.parametrize(
    ("name", "wanted"),
    [("a torus", True), ("integers of 64 bits", False), ("plates", False), ("cylinders", True)],
)
def test_a_surface_larger_than_memory_gives_the_same_bytes(name: str, wanted: bool, tmp_path: Path) -> None:
    surface, spied = _LARGER_THAN_MEMORY[name], folder_build.FolderBuild.container
    # By pieces goes what memory does not hold, or whatever an executor is given for.
    with (
        ThreadPoolExecutor(2) as executor,
        mock.patch.multiple(folder_build, _FEWEST=1, _MOST=1),
        mock.patch.multiple(memory, WHOLE=1 << 20, _WHOLE_WITH_HOLES=1 << 20),
        mock.patch.object(folder_build.FolderBuild, "container", autospec=True, side_effect=spied) as container,
    ):
        ls.encode(surface, out=tmp_path / "a.lode", memory=1 << 20, executor=executor if wanted else None)
    container.assert_called_once()
    assert (tmp_path / "a.lode").read_bytes() == ls.encode(surface)
