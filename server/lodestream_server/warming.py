"""Compiling the kernels before strangers' files come, or loading them from the disk.

A build may not write where machine code is kept, so what it still has to compile it compiles each time: a second or
two. Hence every kind of surface is coded here once: each type of values, holes, several blocks, attributes, meshes.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

if TYPE_CHECKING:
    from collections.abc import Iterator

    from lodestream import Surface
    from lodestream.mesh import Mesh

__all__ = ["warm"]

_TYPES = ("float32", "float64", "int8", "int16", "int32", "int64", "uint8", "uint16", "uint32", "uint64")


def warm() -> str | None:
    """Find the grids of small meshes, and code small surfaces of every kind.

    Returns
    -------
    str or None
        Why the kernels are not kept on disk, if they are not.
    """
    from lodestream import decode, encode
    from lodestream.numba_kernels import unkept

    _find_grids()
    for surface in _surfaces():
        if not _same(decode(encode(surface)), surface):
            raise RuntimeError("expected the surface that was encoded, got another one")
    for points in (_heights(), _with_holes(_heights())):
        errors = decode(encode(points, rms="1e-2d")).points - points
        if np.sqrt(np.nanmean(np.square(errors))) > 0.01 * np.ptp(points[np.isfinite(points)]):
            raise RuntimeError("expected a surface within the error that it was encoded for, got another one")
    decode(encode(_heights(), "1e-3d"))
    _inspect()
    return unkept()


def _find_grids() -> None:
    from lodestream.formats.lzf import decompress
    from lodestream.mesh import Mesh
    from lodestream.mesh.recognise import recognise

    xyz = _xyz()
    number = np.arange(xyz.size // 3, dtype=np.int32).reshape(xyz.shape[:2])
    quads = _quads(number)
    a, b, c, d = quads.T
    none = np.full_like(a, -1)
    halves = np.concatenate((np.stack((a, b, c, none), axis=-1), np.stack((a, c, d, none), axis=-1)))
    for corners in (quads, halves):
        if not np.array_equal(recognise(Mesh(xyz.reshape(-1, 3), corners)).surface().points, xyz):
            raise RuntimeError("expected the grid that the mesh was made of, got another one")
    # One that is closed both ways, and one that is cut into blocks.
    recognise(Mesh(xyz.reshape(-1, 3), _quads(np.pad(number, (0, 1), "wrap")))).surface()
    recognise(_cube()).surface()
    if bytes(decompress(b"\x02abc\x20\x02", 6)) != b"abcabc":
        raise RuntimeError("expected the bytes that were compressed, got others")


def _cube() -> Mesh:
    """The six sides of a cube, of 16 quads each."""
    from lodestream.mesh import Mesh

    u, v = np.mgrid[0:5, 0:5].astype(np.float64)
    low, high = np.zeros_like(u), np.full_like(u, 4)
    sides = [(low, u, v), (high, v, u), (v, low, u), (u, high, v), (u, v, low), (v, u, high)]
    points = np.concatenate([np.stack(side, axis=-1).reshape(-1, 3) for side in sides])
    vertices, which = np.unique(points, axis=0, return_inverse=True)
    numbers = which.astype(np.int32).reshape(6, 5, 5)
    return Mesh(vertices, np.concatenate([_quads(side) for side in numbers]))


def _quads(number: np.ndarray[Any, np.dtype[np.int32]]) -> np.ndarray[Any, np.dtype[np.int32]]:
    corners = (number[:-1, :-1], number[:-1, 1:], number[1:, 1:], number[1:, :-1])
    return np.stack([corner.reshape(-1) for corner in corners], axis=-1)


def _surfaces() -> Iterator[Surface]:
    from lodestream import Block, Surface

    heights, xyz = _heights(), _xyz()
    yield Surface(heights)
    yield Surface(xyz)
    yield Surface(_with_holes(heights))
    yield Surface(_with_holes(heights).astype(np.float32))
    yield Surface(heights, mask=np.isfinite(_with_holes(heights)))
    for name in _TYPES:
        values = np.asarray(heights + 50).astype(name)
        yield Surface(values)
        yield Surface(values, attributes={"more": values})
    yield Surface(xyz, mask=np.isfinite(_with_holes(heights)))
    yield Surface(xyz.astype(np.float32), mask=np.isfinite(_with_holes(heights)))
    yield Surface(xyz.astype(np.float32), closed=(False, True))
    yield Surface(blocks=[Block(xyz[:, :21]), Block(xyz[:, 20:])])
    yield Surface(blocks=[Block(xyz[:, :21].astype(np.float32)), Block(xyz[::-1, 20:].astype(np.float32))])


def _inspect() -> None:
    import io

    from lodestream import encode
    from lodestream.inspection import inspect

    for points in (_heights(), _with_holes(_heights()), _xyz()):
        inspect(io.BytesIO(encode(points)), max_vertices=points.size)


def _heights() -> np.ndarray[Any, np.dtype[np.float64]]:
    rows, columns = np.mgrid[0:37, 0:41].astype(np.float64)
    return np.asarray(np.sin(rows / 5) * columns)


def _xyz() -> np.ndarray[Any, np.dtype[np.float64]]:
    rows, columns = np.mgrid[0:37, 0:41].astype(np.float64)
    return np.stack((rows, columns, np.sin(rows * columns / 99)), axis=-1)


def _with_holes(heights: np.ndarray[Any, np.dtype[np.float64]]) -> np.ndarray[Any, np.dtype[np.float64]]:
    holes = heights.copy()
    holes[5:12, 20:] = holes[20, 3] = np.nan
    return holes


def _same(found: Surface, made: Surface) -> bool:
    for ours, theirs in zip(found.blocks, made.blocks, strict=True):
        valid = ... if theirs.mask is None else theirs.mask
        floats = theirs.points.dtype.kind == "f"
        if not np.array_equal(ours.points[valid], theirs.points[valid], equal_nan=floats):
            return False
    return True
