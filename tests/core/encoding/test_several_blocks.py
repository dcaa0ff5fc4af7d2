"""Surfaces of several blocks, and such that touch themselves, built and checked by runs of grids."""

from __future__ import annotations

import io
import os
from concurrent.futures import ThreadPoolExecutor
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

import lodestream as ls
from lodestream.container.reader import read_index
from lodestream.decoding.inspection import Inspection, inspect
from lodestream.decoding.piecewise import PiecewiseDecoder
from lodestream.encoding import folder_build, tasks, transform_phases
from lodestream.encoding.encode import encode
from lodestream.encoding.memory import BESIDE, OF_BAND, least_memory
from lodestream.encoding.pieces import Pieces
from lodestream.encoding.prepared import prepare
from lodestream.encoding.state_errors import measured_runs
from lodestream.quality import Quality
from lodestream.residual import chunk_coder
from lodestream.scratch import IN_MEMORY, FolderScratch, Room
from lodestream.surface import Block, Surface

from ..container.forgery import with_layer_errors
from ..surfaces import index_of
from .block_surfaces import block_surface
from .test_any_pieces import built

try:
    import resource
except ImportError:  # not on Windows
    resource = None  # type: ignore[assignment]


def _decoder(container: bytes, level: int | None = None) -> PiecewiseDecoder:
    def read(offset: int, length: int) -> bytes:
        return container[offset : offset + length]

    return PiecewiseDecoder(read, read_index(read, len(container)), level)


#: What a container does not keep is another matter, see test_losses.
pytestmark = pytest.mark.filterwarnings("ignore:values of attributes at:lodestream.FormatWarning")


def _checked(data: bytes, channels: int = 3) -> Inspection:
    """Checked some blocks at a time: in memory for the largest of `_plates`, with so many channels."""
    largest = max(block.shape[0] * block.shape[1] for block in _plates().blocks)
    return inspect(io.BytesIO(data), max_vertices=1 << 20, memory=40 * largest * channels)


@cache
def _plates(more: str = "") -> Surface:
    return block_surface("plates", (260, 240), 2, "float32", more, np.random.default_rng(7))


@cache
def _container(more: str = "") -> bytes:
    return ls.encode(_plates(more))


@pytest.mark.parametrize("more", ["", "holes", "attributes"])
@pytest.mark.parametrize("place", [0, 1])
@pytest.mark.long
def test_wrong_errors_are_found(more: str, place: int) -> None:
    data = _container(more)
    with pytest.raises(ls.CorruptStreamError, match="RMS and maximum error of layer 0"):
        _checked(with_layer_errors(data, 0, 0.999, place), 6 if more == "attributes" else 3)


def test_a_flipped_bit_is_found() -> None:
    data = bytearray(_container())
    for place in range(20, len(data), len(data) // 40):
        data[place] ^= 4
        with pytest.raises(ls.LodestreamError):
            _checked(bytes(data))
        data[place] ^= 4


def test_blocks_that_are_too_large_are_refused() -> None:
    data = _container()
    assert _checked(data).errors_checked
    with pytest.raises(
        ls.TooLargeError,
        match=r"at most 1 MiB to check, .* its largest block",
    ):
        inspect(io.BytesIO(data), max_vertices=1 << 20, memory=1 << 20)


def test_values_that_are_not_finite_are_holes_whoever_checks(monkeypatch: pytest.MonkeyPatch) -> None:
    points, decode = _plates().blocks[0].points, chunk_coder.decode_chunk

    def forged(known: NDArray[Any], chunk: bytes, offset: int) -> NDArray[Any]:
        values = decode(known, chunk, offset)
        values[:1] = np.nan
        return values

    # Two channels are rough, so that the extent is not looked at; the third one has a residual.
    data = ls.encode(Surface(blocks=[Block(points), Block(points + 99)]), attribute_precision={"x": 0.1, "y": 0.1})
    monkeypatch.setattr(chunk_coder, "decode_chunk", forged)
    for memory in (1 << 30, 40 * points.size):
        with pytest.raises(ls.CorruptStreamError, match="holes"):
            inspect(io.BytesIO(data), max_vertices=1 << 20, memory=memory)


@pytest.mark.parametrize("first", [1 << 20, 1_258_291])
def test_a_build_goes_on_though_other_arrays_are_in_memory(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, first: int
) -> None:
    xr = pytest.importorskip("xarray")
    shapes = [(200, 175), *[(160, 125)] * 5]
    values = [np.random.default_rng(k).integers(0, 300, shape).astype(np.int16) for k, shape in enumerate(shapes)]
    tree = xr.DataTree.from_dict(
        {f"block_{k}": xr.Dataset({"z": (("y", "x"), array)}) for k, array in enumerate(values)}
    )
    code = tasks.code

    def cut(*arguments: Any) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr(tasks, "code", cut)
    with pytest.raises(KeyboardInterrupt):
        ls.encode(tree, out=tmp_path / "a.lode", memory=first, scratch=tmp_path / "scratch")
    monkeypatch.setattr(tasks, "code", code)
    ls.encode(tree, out=tmp_path / "a.lode", memory=(1 << 20) + 1_258_291 - first, scratch=tmp_path / "scratch")
    for block, array in zip(ls.decode((tmp_path / "a.lode").read_bytes()).blocks, values, strict=True):
        assert np.array_equal(block.points, array)


@pytest.mark.skipif(resource is None, reason="the system does not limit files")
def test_many_blocks_take_few_files(tmp_path: Path) -> None:
    assert resource is not None
    rng = np.random.default_rng(1)
    blocks = []
    for _ in range(70):
        mask = rng.random((5, 6)) < 0.9
        blocks.append(Block(rng.normal(size=(5, 6)), mask=mask, attributes={"a": rng.normal(size=(5, 6))}))
    surface = Surface(blocks=blocks)
    expected = encode(surface)
    before = resource.getrlimit(resource.RLIMIT_NOFILE)
    resource.setrlimit(resource.RLIMIT_NOFILE, (len(os.listdir("/dev/fd")) + 60, before[1]))
    try:
        with ThreadPoolExecutor(1) as executor:
            ls.encode(surface, out=tmp_path / "a.lode", memory=1 << 20, executor=executor)
        found = _decoder(expected).surface(Room(lambda: FolderScratch(tmp_path / "room")), 1, lambda fraction: None)
    finally:
        resource.setrlimit(resource.RLIMIT_NOFILE, before)
    assert (tmp_path / "a.lode").read_bytes() == expected
    for own, other in zip(found.blocks, ls.decode(expected).blocks, strict=True):
        assert own.points.tobytes() == other.points.tobytes()


def test_damage_is_found_where_it_is_decoded() -> None:
    container = bytearray(_container())
    segment = _decoder(bytes(container)).index.segments[-1]
    container[segment.range.offset] ^= 1
    with pytest.raises(ls.CorruptStreamError, match="checksum"):
        _decoder(bytes(container)).surface(IN_MEMORY, 1, lambda fraction: None)


@pytest.mark.long
def test_coefficients_that_are_too_large_are_noticed(monkeypatch: pytest.MonkeyPatch) -> None:
    surface = _plates()
    monkeypatch.setattr(transform_phases, "COEFFICIENT_BITS", 0)  # so that coefficients of fitted predictors do not fit
    plain = built(prepare(surface, Quality()), 1, 600)
    assert plain == encode(surface)
    assert ls.decode(plain).blocks[0].points.tobytes() == surface.blocks[0].points.tobytes()


def test_a_surface_that_is_not_divided_takes_more_memory_at_least() -> None:
    plates, sphere = _plates(), block_surface("sphere", (400, 300), 1, "float32", "", np.random.default_rng(1))
    largest = max(block.points.size for block in plates.blocks)
    assert least_memory(plates) == BESIDE + OF_BAND * largest
    assert least_memory(sphere) == BESIDE + OF_BAND * sphere.points.size
    plane = Surface(sphere.points[50:80, 10:20])
    assert least_memory(plane) == BESIDE + OF_BAND * plane.points.size
    tall = Surface(np.concatenate([sphere.points[50:80, 10:20] + k for k in np.arange(20, dtype=np.float32)]))
    assert least_memory(tall) < BESIDE + OF_BAND * tall.points.size // 8


def test_many_small_blocks_go_together() -> None:
    surface = _plates()
    prepared = prepare(surface, Quality())
    points = sum(block.shape[0] * block.shape[1] for block in surface.blocks)
    header = index_of(_container()).header
    assert measured_runs(header, points) == [range(len(surface.blocks))]
    assert measured_runs(header, 1) == [range(k, k + 1) for k in range(len(surface.blocks))]
    runs, together = (Pieces(prepared.layout, size, 600) for size in (1, 2 * points))
    for level in runs.levels:
        assert [run.tiles.start for run in runs.of(level)[1:]] == [run.tiles.stop for run in runs.of(level)[:-1]]
        assert sum(len(run.tiles) for run in runs.of(level)) == len(prepared.layout.tiles_of(level))
        assert len(together.of(level)) == 1
    assert len(runs.of(prepared.layout.levels)) > 1


def test_a_build_of_blocks_goes_on_where_it_was_cut(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    surface = _plates()
    expected, calls = _container(), [0]
    step, measure = tasks.second_step, tasks.measure

    def counted(*arguments: Any) -> None:
        calls[0] += 1
        step(*arguments)

    def cut(*arguments: Any) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr(tasks, "second_step", counted)
    monkeypatch.setattr(tasks, "measure", cut)
    monkeypatch.setattr(folder_build, "_FEWEST", 1)
    with pytest.raises(KeyboardInterrupt):
        ls.encode(surface, out=tmp_path / "a.lode", memory=1 << 20, scratch=tmp_path / "scratch")
    before = calls[0]
    assert before > 0
    monkeypatch.setattr(tasks, "measure", measure)
    ls.encode(surface, out=tmp_path / "a.lode", memory=1 << 20, scratch=tmp_path / "scratch")
    assert calls[0] == before, "what was transformed is not transformed again"
    assert (tmp_path / "a.lode").read_bytes() == expected
    assert not list((tmp_path / "scratch").iterdir())
