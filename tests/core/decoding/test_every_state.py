"""Every state that the index tells, the last one before the residual included, shows what `tests.reference` shows.

The errors that it tells are those of what it shows. The surfaces have levels without coefficients, and units that no
layer names: these are known once all layers are there (docs/format.md, section 8, step 1).
"""

from __future__ import annotations

import io
import math
import warnings
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from copy import copy
from dataclasses import dataclass
from functools import lru_cache
from itertools import pairwise
from pathlib import Path
from typing import Any
from unittest.mock import patch

import numpy as np
import pytest
from hypothesis import example, given
from hypothesis import strategies as st
from numpy.typing import NDArray

import lodestream as ls
from lodestream.container.fields import told_roughly
from lodestream.decoding import pieces
from lodestream.decoding.inspection import inspect
from lodestream.decoding.piecewise import PiecewiseDecoder
from lodestream.decoding.progress import initial_state
from lodestream.decoding.view import View
from lodestream.encoding import prepared
from lodestream.entropy.dequantize import UNANNOUNCED
from lodestream.planning.planner import plan
from lodestream.planning.selection import Selection, select
from lodestream.scratch import FolderScratch, Room
from lodestream.target import Region
from tests import reference
from tests.examples import examples

from ..surfaces import follow, index_of, is_told
from .comparison import assert_same, assert_shown

CASES = Path(__file__).parents[4] / "shared" / "cases"


@dataclass(frozen=True)
class Case:
    """A container, the surface that it was made of, and of each block the points that no block before it has."""

    data: bytes
    original: ls.Surface
    firsts: Sequence[NDArray[np.bool_]]


@contextmanager
def small_tiles(exponents: tuple[int, int] | None) -> Iterator[None]:
    """Tiles of so few coefficients that a small surface has several at a level."""
    with pytest.MonkeyPatch.context() as context:
        if exponents is not None:
            context.setattr(prepared, "tile_exponents", lambda *_: exponents)
        yield


def patchy(rng: np.random.Generator, shape: tuple[int, int], share: float) -> NDArray[np.float64]:
    """Whole numbers that change within a window alone, of this share of either side."""
    values = np.full(shape, float(rng.integers(-9, 9)))
    window = []
    for length in shape:
        size = math.ceil(share * length)
        start = int(rng.integers(0, length - size + 1))
        window.append(slice(start, start + size))
    part = values[tuple(window)]
    part += np.rint(rng.normal(0, rng.choice([0.6, 5.0, 60.0]), part.shape))
    return values


def attributes_of(rng: np.random.Generator, shape: tuple[int, int], share: float) -> dict[str, NDArray[Any]]:
    """One of floats with NaN, which takes a residual, and one of integers with two components."""
    first = patchy(rng, shape, share)
    first[rng.random(shape) < 0.02] = np.nan
    first[0, 0] = 1.0
    second = np.stack([patchy(rng, shape, share), patchy(rng, shape, 1.0)], axis=-1)
    return {"first": first.astype(np.float32), "second": second.astype(np.int16)}


@st.composite
def cases(draw: st.DrawFn) -> Case:
    """Surfaces of one block or of several that meet, exact, with a precision, and for one error."""
    rng = np.random.default_rng(draw(st.integers(0, 2**32)))
    shape = draw(st.tuples(st.integers(2, 70), st.integers(2, 50)))
    share = draw(st.sampled_from([0.0, 0.1, 0.3, 1.0]))
    kind = np.dtype(draw(st.sampled_from(["int16", "float32", "float64"])))
    components = draw(st.sampled_from([0, 0, 3, 4]))
    z = patchy(rng, shape, share)
    if draw(st.booleans()) and min(shape) > 3:  # nothing at the finest level
        z = between(between(np.clip(patchy(rng, (shape[0] // 2 + 1, shape[1] // 2 + 1), share), 0, 2), 0), 1)
        shape = z.shape
    if kind.kind == "f" and draw(st.booleans()):
        z[(rng.random(shape) < 0.1) & (z == 0)] = -0.0
        z[0, 0] = -0.0  # a lattice has no such number: there is a residual
    arrays: list[NDArray[Any]] = [z]
    if components:
        rows, columns = np.meshgrid(*map(np.arange, shape), indexing="ij")
        extra = [patchy(rng, shape, share) for _ in range(components - 3)]
        arrays = [np.stack([rows, columns, z, *extra], axis=-1)]
    arrays[0] = arrays[0].astype(kind)
    attributes = attributes_of(rng, shape, share) if draw(st.booleans()) else {}
    cuts = [0, shape[1] - 1]
    if components and shape[1] > 6 and draw(st.booleans()):
        cuts = sorted({0, shape[1] - 1, *rng.integers(2, shape[1] - 2, 2).tolist()})
    mask = None
    if draw(st.booleans()):
        mask = rng.random(shape) < draw(st.sampled_from([0.5, 0.97]))
        mask[0, :] = True  # each block has a valid point
        mask[:, cuts[1:-1]] = True  # where blocks meet they share all points
    closed = (draw(st.booleans()), draw(st.booleans())) if len(cuts) == 2 else (False, False)
    blocks, firsts = [], []
    for left, right in pairwise(cuts):
        part = slice(left, right + 1)
        own = {name: array[:, part].copy() for name, array in attributes.items()}
        valid = None if mask is None else mask[:, part].copy()
        blocks.append(ls.Block(arrays[0][:, part].copy(), closed, mask=valid, attributes=own))
        first = np.ones(blocks[-1].shape, np.bool_)
        first[:, 0] = left == 0
        firsts.append(first)
    original = ls.Surface(blocks=blocks)
    options: dict[str, Any] = draw(st.sampled_from([{}, {}, {"precision": 0.5}, {"rms": 0.7}]))
    tiles = draw(st.sampled_from([None, (4, 4), (3, 5), (5, 3)]))
    with small_tiles(tiles), warnings.catch_warnings():
        warnings.simplefilter("ignore", ls.FormatWarning)  # what attributes have at holes is left out
        data = ls.encode(original, **options)
    return Case(data, original, firsts)


@lru_cache(maxsize=1)
def reference_of(data: bytes) -> tuple[reference.Container, reference.Decoder]:
    """A container as `tests.reference` reads and decodes it: slowly, so once for all states."""
    container = reference.read_container(data)
    return container, reference.decode(container)


def errors_of(
    original: ls.Surface, shown: ls.Surface, firsts: Sequence[NDArray[np.bool_]]
) -> list[tuple[float, float]]:
    """RMS and maximum over all coordinates, then of each channel by itself, from their definition."""
    distances: list[NDArray[np.float64]] = []
    channels_found: dict[int, list[NDArray[np.float64]]] = {}
    for one, other, first in zip(original.blocks, shown.blocks, firsts, strict=True):
        valid = np.ones(one.shape, np.bool_) if one.mask is None else one.mask
        pairs = zip((one.points, *one.attributes.values()), (other.points, *other.attributes.values()), strict=True)
        number = 0
        for array, (given_values, found) in enumerate(pairs):
            given_values, found = (a.reshape(*one.shape, -1).astype(np.float64) for a in (given_values, found))
            geometric = min(given_values.shape[2], 3) if array == 0 else 0
            if geometric:
                delta = (given_values - found)[valid & first][:, :geometric]
                distances.append(np.sqrt((delta**2).sum(axis=1)))
            for component in range(given_values.shape[2]):
                counted = valid & first if component < geometric else valid & np.isfinite(given_values[..., component])
                delta = (given_values[..., component] - found[..., component])[counted]
                channels_found.setdefault(number, []).append(np.abs(delta))
                number += 1
    every = [np.concatenate(distances), *(np.concatenate(parts) for parts in channels_found.values())]
    return [(float(np.sqrt((d**2).mean())), float(d.max())) if d.size else (0.0, 0.0) for d in every]


def check_told(view: View, case: Case, shown: ls.Surface) -> None:
    """The errors of a view are those of what it shows."""
    whole, *each = errors_of(case.original, shown, case.firsts)
    assert is_told(view.rms, whole[0])
    assert is_told(view.max_error, whole[1])
    coded = each[len(each) - len(view.channels) :]  # x and y that follow rules are no channels
    for said, own in zip(view.channels, coded, strict=True):
        for error, figure in zip(said, own, strict=True):
            assert told_roughly(figure * (1 - 1e-9)) <= error <= told_roughly(figure * (1 + 1e-9))


def cut(blocks: list[reference.Shown], region: Region) -> list[reference.Shown]:
    """A window of the only block."""
    rows, columns = (slice(*span) for span in region)
    return [reference.Shown([a[rows, columns] for a in block.arrays], block.valid[rows, columns]) for block in blocks]


def check_states(case: Case, region: Region | None, level: int) -> None:
    """In the order of the file: after each layer and at the end, values, a coarser level, a window, and errors."""
    container, other = reference_of(case.data)
    decoder = ls.Decoder()
    views = decoder.feed(case.data)
    last = len(container.layers)
    coarse = level % (container.header.finest + 1)
    for view in views:
        state: dict[str, Any] = {"layers": view.number + 1} if view.number < last else {"residual": container.residual}
        surface = view.surface()
        assert_shown(surface, other.shown(**state))
        if coarse < container.header.finest:
            layers = min(view.number + 1, last)
            heights = container.header.plane is not None  # the page says nothing of x and y of a coarser level
            assert_shown(view.surface(coarse), other.shown(layers, level=coarse), heights)
        check_told(view, case, surface)
        if region is not None and view.number >= last - 1:
            assert_shown(view.window(region), cut(other.shown(**state), region))


def remaining(case: Case, view: View, selection: Selection) -> list[int]:
    """What `reference.Decoder` knows in the state of a view that came by the index: whole layers, or whole levels."""
    index, (container, whole) = index_of(case.data), reference_of(case.data)
    header = index.header
    if view.complete:
        return whole.states[-1]
    segments = select(index, selection).segments
    level_of = [header.layout.level_of(segment.tile) for segment in segments]
    layers = [segment.layer for segment in segments]
    found = []
    for kinds, count in ((layers, header.layer_count), (level_of, header.levels + 1)):
        sizes = [
            header.length + sum(s.range.length for s, kind in zip(segments, kinds, strict=True) if kind <= most)
            for most in range(count)
        ]
        found.append([most for most in range(count) if sizes[most] == view.bytes])
    whole_layers, whole_levels = found
    if view.bytes == index.layers[min(view.number, header.layer_count - 1)].end:  # read as it is written
        return whole.states[view.number]
    if whole_layers and view.number == whole_layers[-1]:
        return whole.states[whole_layers[-1]]
    assert view.number == whole_levels[-1]
    other = reference.Decoder(container.header, container.masks)
    entries = [entry for layer in reference.read_index(case.data, container).segments for entry in layer]
    own = [entry for entry in entries if other.tile(entry.unit).level <= view.number]
    other.take([entry.take(case.data) for entry in own], view.number)
    return other.remaining


def check_planned(case: Case, target: ls.Target) -> None:
    """By the index: whole layers or whole levels, of all or of a window, which is as within the whole."""
    index, selection = index_of(case.data), Selection(region=target.region)
    container, whole = reference_of(case.data)
    views = follow(case.data, plan(index, target), selection=selection)[1]
    assert views[-1].complete
    for view in views:
        other = copy(whole)
        other.remaining = remaining(case, view, selection)
        blocks = other.shown(residual=container.residual if view.complete else None)
        surface = view.surface()
        if target.region is None:
            assert_shown(surface, blocks)
            check_told(view, case, surface)
        else:
            assert_shown(surface, cut(blocks, target.region))
            check_bound(view, case, surface, target.region)


def check_bound(view: View, case: Case, shown: ls.Surface, region: Region) -> None:
    """The errors of a window are at most what is told."""
    rows, columns = (slice(*span) for span in region)
    (block,) = case.original.blocks
    mask = None if block.mask is None else block.mask[rows, columns]
    points = block.points[rows, columns].copy()
    part = ls.Surface(points, mask=mask)
    rms, most = errors_of(part, ls.Surface(shown.points, mask=shown.mask), [np.ones(part.shape, np.bool_)])[0]
    assert rms <= view.rms * (1 + 1e-9)
    assert most <= view.max_error * (1 + 1e-9)


def window_of(case: Case, seed: int) -> Region | None:
    """A window of some points, a valid one among them, of a surface of one block."""
    if len(case.original.blocks) > 1:
        return None
    rng = np.random.default_rng(seed)
    rows, columns = case.original.shape
    top, left = int(rng.integers(0, rows)), int(rng.integers(0, columns - 1))
    region = (top, int(rng.integers(top + 1, rows + 1))), (left, int(rng.integers(left + 2, columns + 1)))
    mask = case.original.blocks[0].mask
    return region if mask is None or mask[slice(*region[0]), slice(*region[1])].any() else None


def between(nodes: NDArray[np.float64], axis: int) -> NDArray[np.float64]:
    """Samples of an axis that give nodes from 0 to 2 back and have no details, as long as its run is below 24."""
    nodes = np.moveaxis(nodes, axis, 0)
    samples = np.empty((2 * len(nodes) - 2, *nodes.shape[1:]))
    samples[:-1:2], samples[-1] = nodes[:-1], nodes[-1]
    samples[1:-1:2] = np.floor((nodes[1:-1] + nodes[:-2]) / 2)
    return np.moveaxis(samples, 0, axis)


def unnamed_tile() -> Case:
    """The finest level has no coefficients; of the one below it, one tile has some and another is not named."""
    nodes = np.zeros((24, 5))
    nodes[:8] = 2 * np.random.default_rng(3).integers(0, 2, (8, 1))
    z = between(nodes, 0)
    z[z == 0] = -0.0  # no lattice has such a number: there is a residual
    with small_tiles((3, 5)):
        data = ls.encode(ls.Surface(z.copy()))
    return Case(data, ls.Surface(z), [np.ones(z.shape, np.bool_)])


def unnamed_interface() -> Case:
    """Two blocks that meet along a side whose details are 0, while those of the blocks are not."""
    x, y = np.meshgrid(np.arange(16.0), np.arange(22.0), indexing="ij")
    points = np.stack([x, y, np.full(x.shape, -0.0)], axis=-1)
    blocks = [ls.Block(points[:, part].copy()) for part in (slice(0, 10), slice(9, 22))]
    firsts = [np.ones(block.shape, np.bool_) for block in blocks]
    firsts[1][:, 0] = False
    return Case(ls.encode(ls.Surface(blocks=blocks)), ls.Surface(blocks=blocks), firsts)


def unnamed(case: Case) -> bool:
    """Whether the finest level has no units, and a coarser one has some that no layer names."""
    index = index_of(case.data)
    layout = index.header.layout
    named = {(segment.tile, segment.channel) for segment in index.segments}
    levels = {layout.level_of(tile) for tile, _ in named}
    unknown = np.argwhere(initial_state(index.header) == UNANNOUNCED).tolist()
    return max(levels) < layout.levels and any(
        layout.level_of(tile) > 0 and (tile, channel) not in named for tile, channel in unknown
    )


@examples(10)
@example(case=unnamed_tile(), seed=1, level=5, bands=False)
@example(case=unnamed_interface(), seed=1, level=3, bands=False)
@given(case=cases(), seed=st.integers(0, 2**32), level=st.integers(0, 9), bands=st.booleans())
@pytest.mark.long
def test_every_state_shows_and_tells_what_the_page_says(case: Case, seed: int, level: int, bands: bool) -> None:
    region = window_of(case, seed)
    small = 0 if bands else pieces._ONE_CALL_VALUES
    shared = patch.object(pieces, "_SHARED_VALUES", min(small, pieces._SHARED_VALUES))
    with patch.object(pieces, "_ONE_CALL_VALUES", small), shared:
        check_states(case, region, level)
        check_planned(case, ls.Target(order="level"))
        check_planned(case, ls.Target())
        if region is not None:
            check_planned(case, ls.Target(region=region))


@pytest.mark.parametrize("case", [unnamed_tile(), unnamed_interface()], ids=["tile", "interface"])
def test_units_that_no_layer_names_are_known_once_all_layers_are_there(case: Case, tmp_path: Path) -> None:
    assert unnamed(case)
    region = ((2, 9), (1, 4)) if len(case.original.blocks) == 1 else None
    for level in range(index_of(case.data).header.levels + 1):
        check_states(case, region, level)
    for target in (ls.Target(), ls.Target(order="level"), *([ls.Target(region=region)] if region else [])):
        check_planned(case, target)
    assert inspect(io.BytesIO(case.data), max_vertices=10_000).errors_checked
    decoder = PiecewiseDecoder(lambda offset, length: case.data[offset : offset + length], index_of(case.data))
    surface = decoder.surface(Room(lambda: FolderScratch(tmp_path / "values"), 1 << 30), 1 << 20, lambda fraction: None)
    assert_same(surface, ls.decode(case.data))


@pytest.mark.parametrize(("name", "end"), [("unnamed-tile", 83), ("unnamed-interface", 153)])
def test_files_whose_last_layer_leaves_units_unnamed(name: str, end: int) -> None:
    path = CASES / f"{name}.lode"
    if not path.exists():
        pytest.skip("the shared cases are absent")
    data = path.read_bytes()
    (view,) = ls.Decoder().feed(data[:end])
    assert (view.rms, view.max_error) == (0, 0)
    container = reference.read_container(data)
    for level in range(container.header.finest + 1):
        assert_shown(view.surface(level), reference.decode(container).shown(len(container.layers), level=level))
    for found, wanted in zip(view.surface().blocks, ls.decode(data).blocks, strict=True):
        np.testing.assert_array_equal(found.points, wanted.points)
