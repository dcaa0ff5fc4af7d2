"""An effort changes bytes and layers, never values, and each is read by every reader."""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray

import lodestream as ls
from lodestream import OptionError, Quality
from lodestream.encoding.effort import CHOICES
from lodestream.encoding.encode import encode
from lodestream.planning.window_errors import KIND as WINDOW_ERRORS
from lodestream.quality import EFFORTS, Effort
from tests.examples import examples

from ..decoding.comparison import agree_on, assert_same, surfaces
from ..planning.test_region import received
from ..surfaces import index_of, is_told, terrain, torus
from .block_surfaces import block_surface
from .grid_surfaces import SURFACES

every_effort = pytest.mark.parametrize("effort", EFFORTS)


def rough(shape: tuple[int, int]) -> NDArray[np.int16]:
    """Terrain of whole metres."""
    return np.rint(400 * terrain(shape, 3) + np.random.default_rng(4).normal(0, 3, shape)).astype(np.int16)


def test_every_effort_has_choices() -> None:
    assert tuple(CHOICES) == EFFORTS
    for choices in CHOICES.values():
        assert 8 <= choices.tile_bits <= choices.whole_tile_bits <= 16
        assert all(8 <= bits <= 16 for bits in choices.chunk_bits)


@examples(40)
@given(surfaces(), st.sampled_from(EFFORTS), st.integers(0, 99), st.integers(0, 99))
@pytest.mark.long
def test_values_are_the_same_and_another_decoder_shows_them_too(
    surface: ls.Surface, effort: Effort, layer: int, level: int
) -> None:
    container = ls.encode(surface, effort=effort)
    assert_same(ls.decode(container), ls.decode(ls.encode(surface)))
    agree_on(container, layer, level)


@pytest.mark.sweep(5)
@every_effort
@pytest.mark.parametrize(
    "surface",
    [
        ls.Surface(rough((300, 420))),
        ls.Surface(rough((300, 420)), (True, True)),
        ls.Surface(np.where(terrain((290, 300)) > 0, terrain((290, 300), 2), np.nan).astype(np.float32)),
        ls.Surface(torus(150, 170), (True, True), attributes={"heat": terrain((150, 170), 5).astype(np.float32)}),
        ls.Surface(rough((3, 40_000))),
    ],
    ids=["heights", "closed", "holes", "torus", "narrow"],
)
@pytest.mark.long
def test_errors_are_measured_and_windows_are_exact(surface: ls.Surface, effort: Effort) -> None:
    container = ls.encode(surface, effort=effort)
    decoder = ls.Decoder()
    decoder.feed(container)
    first = surface.blocks[0]
    for view, layer in zip(decoder.layers, index_of(container).layers, strict=False):
        away = (view.points.astype(np.float64) - first.points).reshape(*first.shape, -1)
        distances = np.sqrt((away**2).sum(axis=2))[slice(None) if first.mask is None else first.mask]
        assert is_told(layer.rms, float(np.sqrt((distances**2).mean())))
        assert is_told(layer.max_error, float(distances.max()))
    assert np.array_equal(decoder.surface().points, first.points, equal_nan=True)
    rows, columns = (length // 3 for length in first.shape)
    region = (rows, 2 * rows), (columns, 2 * columns)
    window = received(container, ls.Target(region=region)).surface()
    wanted = first.points[rows : 2 * rows, columns : 2 * columns]
    assert np.array_equal(window.points, wanted, equal_nan=True)


def test_small_is_smaller_and_fast_has_fewer_layers() -> None:
    heights = rough((600, 500))
    containers = {effort: ls.encode(heights, effort=effort) for effort in EFFORTS}
    indices = {effort: index_of(container) for effort, container in containers.items()}
    sizes = {effort: len(container) for effort, container in containers.items()}
    layers = {effort: len(index.layers) for effort, index in indices.items()}
    assert sizes["small"] < 0.99 * sizes["default"]
    assert sizes["fast"] < 1.05 * sizes["default"]
    assert layers["fast"] < layers["small"] < 12 < layers["default"]
    assert containers["default"] == ls.encode(heights)
    assert [sum(indices[effort].header.tile) for effort in EFFORTS] == [12, 12, 16]
    assert [indices[effort].header.large > 0 for effort in EFFORTS] == [True, True, False]
    told = [any(section.kind == WINDOW_ERRORS for section in indices[effort].optional) for effort in EFFORTS]
    assert told == [True, True, False]


@pytest.mark.parametrize(
    "points",
    [torus(64, 256, "float64"), terrain((77, 105), 6), np.random.default_rng(7).normal(size=(90, 300)).astype("f4")],
    ids=["smooth", "few", "noise"],
)
def test_surfaces_on_no_lattice_take_chunks_that_suit_them(points: NDArray[Any]) -> None:
    sizes = {effort: len(ls.encode(points, effort=effort)) for effort in EFFORTS}
    assert sizes["small"] <= sizes["default"]
    assert sizes["fast"] < 1.05 * sizes["default"]


def test_fast_has_small_units_where_large_ones_take_many_more_bytes() -> None:
    row, column = np.mgrid[0:300, 0:340]
    steps = (row // 11 * 29 + column // 7 * 13).astype(np.int16)  # alike in one plane, and not in those above
    assert len(ls.encode(steps, effort="fast")) < 1.05 * len(ls.encode(steps))


@pytest.mark.sweep(3)
@every_effort
@pytest.mark.parametrize("name", ["integers", "holes", "torus with attributes"])
@pytest.mark.long
def test_a_build_by_bands_has_the_same_bytes(name: str, effort: Effort, tmp_path: Path) -> None:
    surface = SURFACES[name][0]
    out = tmp_path / "out.lode"
    with ThreadPoolExecutor(2) as executor:
        ls.encode(surface, effort=effort, out=out, executor=executor)
    assert out.read_bytes() == ls.encode(surface, effort=effort)


@every_effort
@pytest.mark.long
def test_blocks_are_built_block_by_block(effort: Effort, tmp_path: Path) -> None:
    surface = block_surface("plates", (150, 130), 2, "float32", "attributes", np.random.default_rng(1))
    out = tmp_path / "out.lode"
    ls.encode(surface, effort=effort, out=out, memory="1MiB")
    assert out.read_bytes() == ls.encode(surface, effort=effort)


@every_effort
@pytest.mark.long
def test_a_build_does_not_continue_one_of_another_effort(effort: Effort, tmp_path: Path) -> None:
    heights = rough((700, 600))

    def cut(fraction: float) -> None:
        if fraction > 0.6:
            raise KeyboardInterrupt

    for other in EFFORTS:
        with pytest.raises(KeyboardInterrupt):
            ls.encode(heights, effort=other, out=tmp_path / "out", memory="1MiB", scratch=tmp_path, progress=cut)
    assert len(list(tmp_path.iterdir())) >= len(EFFORTS)
    ls.encode(heights, effort=effort, out=tmp_path / "out", memory="1MiB", scratch=tmp_path)
    assert (tmp_path / "out").read_bytes() == ls.encode(heights, effort=effort)


@every_effort
@pytest.mark.parametrize("points", [rough((90, 100)), torus(60, 70)], ids=["heights", "torus"])
def test_streams_for_one_error_take_an_effort_too(points: NDArray[Any], effort: Effort) -> None:
    surface = ls.decode(ls.encode(points, rms="0.1%", effort=effort))
    flat = points.reshape(-1, points.shape[2] if points.ndim == 3 else 1).astype(np.float64)
    away = (surface.points.astype(np.float64) - points).reshape(flat.shape)
    assert np.sqrt((away**2).sum(axis=1).mean()) <= 1e-3 * np.linalg.norm(np.ptp(flat, axis=0))


@pytest.mark.parametrize("effort", ["best", "", "Fast", 3, ["fast"]])
def test_what_is_no_effort_is_refused(effort: Any) -> None:
    with pytest.raises(OptionError, match="effort must be one of fast, default, small, and is"):
        encode(np.zeros((3, 4)), effort=effort)
    with pytest.raises(OptionError, match="effort must be one of"):
        Quality(effort=effort)


def test_an_effort_is_part_of_a_quality() -> None:
    heights = rough((40, 50))
    quality = Quality.of(1.0, effort="small")
    assert ls.encode(heights, quality=quality) == ls.encode(heights, 1.0, effort="small")
    assert Quality.parse(["1"], effort="small") == quality != Quality.of(1.0)
    with pytest.raises(OptionError, match="either a quality or"):
        ls.encode(heights, quality=quality, effort="small")
