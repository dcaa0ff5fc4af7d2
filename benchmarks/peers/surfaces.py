"""The surfaces that are measured: real ones, those of the design's table, and generated ones."""

from __future__ import annotations

import hashlib
import json
from collections import defaultdict
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..arrays import ROOT, fractal, load
from .lattice import Lattice, lattice_of

__all__ = ["BUILD", "GROUPS", "Specimen", "catalogue", "prepare", "specimen"]

BUILD = ROOT / "build" / "peers"
DATA = ROOT.parent / "shared" / "data"
GROUPS = ("rough terrain", "smooth", "xyz", "noise", "tiny")
LARGE = 4_000_000
TINY = 64 * 64


@dataclass(frozen=True)
class Specimen:
    """A surface as it stands in the cache, and what the coders share of it."""

    name: str
    group: str
    source: str
    closed: tuple[bool, bool]
    points: NDArray[Any]

    @cached_property
    def channels(self) -> list[NDArray[Any]]:
        """Contiguous planes."""
        planes = self.points[..., None] if self.points.ndim == 2 else self.points
        return [np.ascontiguousarray(planes[..., number]) for number in range(planes.shape[2])]

    @cached_property
    def floats(self) -> list[NDArray[np.float32]]:
        """The same as float32, which is what the coders of floating point are given."""
        return [channel.astype(np.float32) for channel in self.channels]

    @cached_property
    def reference(self) -> NDArray[np.float64]:
        """Rows, columns, channels."""
        return np.stack(self.channels, -1).astype(np.float64)

    @cached_property
    def low(self) -> NDArray[np.float64]:
        """Lowest value of each channel."""
        lowest: NDArray[np.float64] = self.reference.min((0, 1))
        return lowest

    @cached_property
    def sides(self) -> NDArray[np.float64]:
        """Range of each channel."""
        ranges: NDArray[np.float64] = np.ptp(self.reference, (0, 1))
        return ranges

    @property
    def extent(self) -> float:
        """Range of the heights, or diagonal of the box: what errors are relative to."""
        return float(np.linalg.norm(self.sides))

    @cached_property
    def lattice(self) -> Lattice | None:
        """The lattice of whole numbers that the values lie on, if there is one."""
        return lattice_of(self.points)

    @property
    def shape(self) -> tuple[int, int]:
        return (self.points.shape[0], self.points.shape[1])

    @property
    def large(self) -> bool:
        """Whether coders are tried at fewer settings."""
        return self.points.size > LARGE

    @cached_property
    def fingerprint(self) -> str:
        """Changes with the values: results of another surface of the same name are not taken for this one's."""
        return hashlib.sha256(np.ascontiguousarray(self.points).tobytes()).hexdigest()[:16]

    @cached_property
    def vertices(self) -> NDArray[np.bool_]:
        """Rows, columns: one point of those at the same place on the outline, as at poles and seams; all others."""
        counted = np.ones(self.shape, np.bool_)
        if len(self.channels) == 3:
            outline = np.zeros(self.shape, np.bool_)
            outline[[0, -1]] = outline[:, [0, -1]] = True
            places = np.rint((self.reference[outline] - self.low) * (1e6 / self.extent))
            first = np.zeros(len(places), np.bool_)
            first[np.unique(places, axis=0, return_index=True)[1]] = True
            counted[outline] = first
        return counted

    def errors(self, decoded: NDArray[Any], counted: NDArray[np.bool_] | None = None) -> tuple[float, float]:
        """RMS and largest distance, relative to the extent; of all points, or of those named."""
        difference = decoded.reshape(self.reference.shape).astype(np.float64)
        difference -= self.reference
        squares = np.einsum("ijk,ijk->ij", difference, difference)
        if counted is not None:
            squares = squares[counted]
        return float(np.sqrt(squares.mean())) / self.extent, float(np.sqrt(squares.max())) / self.extent


def catalogue() -> list[str]:
    """Names of the surfaces that `prepare` made."""
    index = BUILD / "surfaces.json"
    return list(json.loads(index.read_text())) if index.exists() else []


def specimen(name: str) -> Specimen:
    """A surface of the cache."""
    facts = json.loads((BUILD / "surfaces.json").read_text())[name]
    rows, columns = facts["closed"]
    return Specimen(name, facts["group"], facts["source"], (rows, columns), np.load(BUILD / f"{name}.npy"))


def prepare() -> list[str]:
    """Make all surfaces; returns notes on those that were left out."""
    BUILD.mkdir(parents=True, exist_ok=True)
    facts: dict[str, dict[str, Any]] = {}
    skipped: list[str] = []
    for name, group, source, closed, points in (*_of_design(skipped), *_of_files(skipped), *_generated()):
        np.save(BUILD / f"{name}.npy", points)
        facts[name] = {"group": group, "source": source, "closed": closed}
    (BUILD / "surfaces.json").write_text(json.dumps(facts, indent=1))
    return skipped


_Made = tuple[str, str, str, tuple[bool, bool], NDArray[Any]]


def _of_design(skipped: list[str]) -> Iterator[_Made]:
    groups = {"smooth": "smooth", "knot": "xyz"}
    arrays = load()
    if not arrays:
        skipped.append("the arrays of shared/bench/surfaces.py: there is no such file")
    for array in arrays:
        group = groups.get(array.name, "rough terrain")
        yield array.name, group, "shared/bench/surfaces.py", (False, False), array.points


def _of_files(skipped: list[str]) -> Iterator[_Made]:
    import lodestream

    if not DATA.is_dir():
        skipped.append("shared/data: there is no such folder")
        return
    left: dict[str, list[str]] = defaultdict(list)
    for path in sorted(DATA.iterdir()):
        if path.name == "README.md":
            continue
        try:
            surface = lodestream.read(path)
        except lodestream.LodestreamError:
            left["refused by `lodestream.read` without options, or without an extra"].append(path.name)
            continue
        if len(surface.blocks) > 1:
            left["several blocks, which no peer takes"].append(path.name)
            continue
        if surface.mask is not None:
            left["holes, which no peer takes"].append(path.name)
            continue
        points = _heights(surface.points)
        if points.ndim == 3 and points.shape[2] != 3:
            left["neither heights nor x, y, z"].append(path.name)
            continue
        yield path.name, _group(points), f"shared/data/{path.name}", surface.closed, points
    skipped += [f"{why}: {', '.join(names)}" for why, names in left.items()]


def _heights(points: NDArray[Any]) -> NDArray[Any]:
    """Heights alone where x depends on the column and y on the row only: no peer has to code the rest, nor have we."""
    if points.ndim != 3 or points.shape[2] != 3:
        return points
    x, y = points[..., 0], points[..., 1]
    separable = bool((x == x[:1]).all() and (y == y[:, :1]).all())
    return np.ascontiguousarray(points[..., 2]) if separable else points


def _group(points: NDArray[Any]) -> str:
    if points.shape[0] * points.shape[1] <= TINY:
        return "tiny"
    return "xyz" if points.ndim == 3 else "rough terrain"


def _generated() -> Iterator[_Made]:
    makers: dict[str, tuple[str, tuple[bool, bool], Callable[[], NDArray[Any]]]] = {
        "waves-513": ("smooth", (False, False), _waves),
        "sphere-385": ("xyz", (False, False), _sphere),
        "torus-closed": ("xyz", (True, True), _torus),
        "noise-257": ("noise", (False, False), _noise),
        "noisy-xyz-257": ("noise", (False, False), _noisy_xyz),
        "tiny-heights-17": ("tiny", (False, False), lambda: np.rint(fractal(17) / 64).astype(np.int16)),
        "tiny-float-17": ("tiny", (False, False), lambda: _waves()[::32, ::32].copy()),
        "tiny-xyz-17": ("tiny", (False, False), lambda: _sphere()[::24, ::24].copy()),
        "terrain-4097": ("rough terrain", (False, False), lambda: fractal(4097)),
    }
    for name, (group, closed, make) in makers.items():
        yield name, group, "generated", closed, make()


def _waves() -> NDArray[np.float32]:
    """Hills of many sizes, without any lattice."""
    y, x = np.meshgrid(np.linspace(0, 1, 513), np.linspace(0, 1, 513), indexing="ij")
    rng = np.random.default_rng(2002)
    heights = np.zeros_like(x)
    for _ in range(40):
        a, b = rng.uniform(-12, 12, 2)
        heights += np.cos(2 * np.pi * (a * x + b * y) + rng.uniform(0, 2 * np.pi)) / (1 + np.hypot(a, b) ** 2)
    return (1000 + 300 * heights).astype(np.float32)


def _sphere() -> NDArray[np.float32]:
    """A bumpy sphere with collapsed poles."""
    u, v = np.meshgrid(np.linspace(0, np.pi, 385), np.linspace(0, 2 * np.pi, 385), indexing="ij")
    radius = 1 + 0.08 * np.sin(5 * v) * np.sin(4 * u) + 0.01 * np.sin(31 * v + 2 * u) * np.sin(u) ** 2
    unit = np.stack([np.sin(u) * np.cos(v), np.sin(u) * np.sin(v), np.cos(u)], -1)
    return np.asarray(radius[..., None] * unit, np.float32)


def _torus() -> NDArray[np.float32]:
    """Closed both ways, without a repeated row or column, and fluted."""
    u = np.linspace(0, 2 * np.pi, 512, endpoint=False)[:, None]
    v = np.linspace(0, 2 * np.pi, 256, endpoint=False)[None, :]
    tube = 0.4 + 0.05 * np.cos(5 * u + 2 * v) + 0.004 * np.cos(29 * u - 17 * v)
    ring = 1 + tube * np.cos(v)
    return np.stack([ring * np.cos(u), ring * np.sin(u), tube * np.sin(v) + 0 * u], -1).astype(np.float32)


def _noise() -> NDArray[np.int16]:
    """Nothing but noise: whole numbers, normally distributed."""
    return np.rint(200 * np.random.default_rng(2002).standard_normal((257, 257))).astype(np.int16)


def _noisy_xyz() -> NDArray[np.float32]:
    """A plane with noise of a hundredth of its side in all directions."""
    y, x = np.meshgrid(np.linspace(0, 1, 257), np.linspace(0, 1, 257), indexing="ij")
    plane = np.stack([x, y, 0 * x], -1)
    return (plane + np.random.default_rng(2002).normal(0, 0.01, plane.shape)).astype(np.float32)
