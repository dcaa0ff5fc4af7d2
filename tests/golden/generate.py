"""Make the golden files anew: ``PYTHONPATH=core python -m tests.golden.generate``.

Until Lodestream 1.0 this goes with each new version of the format and nothing else; afterwards files are only added.
"""

from __future__ import annotations

import contextlib
import functools
import hashlib
import itertools
import json
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

import lodestream as ls
from lodestream.encoding import allocated, encoder, large_units, prepared, quantized, transformed
from lodestream.encoding.allocation import assign_layers
from lodestream.encoding.curves import Curves
from lodestream.entropy.tile_coder import TileCoder, planes_of
from lodestream.entropy.tiles import TileTable, gather
from lodestream.transform.predictors import COEFFICIENT_BITS

__all__ = ["FOLDER", "Original", "digest", "digests", "expectations", "lines", "originals"]

FOLDER = Path(__file__).parent

Floats = NDArray[np.float64]


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
    """

    large: bool = False
    tile: tuple[int, int] | None = None
    factor: int = 1
    ones: int = 0

    @contextlib.contextmanager
    def applied(self) -> Iterator[None]:
        """While a surface is encoded."""
        code, most = TileCoder.code, (1 << COEFFICIENT_BITS) - 1

        def gathered(*arguments: Any) -> NDArray[np.int32]:
            return np.clip(self.factor * gather(*arguments).astype(np.int64), -most, most).astype(np.int32)

        def planes(table: TileTable, true: NDArray[np.int32], tile: int) -> int:
            return planes_of(table, true, tile) + (self.ones if tile == 0 else 0)

        def assigned(curves: Curves, *arguments: Any) -> list[NDArray[Any]]:
            states = assign_layers(curves, *arguments)
            first = np.zeros_like(states[0])
            first[curves.tile, curves.channel] = curves.counts
            first[0] -= 2 * self.ones
            return [first, *states]

        def coded(coder: TileCoder, tile: int, channel: int, first: int, passes: int, *costs: Any) -> bytes:
            data = code(coder, tile, channel, first, passes, *costs)
            begins = first == 2 * int(coder._channels[channel].top[tile]) - 1
            return b"\xff" * 4 if tile == 0 and begins and passes == 2 * self.ones else data

        with pytest.MonkeyPatch.context() as patch:
            if self.large:
                patch.setattr(large_units, "_LARGE", 1)
                patch.setattr(large_units, "_MOST", float("inf"))
            if self.tile:
                patch.setattr(prepared, "tile_exponents", lambda *_: self.tile)
            if self.factor > 1:
                patch.setattr(encoder, "COARSER", ())  # no container of fewer bits is tried
                patch.setattr(transformed, "gather", gathered)
            if self.ones:
                patch.setattr(quantized, "planes_of", planes)
                patch.setattr(allocated, "assign_layers", assigned)
                patch.setattr(TileCoder, "code", coded)
            yield


@dataclass(frozen=True)
class Original:
    """A surface, and with what precision or for what error it is encoded."""

    surface: ls.Surface
    precision: str | None = None
    attribute_precision: Mapping[str, str] = field(default_factory=dict)
    rms: str | None = None
    crafted: Crafted = Crafted()

    def encode(self) -> bytes:
        """Its container."""
        precisions = dict(self.attribute_precision)
        with self.crafted.applied():
            return ls.encode(self.surface, self.precision, rms=self.rms, attribute_precision=precisions)


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


def _cut(points: Floats, rows: Sequence[int], columns: Sequence[int]) -> list[Floats]:
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
        "heights-precision": Original(ls.Surface(_wave(90, 70)), "1e-4d"),
        "heights-constant": Original(ls.Surface(np.full((5, 8), 12.5))),
        "heights-offsets": Original(ls.Surface(quantised.astype(np.float32))),
        "heights-widest": Original(ls.Surface(widest.astype(np.int32))),
        "heights-tower": Original(ls.Surface(tower)),
        "planar-open": Original(ls.Surface(_torus(13, 11)[..., :2].astype(np.float32))),
        "torus-odd": Original(ls.Surface(_torus(21, 33).astype(np.float32), (True, True))),
        "cylinder-even": Original(ls.Surface(_torus(24, 18), (True, False)), "1e-3d"),
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
        "holes-closed": Original(ls.Surface(tube, (True, True)), "1e-4d"),
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
        "infinite-error": Original(ls.Surface(heights), rms="1e-2d"),
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
    return {name: Original(ls.Surface(points), "1e-3d") for name, points in found.items()}


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
        "blocks-groups": Original(_blocks(large), "2e-3d"),
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
        "error-smooth": Original(ls.Surface(_wave(120, 141).astype(np.float32)), rms="1e-3d"),
        "error-trellis": Original(ls.Surface(rough), rms="1e-2d"),
        "error-trellis-tiles": Original(ls.Surface(np.concatenate([rough, rough[::-1]])), rms="5e-3d"),
        "error-holes": Original(ls.Surface(metres, mask=~lake, metadata={"nodata": -9999}), rms="5"),
        "error-attributes": Original(ls.Surface(_torus(48, 51), (True, True), attributes=colors), rms="2e-3d"),
        "error-blocks": Original(_blocks(_cut(globe, [0, 16], [0, 9, 24])), rms="1e-3d"),
        "error-curve": Original(ls.Surface(_torus(1, 90)[0][:, None], (True, False)), rms="1e-3d"),
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
        "large-closed": Original(ls.Surface(_torus(21, 72)), "1e-5d", crafted=everywhere),
        "large-error": Original(
            ls.Surface(_torus(26, 70), (True, False), attributes={"color": attributes["color"]}),
            rms="2e-3d",
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


def expectations(container: bytes) -> dict[str, Any]:
    """What a container decodes to: shapes, types, errors and values of each layer, and the grids of each level."""
    decoder = ls.Decoder()
    decoder.feed(container)
    decoder.finish()
    header = decoder.header
    assert header is not None
    return {
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
        # Where x and y are a rule, those of coarser levels are the receiver's to choose.
        "levels": [
            digests(decoder.surface(level), header.plane is not None and level < header.levels)
            for level in range(header.levels + 1)
        ],
    }


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
    """Write all files."""
    expected = {}
    for name, original in originals().items():
        container = original.encode()
        (FOLDER / f"{name}.lode").write_bytes(container)
        expected[name] = expectations(container)
    (FOLDER / "expected.json").write_text(lines(expected))


if __name__ == "__main__":
    main()
