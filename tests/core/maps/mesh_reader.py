"""A decoder of quantized-mesh-1.0, written from its specification alone."""

from __future__ import annotations

import struct
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray


@dataclass(frozen=True)
class Mesh:
    """What a tile says. u and v are from 0 to 32767, from the west and from the south; heights are metres."""

    centre: NDArray[np.float64]
    least: float
    most: float
    sphere: NDArray[np.float64]
    radius: float
    horizon: NDArray[np.float64]
    u: NDArray[np.int64]
    v: NDArray[np.int64]
    heights: NDArray[np.float64]
    triangles: NDArray[np.int64]
    edges: dict[str, NDArray[np.int64]]
    normals: NDArray[np.float64] | None
    coded_normals: bytes

    def grid(self, values: NDArray[Any]) -> NDArray[Any]:
        """Values of vertices as a grid, the southernmost row first."""
        n = round(len(self.u) ** 0.5)
        return values[np.lexsort((self.u, self.v))].reshape(n, n, *values.shape[1:])


def read_mesh(data: bytes) -> Mesh:
    """Decode a tile; every byte must belong to it."""
    fields = struct.unpack_from("<3d2f4d3d", data)
    at = struct.calcsize("<3d2f4d3d")
    (count,) = struct.unpack_from("<I", data, at)
    at += 4
    assert count <= 65536  # indices are of 16 bits
    axes = []
    for _ in range(3):
        coded = np.frombuffer(data, "<u2", count, at).astype(np.int64)
        axes.append(np.cumsum((coded >> 1) ^ -(coded & 1)))
        at += 2 * count
    u, v, height = axes
    for values in axes:
        assert values.min() >= 0
        assert values.max() <= 32767
    (triangles,) = struct.unpack_from("<I", data, at)
    at += 4
    indices, highest = [], 0
    for code in np.frombuffer(data, "<u2", 3 * triangles, at).tolist():
        indices.append(highest - code)
        highest += code == 0
    at += 6 * triangles
    edges = {}
    for name in ("west", "south", "east", "north"):
        (length,) = struct.unpack_from("<I", data, at)
        edges[name] = np.frombuffer(data, "<u2", length, at + 4).astype(np.int64)
        at += 4 + 2 * length
    normals, coded_normals = None, b""
    while at < len(data):
        kind, length = struct.unpack_from("<BI", data, at)
        if kind == 1:
            coded_normals = data[at + 5 : at + 5 + length]
            normals = _vectors(np.frombuffer(coded_normals, np.uint8).reshape(count, 2))
        at += 5 + length
    assert at == len(data)
    least, most = fields[3], fields[4]
    return Mesh(
        np.array(fields[:3]),
        least,
        most,
        np.array(fields[5:8]),
        fields[8],
        np.array(fields[9:12]),
        u,
        v,
        least + height / 32767 * (most - least),
        np.array(indices).reshape(-1, 3),
        edges,
        normals,
        coded_normals,
    )


def _vectors(coded: NDArray[np.uint8]) -> NDArray[np.float64]:
    x, y = coded.T / 255 * 2 - 1
    z = 1 - np.abs(x) - np.abs(y)
    folded = z < 0
    x, y = (
        np.where(folded, (1 - np.abs(y)) * np.where(x >= 0, 1, -1), x),
        np.where(folded, (1 - np.abs(x)) * np.where(y >= 0, 1, -1), y),
    )
    vectors = np.stack((x, y, z), axis=1)
    return np.asarray(vectors / np.linalg.norm(vectors, axis=1, keepdims=True))
