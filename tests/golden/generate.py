"""Make golden files: ``PYTHONPATH=core python -m tests.golden.generate`` writes those that are not there.

What a reader must do does not change, so files are only added. To make one anew, delete it first.
"""

from __future__ import annotations

import contextlib
import functools
import hashlib
import itertools
import json
import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

import lodestream as ls
from lodestream.encoding import forward, phases, prepared, streams, transform_phases
from lodestream.encoding.allocation import PassOrder, layer_ends, pass_order
from lodestream.encoding.curves import Curves
from lodestream.encoding.effort import CHOICES, FewLayers
from lodestream.encoding.tiling import WHOLE_TILE, square
from lodestream.entropy.tile_coder import TileCoder, planes_of
from lodestream.entropy.tiles import TileTable, gather
from lodestream.grid.layout import Layout
from lodestream.planning.window_errors import KIND as WINDOW_ERRORS
from lodestream.planning.window_errors import serialize_window_errors
from lodestream.quantization.band_steps import Quantiser
from lodestream.transform.predictors import COEFFICIENT_BITS

from .rewriting import Parts, chunk_of_differences, chunk_of_offsets, chunk_of_random_offsets

__all__ = ["FOLDER", "Original", "digest", "digests", "expectations", "lines", "originals"]

FOLDER = Path(__file__).parent

Floats = NDArray[np.float64]
_Maker = Callable[[NDArray[Any]], bytes]


@dataclass(frozen=True)
class Crafted:
    """What the encoder does otherwise, for files that are as good as others and that it would not write.

    Attributes
    ----------
    large : bool
        The units of all levels but the coarsest are large.
    tile : (int, int) or None
        Exponents of two of a tile's rows and columns.
    factor : int
        All coefficients are so many times as large, and meet the limits; the exactness section sets the values right.
    ones : int
        The first unit tells so many bit-planes too many; their passes are a segment of four bytes of 255.
    by_level : bool
        Each layer holds all passes of a level.
    """

    large: bool = False
    tile: tuple[int, int] | None = None
    factor: int = 1
    ones: int = 0
    by_level: bool = False

    @contextlib.contextmanager
    def applied(self) -> Iterator[None]:
        """While a surface is encoded."""
        code, most = TileCoder.code, (1 << COEFFICIENT_BITS) - 1

        def gathered(*arguments: Any, **named: Any) -> NDArray[np.int32]:
            return np.clip(self.factor * gather(*arguments, **named).astype(np.int64), -most, most).astype(np.int32)

        def planes(table: TileTable, true: NDArray[np.int32], tile: int) -> int:
            return planes_of(table, true, tile) + (self.ones if tile == 0 else 0)

        def first_alone(curves: Curves, *arguments: Any) -> PassOrder:
            order = pass_order(curves, *arguments)
            chosen = np.flatnonzero(order.unit == 0)[: 2 * self.ones]
            places = np.concatenate([chosen, np.delete(np.arange(order.unit.size), chosen)])
            return replace(order, unit=order.unit[places], number=order.number[places])

        def by_level(curves: Curves, layout: Layout, channels: int) -> PassOrder:
            order = pass_order(curves, layout, channels)
            level = np.array([layout.level_of(tile) for tile in range(len(layout.tiles))])[order.unit // channels]
            places = np.argsort(level, kind="stable")
            last = np.append(np.diff(level[places]) > 0, True)
            return replace(order, unit=order.unit[places], number=order.number[places], last=last)

        def ends(order: PassOrder, most: int, few: FewLayers | None = None) -> list[int]:
            if self.by_level:
                return [int(place) + 1 for place in np.flatnonzero(order.last)]
            first = 2 * self.ones
            return [first, *(end for end in layer_ends(order, most, few) if end > first)]

        def coded(coder: TileCoder, tile: int, channel: int, first: int, passes: int, *costs: Any) -> bytes:
            data = code(coder, tile, channel, first, passes, *costs)
            begins = first == 2 * int(coder._channels[channel].top[tile]) - 1
            return b"\xff" * 4 if tile == 0 and begins and passes == 2 * self.ones else data

        with pytest.MonkeyPatch.context() as patch:
            if self.large:
                large = replace(CHOICES["default"], large_points=1, large_growth=math.inf)
                patch.setitem(CHOICES, "default", large)
            if self.tile:
                patch.setattr(prepared, "tile_exponents", lambda *_: self.tile)
                patch.setattr(prepared, "square", lambda bits: self.tile if bits == WHOLE_TILE else square(bits))
            if self.factor > 1:
                patch.setattr(streams, "_COARSER", ())  # no container of fewer bits is tried
                patch.setattr(forward, "gather", gathered)
            if self.ones:
                for module in (forward, transform_phases):
                    patch.setattr(module, "planes_of", planes)
                patch.setattr(phases, "pass_order", first_alone)
                patch.setattr(TileCoder, "code", coded)
            if self.by_level:
                patch.setattr(phases, "pass_order", by_level)
            if self.ones or self.by_level:
                patch.setattr(phases, "layer_ends", ends)
                patch.setitem(CHOICES, "default", replace(CHOICES["default"], stop_turns=0))
            yield


@dataclass(frozen=True)
class Original:
    """A surface, with what precision or for what error it is encoded, and what its container is rewritten to.

    ``detailed``: what is expected has the levels of every layer and the errors of channels too.
    """

    surface: ls.Surface
    precision: str | None = None
    attribute_precision: Mapping[str, str] = field(default_factory=dict)
    rms: str | None = None
    crafted: Crafted = Crafted()
    rewritten: Callable[[Parts], Parts] | None = None
    detailed: bool = False

    def encode(self) -> bytes:
        """Its container."""
        precisions = dict(self.attribute_precision)
        with self.crafted.applied():
            container = ls.encode(self.surface, self.precision, rms=self.rms, attribute_precision=precisions)
        return container if self.rewritten is None else self.rewritten(Parts.of(container)).built()


def _wave(rows: int, columns: int) -> Floats:
    y, x = np.mgrid[:rows, :columns] / 8.0
    return np.asarray(np.sin(1.3 * x) * np.cos(0.7 * y) + 0.2 * np.sin(5 * x + 3 * y))


def _torus(rows: int, columns: int) -> Floats:
    turns = [np.linspace(0, 2 * np.pi, n, endpoint=False) for n in (rows, columns)]
    v, u = np.meshgrid(*turns, indexing="ij")
    radius = 1 + 0.1 * np.sin(3 * u + 2 * v)
    ring = 3 + radius * np.cos(v)
    return np.stack([ring * np.cos(u), ring * np.sin(u), radius * np.sin(v)], axis=-1)


def _terrain(rows: int, columns: int) -> Floats:
    """Ground as (row, column, 3) with uneven distances, no two points alike."""
    y, x = np.mgrid[:rows, :columns].astype(np.float64)
    return np.stack([x + 0.1 * np.sin(y), y + 0.2 * np.cos(x / 3), 3 * _wave(rows, columns)], axis=-1)


def _sphere(rows: int, columns: int) -> Floats:
    """Latitudes from pole to pole, closed along the columns' axis."""
    v, u = np.meshgrid(np.linspace(0, np.pi, rows), 2 * np.pi * np.arange(columns) / columns, indexing="ij")
    points = np.stack([np.sin(v) * np.cos(u), np.sin(v) * np.sin(u), np.cos(v)], axis=2)
    points[0], points[-1] = (0, 0, 1), (0, 0, -1)
    return points


def _cube_sphere(count: int) -> list[Floats]:
    """Six patches of a sphere; what they share is the same to the bit."""
    turns = np.linspace(-np.pi / 4, np.pi / 4, count)
    t: Floats = np.round((np.tan(turns) - np.tan(turns[::-1])) / 2, 6)
    a, b = np.meshgrid(t, t, indexing="ij")
    one = np.ones(a.shape)
    faces: list[tuple[Floats, Floats, Floats]] = [
        (one, a, b),
        (-one, b, a),
        (b, one, a),
        (a, -one, b),
        (a, b, one),
        (b, a, -one),
    ]
    patches = [np.round(np.stack(face, axis=-1) / np.sqrt(1 + a**2 + b**2)[..., None], 9) for face in faces]
    patches[1], patches[4] = patches[1][::-1], patches[4].transpose(1, 0, 2)[:, ::-1]
    return [np.ascontiguousarray(patch) for patch in patches]


def _moebius(rows: int, columns: int) -> Floats:
    u, v = np.meshgrid(np.linspace(0, 2 * np.pi, rows), np.linspace(-0.4, 0.4, columns), indexing="ij")
    ring = 1 + v * np.cos(u / 2)
    strip = np.stack([ring * np.cos(u), ring * np.sin(u), v * np.sin(u / 2)], axis=2)
    strip[-1] = strip[0, ::-1]
    return strip


def _cut(points: NDArray[Any], rows: Sequence[int], columns: Sequence[int]) -> list[NDArray[Any]]:
    """Windows between cuts, which have the points at a cut in common."""
    return [
        points[a : b + 1, c : d + 1].copy() for a, b in itertools.pairwise(rows) for c, d in itertools.pairwise(columns)
    ]


def _blocks(arrays: Sequence[NDArray[Any]], closed: tuple[bool, bool] = (False, False)) -> ls.Surface:
    return ls.Surface(blocks=[ls.Block(points, closed) for points in arrays])


def _simple() -> dict[str, Original]:
    """One block, without holes and attributes of other types."""
    rng = np.random.default_rng(2002)
    wave = _wave(37, 54)
    rough = np.cumsum(np.cumsum(rng.normal(size=(33, 41)), 0), 1)
    attributes = np.concatenate([_torus(17, 20), rng.integers(0, 256, (17, 20, 2)).astype(np.float64)], axis=-1)
    hostile = np.array([[-0.0, 5e-324, 1.5], [1e30, -1e30, 2.0], [0.1, -7.0, np.pi]])
    noise = np.random.default_rng(1).integers(0, 2**31, (2, 2))
    own = np.random.default_rng(2006)
    offsets = np.repeat(np.repeat(own.random((9, 8)), 8, 0), 8, 1)[:66]
    quantised = 0.3 * (np.rint(np.cumsum(5 * own.normal(size=(66, 64)), 1)) + offsets) + 20
    widest = np.random.default_rng(2007).choice([-(2**23), 0, 1, 2**23 - 1], (50, 56), p=[0.45, 0.05, 0.05, 0.45])
    tower = np.zeros((9, 9), np.float32)
    tower[4, 4] = 1
    return {
        "heights-int16": Original(
            ls.Surface(np.rint(20 * rough).astype(np.int16), metadata={"name": "rough", "unit": "m"})
        ),
        "heights-uint8-even": Original(ls.Surface(rng.integers(0, 256, (16, 24)).astype(np.uint8))),
        "heights-int64-far": Original(ls.Surface(rng.integers(-(2**62), 2**62, (7, 6)))),
        "heights-decimal": Original(ls.Surface(np.round(wave * 50, 1))),
        "heights-float32": Original(ls.Surface(wave.astype(np.float32))),
        "heights-float64-hostile": Original(ls.Surface(hostile)),
        "heights-noise": Original(ls.Surface(noise.astype(np.uint32).view(np.float32))),
        "heights-precision": Original(ls.Surface(_wave(90, 70)), "0.01%"),
        "heights-constant": Original(ls.Surface(np.full((5, 8), 12.5))),
        "heights-offsets": Original(ls.Surface(quantised.astype(np.float32))),
        "heights-widest": Original(ls.Surface(widest.astype(np.int32))),
        "heights-tower": Original(ls.Surface(tower)),
        "planar-open": Original(ls.Surface(_torus(13, 11)[..., :2].astype(np.float32))),
        "torus-odd": Original(ls.Surface(_torus(21, 33).astype(np.float32), (True, True))),
        "cylinder-even": Original(ls.Surface(_torus(24, 18), (True, False)), "0.1%"),
        "attributes": Original(ls.Surface(attributes, (False, True))),
        "curve": Original(ls.Surface(_torus(1, 70)[0][:, None].astype(np.float32), (True, False))),
        "two-points": Original(ls.Surface(np.array([[1.0, 4.0]]))),
        "several-tiles": Original(ls.Surface(np.rint(300 * _wave(386, 389)).astype(np.int32))),
        "several-tiles-line": Original(ls.Surface(np.rint(300 * _wave(1, 50000).T).astype(np.int32)), "20"),
    }


def _with_holes() -> dict[str, Original]:
    rng = np.random.default_rng(2003)
    y, x = np.mgrid[:41, :60]
    lake = (np.hypot(y - 15, x - 22) < 9) | (np.hypot(y - 38, x - 50) < 12) | (rng.random((41, 60)) < 0.01)
    floats = _wave(41, 60).astype(np.float32)
    floats[lake] = np.nan
    metres = np.rint(900 * _wave(41, 60)).astype(np.int16)
    metres[lake] = -32768
    tube = _torus(19, 26)
    tube[5:9, 20:] = np.nan
    tube[5:9, :3] = np.nan
    return {
        "holes-float32": Original(ls.Surface(floats)),
        "holes-int16": Original(ls.Surface(metres, mask=~lake, metadata={"nodata": -32768})),
        "holes-closed": Original(ls.Surface(tube, (True, True)), "0.01%"),
    }


def _not_finite() -> dict[str, Original]:
    """Infinities, and NaN beside numbers, in heights, in x, y, z, beside a rule of x and y, and in blocks."""
    heights = _wave(41, 60).astype(np.float32)
    heights[5:9, 20:31], heights[30, 7:12], heights[0, 0], heights[20, 20] = np.inf, -np.inf, -0.0, np.nan
    points = _torus(20, 26)
    points[5:9, 20, 0], points[7, 3, 1], points[9:12, 8, 2], points[1, 1] = np.inf, -np.inf, np.nan, np.nan
    named: dict[str, NDArray[Any]] = {
        "t": np.where(_wave(20, 26) > 1, np.inf, _wave(20, 26)),
        "n": np.arange(520, dtype=np.uint16).reshape(20, 26),
    }
    row, column = np.mgrid[:33, :47].astype(np.float64)
    plane = np.stack([500000.0 + 30.0 * column, (4 * row - 7) / 10, np.round(_wave(33, 47), 2)], axis=-1)
    plane[4:7, 20:25, 2], plane[8, 20:25, 2], plane[20:23, :4] = np.inf, np.nan, np.nan
    blocks = _cut(_terrain(24, 31), [0, 9, 23], [0, 30])
    for block, place in zip(blocks, (np.s_[9, 4:7, 2], np.s_[0, 4:7, 2]), strict=True):
        block[place] = -np.inf
    return {
        "infinite-heights": Original(ls.Surface(heights)),
        "infinite-points": Original(ls.Surface(points, (True, True), attributes=named)),
        "infinite-plane": Original(ls.Surface(plane)),
        "infinite-blocks": Original(_blocks(blocks)),
        "infinite-error": Original(ls.Surface(heights), rms="1%"),
    }


def _with_attributes() -> dict[str, Original]:
    rng = np.random.default_rng(2004)
    temperature = 280 + 10 * _wave(22, 31)
    temperature[3:5, 7:12] = np.nan
    temperature[0, 0], temperature[0, 1], temperature[0, 2] = np.inf, -np.inf, -0.0
    attributes: dict[str, NDArray[Any]] = {
        "color": rng.integers(0, 256, (22, 31, 3)).astype(np.uint8),
        "temperature": temperature,
        "label": np.rint(40 * _wave(22, 31)).astype(np.int32) ** 3,
        "flow": _torus(22, 31)[..., :2].astype(np.float32),
    }
    half = (np.exp2(12 * _wave(14, 19)) * rng.choice([-1, 1], (14, 19))).astype(np.float16)
    half[2, 3:6] = np.inf, -np.inf, -0.0
    wide: dict[str, NDArray[Any]] = {
        "id": rng.integers(2**63 - 2**40, 2**63 + 2**40, (14, 19), np.uint64),
        "noise": rng.integers(0, 2**62, (14, 19)).view(np.float64),
        "half": half.astype(np.float32),
        "cents": np.round(1e6 * _wave(14, 19), 4),
        "pages": rng.integers(-(2**40), 2**40, (14, 19)) << 12,
        "few": rng.integers(-3, 3, (14, 19, 1)).astype(np.int8),
        "waves": np.round(1e-12 * _wave(14, 19), 14),
    }
    points = _torus(22, 31).astype(np.float32)
    mask = np.ones((22, 31), bool)
    mask[10:15, 11:17] = False
    smooth: dict[str, NDArray[Any]] = {
        "pressure": 1e5 + 300 * _wave(40, 33),
        "count": np.arange(40 * 33, dtype=np.uint16).reshape(40, 33),
    }
    return {
        "attributes-types": Original(ls.Surface(points, (True, False), mask=mask, attributes=attributes)),
        "attributes-wide": Original(ls.Surface(np.rint(100 * _wave(14, 19)).astype(np.uint32) % 97, attributes=wide)),
        "attributes-precision": Original(
            ls.Surface(np.round(_wave(40, 33), 3), attributes=smooth), None, {"pressure": "0.5"}
        ),
    }


def _planes() -> dict[str, Original]:
    """x and y over regular and turned grids, and one over a grid of uneven lines."""
    z = _wave(33, 65)
    row, column = np.mgrid[:33, :65].astype(np.float64)
    lines = (
        np.broadcast_to(np.linspace(0.1, 2.35, 65), z.shape),
        np.broadcast_to(np.geomspace(1, 7, 33)[:, None], z.shape),
    )
    grids = {
        "plane-steps": (500000.0 + 30.0 * column, (4 * row - 7) / 10),
        "plane-lines": lines,
        "plane-turned": (
            3.0 * (column + 0.5) + 4.0 * (row + 0.5) + 0.1,
            4.0 * (column + 0.5) - 3.0 * (row + 0.5) - 7.0,
        ),
    }
    found = {name: np.stack([x, y, z], axis=-1) for name, (x, y) in grids.items()}
    found["plane-steps"][4:7, 20:25] = np.nan
    x, y = 0.1 * (np.arange(65) + 0.5) - 17.3, np.linspace(7, -3.1, 33)
    found["plane-centres"] = np.stack([*np.meshgrid(x, y), z], axis=-1)
    found["plane-span"] = np.stack([*np.meshgrid(np.linspace(0.3, 2.9, 65), y), z], axis=-1)
    found["plane-uneven"] = found["plane-turned"][:29, :54]
    return {name: Original(ls.Surface(points), "0.1%") for name, points in found.items()}


def _arrangements() -> dict[str, Original]:
    """Blocks with common sides, and blocks that meet themselves."""
    three = _cut(_terrain(26, 48), [0, 25], [0, 13, 29, 47])
    three[1] = three[1][::-1, ::-1].copy()
    holes = _cut(_terrain(24, 31), [0, 9, 23], [0, 30])
    holes[0][-4:, 10:20] = np.nan
    holes[1][:6, 10:20] = np.nan
    bricks = [*_cut(_terrain(19, 49)[:10], [0, 9], [0, 16, 32, 48]), *_cut(_terrain(19, 49)[9:], [0, 9], [0, 22, 48])]
    long = [block.astype(np.float32) for block in _cut(_terrain(290, 7), [0, 289], [0, 3, 6])]
    masks = [np.ones((290, 4), bool), np.ones((290, 4), bool)]
    masks[1][250:, 1:] = False
    whole = [np.rint(block * 40).astype(np.int32) for block in _cut(_terrain(30, 33), [0, 17, 29], [0, 14, 32])]
    ball = _sphere(17, 24)
    turns = 2 * np.pi * np.arange(22) / 22
    wall = np.stack([[np.cos(turns), np.sin(turns), np.full(22, h / 5)] for h in range(7)]).transpose(0, 2, 1).copy()
    disc = np.stack([wall[0] * [r, r, 1] for r in (1.0, 0.7, 0.4, 0.0)])
    flap = np.stack([np.roll(wall[0], 6, 0)[:11] * [r, r, 1] for r in (1.0, 1.4, 1.7, 2.0, 2.2)])
    large = _cut(_terrain(197, 345)[..., :2], [0, 150, 196], [0, 344])
    wide = [ls.Block(block, attributes={"speed": (7 * block[..., 2]).astype(np.float32)}) for block in holes]
    return {
        "blocks-reversed": Original(_blocks(three)),
        "blocks-holes": Original(ls.Surface(blocks=wide)),
        "blocks-bricks": Original(_blocks(bricks)),
        "blocks-integers": Original(_blocks(whole)),
        "blocks-windows": Original(
            ls.Surface(blocks=[ls.Block(block, mask=mask) for block, mask in zip(long, masks, strict=True)])
        ),
        "cube-sphere": Original(_blocks([patch.astype(np.float32) for patch in _cube_sphere(17)])),
        "cube-sphere-even": Original(_blocks(_cube_sphere(8))),
        "sphere-closed": Original(_blocks([ball], (False, True))),
        "sphere-seam": Original(_blocks([np.concatenate([ball, ball[:, :1]], axis=1)])),
        "sphere-halves": Original(_blocks(_cut(np.concatenate([ball, ball[:, :1]], axis=1), [0, 16], [0, 9, 24]))),
        "cylinder-disc": Original(_blocks([wall, disc], (False, True))),
        "cylinder-flap": Original(ls.Surface(blocks=[ls.Block(wall, (False, True)), ls.Block(flap)])),
        "moebius": Original(_blocks(_cut(_moebius(41, 8), [0, 12, 26, 40], [0, 7]))),
        "blocks-groups": Original(_blocks(large), "0.2%"),
    }


def _made_for_an_error() -> dict[str, Original]:
    rng = np.random.default_rng(2005)
    rough = _wave(95, 261) + 0.3 * rng.normal(size=(95, 261))
    lake = np.hypot(*(np.mgrid[:60, :90] - np.array([30, 40])[:, None, None])) < 14
    metres = np.rint(3000 * _wave(60, 90)).astype(np.int16)
    metres[lake] = -9999
    colors: dict[str, NDArray[Any]] = {"color": rng.integers(0, 256, (48, 51, 3)).astype(np.uint8)}
    globe = np.concatenate([_sphere(17, 24), _sphere(17, 24)[:, :1]], axis=1)
    return {
        "error-smooth": Original(ls.Surface(_wave(120, 141).astype(np.float32)), rms="0.1%"),
        "error-trellis": Original(ls.Surface(rough), rms="1%"),
        "error-trellis-tiles": Original(ls.Surface(np.concatenate([rough, rough[::-1]])), rms="0.5%"),
        "error-holes": Original(ls.Surface(metres, mask=~lake, metadata={"nodata": -9999}), rms="5"),
        "error-attributes": Original(ls.Surface(_torus(48, 51), (True, True), attributes=colors), rms="0.2%"),
        "error-blocks": Original(_blocks(_cut(globe, [0, 16], [0, 9, 24])), rms="0.1%"),
        "error-curve": Original(ls.Surface(_torus(1, 90)[0][:, None], (True, False)), rms="0.1%"),
    }


def _large() -> dict[str, Original]:
    """Large units: of the finest level of a surface that is large enough, and of all levels of small ones."""
    rng = np.random.default_rng(2008)
    rough = np.cumsum(np.cumsum(rng.normal(size=(90, 75)), 0), 1)
    spikes = np.where(rng.random((96, 140)) < 0.003, rng.integers(1, 99, (96, 140)), 0).astype(np.uint8)
    attributes: dict[str, NDArray[Any]] = {
        "color": rng.integers(0, 256, (26, 70, 3)).astype(np.uint8),
        "temperature": (280 + 10 * _wave(26, 70)).astype(np.float32),
        "label": np.rint(40 * _wave(26, 70)).astype(np.int32) ** 3,
    }
    holes = np.rint(900 * _wave(45, 66)).astype(np.int16)
    lake = np.hypot(*(np.mgrid[:45, :66] - np.array([20, 30])[:, None, None])) < 9
    sides = [
        ls.Block(block, attributes={"speed": (7 * block[..., 2]).astype(np.float32)})
        for block in _cut(_terrain(24, 41), [0, 9, 23], [0, 40])
    ]
    natural = 5 * _wave(186, 183) + 0.4 * np.random.default_rng(2009).normal(size=(186, 183))
    widest = np.random.default_rng(2010).choice([-(2**23), 0, 1, 2**23 - 1], (24, 70), p=[0.45, 0.05, 0.05, 0.45])
    everywhere = Crafted(large=True)
    return {
        "large": Original(ls.Surface(np.rint(natural).astype(np.int16))),
        "large-attributes": Original(
            ls.Surface(_torus(26, 70).astype(np.float32), (True, False), attributes=attributes), crafted=everywhere
        ),
        "large-blocks": Original(ls.Surface(blocks=sides), crafted=everywhere),
        "large-closed": Original(ls.Surface(_torus(21, 72)), "0.001%", crafted=everywhere),
        "large-error": Original(
            ls.Surface(_torus(26, 70), (True, False), attributes={"color": attributes["color"]}),
            rms="0.2%",
            crafted=everywhere,
        ),
        "large-holes": Original(ls.Surface(holes, mask=~lake), crafted=everywhere),
        "large-limits": Original(
            ls.Surface(widest.astype(np.int32)), crafted=Crafted(large=True, tile=(3, 6), factor=40)
        ),
        "large-sparse": Original(ls.Surface(spikes), crafted=everywhere),
        "large-tiles": Original(ls.Surface(np.rint(30 * rough).astype(np.int32)), crafted=Crafted(True, (4, 4))),
    }


def _limits() -> dict[str, Original]:
    """What no surface reaches by itself, or few do."""
    rng = np.random.default_rng(2011)
    widest = rng.choice([-(2**23), 0, 1, 2**23 - 1], (33, 40), p=[0.45, 0.05, 0.05, 0.45])
    spikes = np.where(rng.random((150, 160)) < 0.002, rng.integers(1, 99, (150, 160)), 0).astype(np.uint8)
    long = _cut(_terrain(290, 7), [0, 289], [0, 3, 6])
    masks = [np.ones((290, 4), bool), np.ones((290, 4), bool)]
    masks[1][250:, 1:] = False
    patches = [
        ls.Block(block.astype(np.float32), mask=mask, attributes={"speed": np.where(mask, 7 * block[..., 2], 0)})
        for block, mask in zip(long, masks, strict=True)
    ]
    return {
        "limits-clamps": Original(ls.Surface(widest.astype(np.int32)), crafted=Crafted(factor=40)),
        "limits-contexts": Original(ls.Surface(spikes)),
        "limits-ones": Original(ls.Surface(np.rint(40 * _wave(40, 43)).astype(np.int16)), crafted=Crafted(ones=2)),
        "limits-patches": Original(ls.Surface(blocks=patches)),
    }


def _of_levels() -> dict[str, Original]:
    """Levels of states on the way, and containers of which a layer is a level."""
    widest = np.random.default_rng(2012).choice([-(2**23), 0, 1, 2**23 - 1], (19, 24), p=[0.45, 0.05, 0.05, 0.45])
    sides = [
        ls.Block(block, attributes={"speed": np.rint(70 * block[..., 2]).astype(np.int16)})
        for block in _cut(np.rint(40 * _terrain(10, 17)).astype(np.int16), [0, 9], [0, 6, 16])
    ]
    heights = np.rint(90 * _wave(24, 19)).astype(np.int16)
    return {
        "levels-blocks": Original(ls.Surface(blocks=sides), detailed=True),
        "levels-clamps": Original(
            ls.Surface(widest.astype(np.int32)),
            crafted=Crafted(factor=40),
            rewritten=Parts.with_a_layer_for_each_level,
            detailed=True,
        ),
        "levels-heights": Original(ls.Surface(heights), detailed=True),
        "levels-one-by-one": Original(
            ls.Surface(np.rint(90 * _torus(20, 11)[..., :2]).astype(np.int16), (True, False)),
            crafted=Crafted(by_level=True),
            detailed=True,
        ),
        "levels-planes": Original(
            ls.Surface(widest.astype(np.int32)),
            rewritten=lambda parts: parts.with_more_planes(2),
            detailed=True,
        ),
        "levels-quantised": Original(ls.Surface(_wave(21, 30)), rms="1%", detailed=True),
    }


def _of_tiles() -> dict[str, Original]:
    """Groups and tiles of patches and interfaces, in tiles of 16 x 16."""
    small = Crafted(tile=(4, 4))
    apart = [np.rint(20 * _terrain(16, 32)).astype(np.int16) + np.int16(2000 * k) for k in range(3)]
    long = _cut(np.rint(20 * _terrain(57, 9)).astype(np.int16), [0, 56], [0, 4, 8])
    strip = np.rint(900 * _moebius(12, 32)).astype(np.int16)
    sides = _cut(np.rint(20 * _terrain(113, 20)).astype(np.int16), [0, 56, 112], [0, 19])
    column, row = np.meshgrid(np.arange(4), np.arange(520))
    ribbon = np.stack([7 * column, 3 * row, np.where(row % 130 == 77, 9 + column, 0)], axis=-1).astype(np.int16)
    return {
        "tiles-cut": Original(ls.Surface(np.rint(20 * _wave(47, 78)).astype(np.int8)), crafted=small),
        "tiles-group": Original(_blocks(apart), crafted=small),
        "tiles-interface": Original(_blocks(long), crafted=small),
        "tiles-interfaces": Original(_blocks(_cut(ribbon, [0, 519], [0, 1, 2, 3])), crafted=small),
        "tiles-sides": Original(_blocks(sides), crafted=small),
        "tiles-stopped": Original(_blocks([strip]), crafted=small),
        "tiles-stopped-turned": Original(_blocks([np.ascontiguousarray(strip.transpose(1, 0, 2))]), crafted=small),
    }


def _of_patches() -> dict[str, Original]:
    """Patches whose attributes differ where they meet, attributes that are channels of the points, two lengths."""
    rng = np.random.default_rng(2013)
    ground = np.rint(20 * _terrain(21, 61)).astype(np.int16)
    bricks = [*_cut(ground[:5], [0, 4], [0, 30, 60]), *_cut(ground[4:], [0, 16], [0, 60])]
    named = [ls.Block(block, attributes={"noise": rng.integers(0, 9, block.shape[:2], np.uint8)}) for block in bricks]
    four = np.concatenate([ground[:15, :21], rng.integers(0, 99, (15, 21, 1)).astype(np.int16)], axis=-1)

    def of_one_patch(parts: Parts) -> Parts:
        """Without the finest level of the attribute in the last patch, which is a group by itself there."""
        return parts.without_unit(len(parts.header.layout.tiles) - 1, 3)

    lengths = [np.rint(90 * _terrain(rows, 3)).astype(np.int16) + np.int16(900 * (rows > 40)) for rows in (60, 24)]
    quarters = _cut(ground[:13, :17], [0, 6, 12], [0, 8, 16])
    turns = 2 * np.pi * np.arange(11) / 10
    loop = np.rint(300 * np.stack([np.cos(turns), np.sin(turns), 0 * turns], axis=-1)).astype(np.int16)
    loop[-1] = loop[0]
    cap = (ground[:11, :11] + np.int16(900)).copy()
    cap[0], cap[:, -1] = loop, loop
    return {
        "patches-attributes": Original(
            ls.Surface(blocks=named), crafted=Crafted(tile=(4, 4)), rewritten=of_one_patch, detailed=True
        ),
        "patches-channels": Original(_blocks(_cut(four, [0, 14], [0, 9, 20])), detailed=True),
        "patches-loop": Original(_blocks([cap])),
        "patches-order": Original(_blocks([quarters[k] for k in (0, 3, 1, 2)])),
        "patches-predictors": Original(_blocks(lengths)),
    }


def _of_sections() -> dict[str, Original]:
    """Sections and pages: optional ones anywhere, many layers, many windows of residual, small masks."""

    def sections(parts: Parts) -> Parts:
        errors = serialize_window_errors([np.zeros((1, 2), np.uint8)] * len(parts.layers))
        last = len(parts.layers)
        places = {0: [(129, b"first")], 2: [(255, b"")], last: [(WINDOW_ERRORS, errors), (200, b"\3\2\5")]}
        return replace(parts, optional={**places, last + 1: [(129, b"again")]})

    def residual(parts: Parts) -> Parts:
        raw = [bytes([0, *(n % 256 for n in range(k, k + 256))]) if k % 50 == 7 else b"" for k in range(17 * 17)]
        sizes = [(min(16, 264 - 16 * i), min(16, 260 - 16 * j)) for i in range(17) for j in range(17)]
        chunks = [chunk[: 1 + rows * columns] for chunk, (rows, columns) in zip(raw, sizes, strict=True)]
        return replace(parts, chunks=tuple(chunks)).with_header(chunk=(4, 4))

    sparse = np.zeros((264, 260), np.uint8)
    sparse[70:80, 100:103] = 9
    holes = np.rint(40 * _wave(10, 12)).astype(np.int16)
    lake = np.hypot(*(np.mgrid[:10, :12] - np.array([4, 5])[:, None, None])) < 3
    holes[lake] = -99
    named = {"count": np.where(lake, 0, holes % 7 + 1).astype(np.uint8)}
    return {
        "sections-layers": Original(
            ls.Surface(np.rint(20 * _terrain(12, 15)).astype(np.int16)), rewritten=Parts.with_a_layer_for_each_segment
        ),
        "sections-masks": Original(
            ls.Surface(holes, mask=~lake, attributes=named, metadata={"nodata": -99}), detailed=True
        ),
        "sections-optional": Original(ls.Surface(_wave(12, 15).astype(np.float32)), rewritten=sections),
        "sections-pages": Original(ls.Surface(sparse), rewritten=residual),
    }


def _of_strings() -> dict[str, Original]:
    """Strings of bytes that no encoder writes."""
    return {
        "strings-ones": Original(
            ls.Surface(np.rint(40 * _wave(20, 23)).astype(np.int16)),
            rewritten=lambda parts: parts.with_segments(lambda s: b"\xff" * 4 if s.passes > 2 else s.data),
        ),
        "strings-odd": Original(
            ls.Surface(np.rint(40 * _wave(26, 70)).astype(np.int16)),
            crafted=Crafted(large=True),
            rewritten=lambda parts: parts.with_segments(lambda s: s.data[:-1] if len(s.data) > 9 else s.data),
        ),
        "strings-indices": Original(
            ls.Surface(_wave(21, 30)), rms="1%", rewritten=lambda parts: parts.with_header(large=1)
        ),
        "strings-states": Original(
            ls.Surface(np.rint(40 * _wave(26, 40)).astype(np.int16)),
            crafted=Crafted(large=True),
            rewritten=lambda parts: parts.with_segments(
                lambda s: b"\7\1\0\0" + s.data[4:] if s.begins and parts.header.layout.level_of(s.tile) else s.data
            ),
        ),
        "strings-missing": Original(
            ls.Surface(np.rint(40 * _wave(20, 23)).astype(np.float32) + np.float32(0.1)),
            rewritten=lambda parts: parts.without_unit(parts.layers[-1].segments[-1].tile),
            detailed=True,
        ),
    }


def _of_values() -> dict[str, Original]:
    """Lattices and steps at the limits of their types."""
    heights = np.rint(40 * _wave(12, 15))
    types: dict[str, tuple[Any, str, float, float]] = {
        "values-float32": (np.float32, "affine", 0.1, 1 / 3),
        "values-float32-most": (np.float32, "affine", 0.0, 3e37),
        "values-float64-most": (np.float64, "affine", 1.0, 1e307),
        "values-decimal": (np.float64, "decimal", 3.0, 7.0),
        "values-int64": (np.int64, "affine", 0.0, 2.0**59),
        "values-uint64": (np.uint64, "affine", 2.0**63, 2.0**59),
    }

    def with_base(base: int) -> Callable[[Parts], Parts]:
        return lambda parts: parts.with_header(quantiser=Quantiser(base))

    quantised = ls.Surface(_wave(21, 30))
    return {
        name: Original(
            ls.Surface(np.maximum(heights, 0).astype(dtype)),
            rewritten=lambda parts, lattice=lattice: parts.with_lattice(*lattice),  # type: ignore[misc]
        )
        for name, (dtype, *lattice) in types.items()
    } | {
        "values-steps-least": Original(ls.Surface(_wave(40, 33)), rms="1%", rewritten=with_base(1)),
        "values-steps-most": Original(quantised, rms="0.02%", rewritten=with_base((1 << 24) - 1)),
    }


def _of_residuals() -> dict[str, Original]:
    """Chunks of residual of extreme contents, of an attribute: points that are not finite would be holes."""
    heights = np.rint(40 * _wave(32, 32))
    rng = np.random.default_rng(2014)
    wide = [int(n) for n in rng.integers(-(2**62), 2**62, 256)]
    narrow = [int(n) for n in rng.integers(-40, 40, 256)]
    medium = [int(n) for n in rng.integers(-4000, 4000, 256)]
    turns = np.arange(72) / 150
    offsets = np.concatenate([np.full(40, 0.013), turns, turns, turns[::-1]])
    infinite = [0x7FF0000000000000, 0x7FF8000000000001, 1]

    def differences(rule: int, argument: int, wanted: list[int], specials: Sequence[int] = ()) -> _Maker:
        return lambda restored: chunk_of_differences(rule, argument, restored, wanted, specials)

    def random(step: float, bits: int, low: int = 0, high: int = 256) -> _Maker:
        return lambda restored: chunk_of_random_offsets(restored, step, bits, low, high)

    def listed(restored: NDArray[Any]) -> bytes:
        return chunk_of_offsets(restored, (np.rint(restored) + offsets).astype(np.float32), 1.0, 30)

    def attribute(
        dtype: type, lattice: tuple[str, float, float], chunks: list[_Maker], values: Floats = heights
    ) -> Original:
        surface = ls.Surface(heights.astype(np.int8), attributes={"extreme": values.astype(dtype)})
        return Original(surface, rewritten=lambda parts: parts.with_lattice(*lattice).with_chunks(chunks))

    return {
        "residual-decimals": attribute(
            np.float64,
            ("affine", 1.0, 0.37),
            [
                differences(2, 15, narrow, infinite),
                differences(2, 2, wide),
                differences(1, 3, wide),
                differences(1, 20, medium, list(range(15))),
            ],
        ),
        "residual-offsets": attribute(
            np.float32,
            ("affine", 0.0, 1.0),
            [listed, random(1.0, 34), random(0.25, 3, 0, 40), random(5e-324, 0, 90, 170)],
        ),
        "residual-offsets-far": attribute(
            np.float32,
            ("affine", 0.0, 2e37),
            [random(1e38, 20), random(3e38, 26), random(1e300, 6), random(3e-2, 34)],
        ),
        # With this step, places on either side of 2^63 share entries of the memory of differences.
        "residual-uint64": attribute(
            np.uint64,
            ("affine", 2.0**63, 2.0**56 - 80 * 2.0**41),
            [differences(1, 0, narrow), differences(1, 36, narrow), differences(1, 13, wide), lambda _: b""],
            heights + 60,
        ),
    }


@functools.cache
def originals() -> dict[str, Original]:
    """All that there is a golden file of."""
    return {
        **_simple(),
        **_with_holes(),
        **_not_finite(),
        **_with_attributes(),
        **_planes(),
        **_arrangements(),
        **_made_for_an_error(),
        **_large(),
        **_limits(),
        **_of_levels(),
        **_of_tiles(),
        **_of_patches(),
        **_of_sections(),
        **_of_strings(),
        **_of_values(),
        **_of_residuals(),
    }


def digest(arrays: Sequence[NDArray[Any]]) -> str:
    """The first 20 digits of the SHA-256 of the values of arrays, one after another, in C order and little-endian."""
    digested = hashlib.sha256()
    for array in arrays:
        digested.update(array.astype(array.dtype.newbyteorder("<")).tobytes())
    return digested.hexdigest()[:20]


def digests(surface: ls.Surface, heights: bool = False) -> list[str]:
    """Of each block, the digest of its points (or of z alone, for ``heights``) and then its attributes."""
    return [
        digest([block.points[..., 2:] if heights else block.points, *block.attributes.values()])
        for block in surface.blocks
    ]


def _kind(array: NDArray[Any]) -> dict[str, Any]:
    return {"type": array.dtype.name, "shape": list(array.shape)}


def expectations(container: bytes, detailed: bool = False) -> dict[str, Any]:
    """What a container decodes to: shapes, types, errors and values of each layer, and the grids of each level.

    ``detailed``: also the coarser levels of each layer, and the errors of channels.
    """
    decoder = ls.Decoder()
    decoder.feed(container)
    decoder.finish()
    header = decoder.header
    assert header is not None
    plane = header.plane is not None  # x and y of coarser levels are the receiver's to choose
    found = {
        "blocks": [
            {
                "closed": list(block.closed),
                "holes": block.holes,
                "points": _kind(block.points),
                "attributes": {name: _kind(array) for name, array in block.attributes.items()},
            }
            for block in decoder.surface().blocks
        ],
        "layers": [
            {
                "bytes": view.bytes,
                "level": view.level,
                "rms": view.rms,
                "max": view.max_error,
                "sha256": digests(view.surface()),
            }
            for view in decoder.layers
        ],
        "levels": [
            digests(decoder.surface(level), plane and level < header.levels) for level in range(header.levels + 1)
        ],
    }
    if detailed:
        found["channels"] = [[list(errors) for errors in view.channels] for view in decoder.layers]
        found["partial"] = [
            [digests(view.surface(level), plane) for level in range(header.levels)]
            for view in decoder.layers[: header.layer_count]
        ]
    return found


def lines(expected: Mapping[str, Mapping[str, Any]]) -> str:
    """Expectations as JSON, a line for each block, layer and level."""
    surfaces = []
    for name, parts in expected.items():
        lists = (
            f"  {json.dumps(part)}: [\n" + ",\n".join(f"   {json.dumps(entry)}" for entry in entries) + "\n  ]"
            for part, entries in parts.items()
        )
        surfaces.append(f" {json.dumps(name)}: {{\n" + ",\n".join(lists) + "\n }")
    return "{\n" + ",\n".join(surfaces) + "\n}\n"


def main() -> None:
    """Write the files that are not there, and what is expected of all."""
    expected = {}
    for name, original in originals().items():
        path = FOLDER / f"{name}.lode"
        container = path.read_bytes() if path.exists() else original.encode()
        path.write_bytes(container)
        expected[name] = expectations(container, original.detailed)
    (FOLDER / "expected.json").write_text(lines(expected))


if __name__ == "__main__":
    main()
