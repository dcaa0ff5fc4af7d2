"""The surfaces: random ones of every kind, files of users, and the arrays that figures are measured with."""

from __future__ import annotations

import warnings
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

import lodestream as ls
from benchmarks.arrays import load

__all__ = ["KINDS", "Case", "array_cases", "file_cases", "random_case"]

Random = np.random.RandomState
DTYPES = ("int8", "uint8", "int16", "uint16", "int32", "int64", "uint64", "float32", "float64")
KINDS = (
    "heights",
    "points",
    "holes",
    "infinities",
    "attributes",
    "plates",
    "apart",
    "sphere",
    "seam",
    "moebius",
    "precision",
    "rms",
)


@dataclass(frozen=True)
class Case:
    """A surface and the options to encode it with."""

    name: str
    surface: ls.Surface
    options: dict[str, Any] = field(default_factory=dict)


def random_case(seed: int) -> Case:
    """Make one surface of the kind ``seed % len(KINDS)``.

    Only integers of `numpy.random.RandomState`, whose stream never changes, and exact arithmetic go into it, so every
    machine makes the same one.
    """
    kind, random = KINDS[seed % len(KINDS)], Random(seed)
    largest = 300 if random.randint(8) == 0 else 60
    shape = random.randint(4, largest), random.randint(4, largest // 2)
    closed = bool(random.randint(3) == 0), bool(random.randint(3) == 0)
    dtype = str(random.choice(DTYPES))
    options: dict[str, Any] = {}
    if kind in ("plates", "apart", "sphere", "seam", "moebius"):
        surface = ls.Surface(blocks=_blocks(kind, shape, dtype if dtype[0] == "f" else "float32", random))
        return Case(f"{seed}-{kind}", surface, {"precision": 1 / 64} if random.randint(4) == 0 else options)
    if kind in ("infinities", "rms"):
        dtype = str(random.choice(["float32", "float64"]))
    points = _rough(shape if kind != "points" else (*shape, 3), dtype, random)
    mask, attributes = None, dict[str, NDArray[Any]]()
    if kind in ("holes", "infinities") or random.randint(6) == 0:
        mask = random.randint(10, size=shape) > 0
        mask[random.randint(shape[0]) :, : random.randint(shape[1]) // 2] = False
        mask[0, -1] = True
    if kind == "infinities":
        points[random.randint(20, size=shape) == 0] = np.inf
        points[0, 0] = 1
    if kind == "attributes":
        attributes = {
            "id": random.randint(-(2**62), 2**62, size=shape, dtype=np.int64),
            "count": random.randint(0, 2**16, size=(*shape, 2)).astype(np.uint16),
            "speed": _rough(shape, "float32", random),
        }
    if kind == "precision":
        options["precision"] = float(2.0 ** random.randint(-4, 4)) if dtype[0] == "f" else int(2 ** random.randint(4))
    if kind == "rms":
        options["rms"] = float(2.0 ** random.randint(-3, 3))
    return Case(f"{seed}-{kind}", ls.Surface(points, closed, mask=mask, attributes=attributes), options)


def _rough(shape: tuple[int, ...], dtype: str, random: Random) -> NDArray[Any]:
    """Sums of random steps along both axes, or now and then any values of the type."""
    if random.randint(6) == 0:
        if dtype[0] == "f":
            mantissas = random.randint(-(2**20), 2**20, size=shape)
            return np.ldexp(mantissas.astype(np.float64), random.randint(-40, 40, size=shape)).astype(dtype)
        limits = np.iinfo(dtype)
        return np.asarray(random.randint(limits.min, limits.max, size=shape, dtype=np.dtype[Any](dtype)))
    sums = random.randint(-9, 10, size=shape).cumsum(axis=0) + random.randint(-9, 10, size=shape).cumsum(axis=1)
    if dtype[0] == "f":
        sums = sums + random.randint(0, 2**12, size=shape) / 2**12
    else:
        sums = np.clip(sums + 60, np.iinfo(dtype).min, np.iinfo(dtype).max)
    return np.asarray(sums, dtype)


def _blocks(kind: str, shape: tuple[int, int], dtype: str, random: Random) -> list[ls.Block]:
    """Blocks that share sides or none, or a block that meets itself."""
    rows, columns = max(shape[0], 9), max(shape[1], 9)
    points = np.stack(
        [
            np.broadcast_to(np.arange(columns) * 4.0, (rows, columns)),
            np.broadcast_to(np.arange(rows)[:, None] * 4.0, (rows, columns)),
            _rough((rows, columns), "float64", random) / 4,
        ],
        axis=-1,
    ).astype(dtype)
    if kind == "plates":
        row, column = random.randint(3, rows - 3), random.randint(3, columns - 3)
        corners = [
            (slice(a, b), slice(c, d))
            for a, b in ((0, row + 1), (row, rows))
            for c, d in ((0, column + 1), (column, columns))
        ]
        blocks = []
        for place in corners:
            piece = points[place][:: -1 if random.randint(2) else 1]
            piece = piece.swapaxes(0, 1) if random.randint(3) == 0 else piece
            speed = {"speed": np.ascontiguousarray(piece[..., 2]) * np.float32(0.5)}
            blocks.append(ls.Block(np.ascontiguousarray(piece), attributes=speed))
        return blocks
    if kind == "apart":
        places = [points[: rows - 3 * number] + np.array([0, 4096 * number, 0], dtype) for number in range(2)]
        return [ls.Block(piece, (False, bool(random.randint(2)))) for piece in places]
    if kind == "sphere":
        points[0], points[-1] = points[0, 0], points[-1, 0]
        return [ls.Block(points, (False, True))]
    points[:, -1] = points[:, 0] if kind == "seam" else points[::-1, 0]
    return [ls.Block(points)]


def file_cases(folder: Path) -> Iterator[Case]:
    """Read every file of a folder that is a surface."""
    for path in sorted(folder.iterdir()):
        if path.is_file() and path.suffix not in (".md", ".json"):
            try:
                with warnings.catch_warnings():
                    warnings.simplefilter("ignore")
                    surface = ls.read(path)
            except (ls.LodestreamError, OSError):
                continue
            yield Case(f"file-{path.name}", surface)


def array_cases() -> Iterator[Case]:
    """Give the arrays that figures are measured with, where they are there."""
    for array in load():
        yield Case(f"array-{array.name}", ls.Surface(array.points.copy()))
