"""Make the golden files anew: ``PYTHONPATH=core python -m tests.golden.generate``.

Until Lodestream 1.0 this goes with each new version of the format and nothing else; afterwards files are only added.
"""

from __future__ import annotations

import hashlib
import json
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

import lodestream as ls

__all__ = ["FOLDER", "digest", "expectations", "originals"]

FOLDER = Path(__file__).parent


def _wave(rows: int, columns: int) -> NDArray[np.float64]:
    y, x = np.mgrid[:rows, :columns] / 8.0
    return np.asarray(np.sin(1.3 * x) * np.cos(0.7 * y) + 0.2 * np.sin(5 * x + 3 * y))


def _torus(rows: int, columns: int) -> NDArray[np.float64]:
    turns = [np.linspace(0, 2 * np.pi, n, endpoint=False) for n in (rows, columns)]
    v, u = np.meshgrid(*turns, indexing="ij")
    radius = 1 + 0.1 * np.sin(3 * u + 2 * v)
    ring = 3 + radius * np.cos(v)
    return np.stack([ring * np.cos(u), ring * np.sin(u), radius * np.sin(v)], axis=-1)


def originals() -> dict[str, tuple[ls.Surface, str | None]]:
    """Name -> surface and precision."""
    rng = np.random.default_rng(2002)
    wave = _wave(37, 54)
    rough = np.cumsum(np.cumsum(rng.normal(size=(33, 41)), 0), 1)
    attributes = np.concatenate([_torus(17, 20), rng.integers(0, 256, (17, 20, 2)).astype(np.float64)], axis=-1)
    hostile = np.array([[-0.0, 5e-324, 1.5], [1e30, -1e30, 2.0], [0.1, -7.0, np.pi]])
    tower = np.zeros((9, 9), np.float32)
    tower[4, 4] = 1
    return {
        "heights-int16": (
            ls.Surface(np.rint(20 * rough).astype(np.int16), metadata={"name": "rough", "unit": "m"}),
            None,
        ),
        "heights-uint8-even": (ls.Surface(rng.integers(0, 256, (16, 24)).astype(np.uint8)), None),
        "heights-int64-far": (ls.Surface(rng.integers(-(2**62), 2**62, (7, 6))), None),
        "heights-decimal": (ls.Surface(np.round(wave * 50, 1)), None),
        "heights-float32": (ls.Surface(wave.astype(np.float32)), None),
        "heights-float64-hostile": (ls.Surface(hostile), None),
        "heights-precision": (ls.Surface(_wave(90, 70)), "1e-4d"),
        "heights-constant": (ls.Surface(np.full((5, 8), 12.5)), None),
        "heights-tower": (ls.Surface(tower), None),
        "planar-open": (ls.Surface(_torus(13, 11)[..., :2].astype(np.float32)), None),
        "torus-odd": (ls.Surface(_torus(21, 33).astype(np.float32), (True, True)), None),
        "cylinder-even": (ls.Surface(_torus(24, 18), (True, False)), "1e-3d"),
        "attributes": (ls.Surface(attributes, (False, True)), None),
        "curve": (ls.Surface(_torus(1, 70)[0][:, None].astype(np.float32), (True, False)), None),
        "two-points": (ls.Surface(np.array([[1.0, 4.0]])), None),
        "several-tiles": (ls.Surface(np.rint(300 * _wave(330, 520)).astype(np.int32)), "2"),
    }


def digest(points: NDArray[Any]) -> str:
    """SHA-256 of an array's values, in C order and little-endian."""
    return hashlib.sha256(points.astype(points.dtype.newbyteorder("<")).tobytes()).hexdigest()


def expectations(container: bytes) -> dict[str, Any]:
    """What a container decodes to: shape, type, errors and values of each layer, and the grid of each level."""
    decoder = ls.Decoder()
    decoder.feed(container)
    decoder.finish()
    header = decoder.header
    assert header is not None
    return {
        "shape": list(decoder.surface().points.shape),
        "type": header.dtype.name,
        "closed": list(header.closed),
        "layers": [
            {
                "bytes": view.bytes,
                "level": view.level,
                "rms": view.rms,
                "max": view.max_error,
                "sha256": digest(view.points),
            }
            for view in decoder.layers
        ],
        "levels": [digest(decoder.points_at(level)) for level in range(header.levels + 1)],
    }


def main() -> None:
    """Write all files."""
    expected = {}
    for name, (surface, precision) in originals().items():
        container = ls.encode(surface, precision)
        (FOLDER / f"{name}.lode").write_bytes(container)
        expected[name] = expectations(container)
    (FOLDER / "expected.json").write_text(json.dumps(expected, indent=1) + "\n")


if __name__ == "__main__":
    main()
