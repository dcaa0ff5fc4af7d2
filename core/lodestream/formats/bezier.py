"""Bézier patches in text (.bpt), as of the Utah teapot, sampled to one block each.

The file holds a count of patches, then for each its two degrees and its control points, the second index running
fastest.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from ..errors import FormatError
from ..surface import Block, Surface
from .list_directed import is_text, read_numbers
from .source import Source, number

__all__ = ["OPTIONS", "SUFFIX", "read", "sniff"]

SUFFIX = ".bpt"
OPTIONS = {"density": "number of intervals along each side of a patch (default: 16)"}

_DENSITY = 16
_MAX_DENSITY = 1 << 14
_MAX_DEGREE = 32
_MAX_PATCHES = 1 << 14

Points = NDArray[np.float64]


def sniff(head: bytes, suffix: str) -> bool:
    """Whether a file is numbers in text and named .bpt: nothing in it tells what they are."""
    return suffix == SUFFIX and is_text(head)


def read(source: Source) -> Surface:
    """Read patches and sample them at ``density`` equal intervals of each parameter, ends included.

    Patches with the same control points along a side, in either direction, have the same points there, bit for bit;
    sides that are a single point stay one.
    """
    density = source.integer_option("density", 1, _MAX_DENSITY) or _DENSITY
    patches = _patches(*read_numbers(source.path))
    vertices = len(patches) * (density + 1) ** 2
    source.check_vertices(vertices, f"{number(len(patches))} patches of {density + 1} x {density + 1} points")
    blocks = [Block(_sampled(patch, density)) for patch in patches]
    return Surface(blocks=blocks, metadata=source.metadata("bpt") | {"density": density})


def _patches(numbers: Points, integers: int) -> list[Points]:
    """Control points of each patch, (degree + 1, degree + 1, 3)."""
    if not integers or numbers[0] not in range(1, _MAX_PATCHES + 1):
        raise FormatError(f"expected a count of patches from 1 to {number(_MAX_PATCHES)} first, got another number")
    count, place, result = int(numbers[0]), 1, []
    for index in range(count):
        degrees = numbers[place : place + 2]
        if len(degrees) < 2 or not all(value in range(1, _MAX_DEGREE + 1) for value in degrees.tolist()):
            words = " ".join(f"{value:g}" for value in degrees) or "the end of the file"
            raise FormatError(
                f"expected two degrees from 1 to {_MAX_DEGREE} for patch {index + 1} of {count}, got {words}"
            )
        rows, columns = (int(value) + 1 for value in degrees)
        control = numbers[place + 2 : place + 2 + rows * columns * 3]
        if len(control) < rows * columns * 3 or not np.isfinite(control).all():
            raise FormatError(
                f"expected {rows * columns} control points of finite numbers for patch {index + 1} of {count}, got "
                "others or the end of the file"
            )
        result.append(control.reshape(rows, columns, 3) + 0.0)  # without negative zeros, whose bits differ
        place += 2 + rows * columns * 3
    if place != len(numbers):
        raise FormatError(
            f"expected the end of the file after {count} patches, got {len(numbers) - place} more numbers"
        )
    return result


def _sampled(control: Points, density: int) -> Points:
    """Points of a patch, (density + 1, density + 1, 3); those of a side depend on its own control points alone."""
    across = np.stack([_curve(row, density) for row in control])
    points = np.stack([_curve(column, density) for column in across.transpose(1, 0, 2)], axis=1)
    for side in (0, -1):
        points[side] = _side(control[side], density)
        points[:, side] = _side(control[:, side], density)
    return points


def _side(control: Points, density: int) -> Points:
    """Points of a curve, the same whichever end it begins at."""
    if (control == control[0]).all():
        return np.repeat(control[:1], density + 1, axis=0)
    if control[::-1].tolist() < control.tolist():
        return _curve(control[::-1], density)[::-1]
    return _curve(control, density)


def _curve(control: Points, density: int) -> Points:
    """Points of a curve at equal intervals, (density + 1, 3), by de Casteljau's algorithm."""
    t = (np.arange(density + 1) / density)[:, None, None]
    points = np.broadcast_to(control, (density + 1, *control.shape))
    while points.shape[1] > 1:
        points = (1 - t) * points[:, :-1] + t * points[:, 1:]
    return points[:, 0]
