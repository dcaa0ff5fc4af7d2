"""Triangle meshes that are resampled, beside the same meshes decimated and coded by Draco.

Distances are those between two surfaces, both ways, against the input mesh; the root mean square is the larger one.
"""

from __future__ import annotations

import importlib
from collections.abc import Iterator, Mapping
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

import lodestream as ls
from lodestream.mesh import weld

from ..arrays import ROOT
from .curves import bytes_at
from .tables import bold, table

__all__ = ["MESHES", "distance", "error_of", "measure", "page"]

FOLDER = ROOT.parent / "shared" / "data" / "meshes"
#: Scans, and a CAD model, for which Draco is the better choice.
MESHES = ("stanford-bunny.obj", "armadillo.obj", "fandisk.obj")
#: Errors of the table, in parts of the diagonal.
ERRORS = (2e-3, 1e-3, 5e-4, 3e-4)
#: Streams made for one error: in parts of the diagonal, of points, of which sliding along the surface is a part.
_RMS = (4e-3, 2e-3, 1.4e-3, 1e-3, 7e-4, 5e-4, 3.5e-4, 2.5e-4)
_BITS, _LEVEL = (7, 8, 9, 10, 11, 12, 13), 10
_KEPT = (1.0, 0.5, 0.25, 0.12, 0.06, 0.03, 0.015)
#: Times that a step between two of these is halved to find the fewest triangles for an error: to within 4 %.
_HALVINGS = 4
_SAMPLES = 50_000

Floats = NDArray[np.float64]
Integers = NDArray[np.int64]
Row = dict[str, Any]


def measure() -> dict[str, Any]:
    """Bytes and distances of all meshes that are there; empty if none is."""
    return {name: _measured(FOLDER / name) for name in MESHES if (FOLDER / name).exists()}


def _measured(path: Path) -> dict[str, Any]:
    igl = importlib.import_module("igl")
    vertices, faces = igl.read_triangle_mesh(str(path))[:2]
    points, triangles = np.asarray(vertices, np.float64)[:, :3], np.asarray(faces, np.int64)
    surface = ls.Surface.from_mesh(points, triangles, remesh=True, remesh_error=1e-4)
    report = surface.metadata["remesh"]
    rows: list[Row] = []
    for error in _RMS:
        container = ls.encode(surface, rms=error * report["diagonal"])
        decoded = ls.decode(container)
        rows.append({"setting": f"rms {error:g}", "bytes": len(container), "rms": error_of(points, triangles, decoded)})
        print(f"{path.name}: {rows[-1]}", flush=True)
    return {
        "vertices": len(points),
        "faces": len(triangles),
        "report": report,
        "each": rows,
        "stream": list(_layers(points, triangles, surface)),
        "draco": list(_draco(points, triangles)),
    }


def _layers(points: Floats, triangles: Integers, surface: ls.Surface) -> Iterator[Row]:
    """The layers of the one exact stream."""
    container = ls.encode(surface)
    reader = ls.Decoder()
    reader.feed(container)
    assert reader.index is not None
    for layer in reader.index.layers:
        prefix = ls.Decoder()
        prefix.feed(container[: layer.end])
        yield {"setting": "layer", "bytes": layer.end, "rms": error_of(points, triangles, prefix.surface())}


def error_of(points: Floats, triangles: Integers, surface: ls.Surface) -> float:
    """Root mean square distance of a surface from a mesh, see `distance`."""
    mesh = weld(surface)
    quads = np.asarray(mesh.quads, np.int64)
    places = np.concatenate([block.points.reshape(-1, 3) for block in surface.blocks])[mesh.source].astype(np.float64)
    halves = np.concatenate([quads[:, [0, 1, 2]], quads[:, [0, 2, 3]]])
    return distance(points, triangles, places, halves)


def _draco(points: Floats, triangles: Integers) -> Iterator[Row]:
    """Draco at all numbers of bits, of the mesh and of meshes with fewer triangles (quadric decimation).

    For each error and number of bits, the fewest triangles that reach it are looked for between those first tried.
    """
    simplification = importlib.import_module("fast_simplification")

    @cache
    def simplified(kept: float) -> tuple[Floats, Integers]:
        if kept == 1:
            return points, triangles
        fewer = simplification.simplify(
            points.astype(np.float32), triangles.astype(np.int32), target_reduction=1 - kept
        )
        return fewer[0], fewer[1]

    for bits in _BITS:
        rows = {kept: _coded(points, triangles, *simplified(kept), bits) for kept in _KEPT}
        for error in ERRORS:
            reached = [kept for kept, row in rows.items() if row["rms"] <= error]
            if not reached or min(reached) == min(_KEPT):
                continue
            high = min(reached)
            low = max(kept for kept in rows if kept < high)
            for _ in range(_HALVINGS):
                middle = float(np.sqrt(low * high))
                rows[middle] = _coded(points, triangles, *simplified(middle), bits)
                low, high = (low, middle) if rows[middle]["rms"] <= error else (middle, high)
        yield from rows.values()


def _coded(points: Floats, triangles: Integers, some: Floats, fewer: Integers, bits: int) -> Row:
    """A mesh coded by Draco with so many bits, and its distance from another."""
    draco = importlib.import_module("DracoPy")
    stream = draco.encode(
        some.astype(np.float32), fewer.astype(np.uint32), quantization_bits=bits, compression_level=_LEVEL
    )
    back = draco.decode(stream)
    there = np.asarray(back.points, np.float64).reshape(-1, 3), np.asarray(back.faces, np.int64).reshape(-1, 3)
    error = distance(points, triangles, *there)
    return {"setting": f"{len(fewer)} triangles, {bits} bits", "bytes": len(stream), "rms": error}


def distance(points: Floats, triangles: Integers, others: Floats, faces: Integers) -> float:
    """Root mean square distance between two meshes, the larger of both ways, in parts of the first one's diagonal.

    Parameters
    ----------
    points, others : float64 arrays of shape (V, 3)
    triangles, faces : int64 arrays of shape (F, 3)
    """
    igl = importlib.import_module("igl")
    there, _, _ = igl.point_mesh_squared_distance(_scattered(others, faces), points, triangles)
    back, _, _ = igl.point_mesh_squared_distance(_scattered(points, triangles), others, faces)
    return float(np.sqrt(max(there.mean(), back.mean())) / np.linalg.norm(np.ptp(points, axis=0)))


def _scattered(points: Floats, faces: Integers) -> Floats:
    """Points scattered over a mesh by area."""
    random = np.random.default_rng(0)
    a, b, c = (points[faces[:, corner]] for corner in range(3))
    areas = np.cumsum(np.linalg.norm(np.cross(b - a, c - a), axis=1))
    chosen = np.minimum(np.searchsorted(areas, random.random(_SAMPLES) * areas[-1]), len(areas) - 1)
    root, share = np.sqrt(random.random((_SAMPLES, 1))), random.random((_SAMPLES, 1))
    return np.asarray((1 - root) * a[chosen] + root * (1 - share) * b[chosen] + root * share * c[chosen])


def page(found: Mapping[str, Any]) -> Iterator[str]:
    """Lines of Markdown: what was made of each mesh, and bytes to each error."""
    head = ["mesh", "vertices", "blocks", "points", "RMS to", "RMS from", "largest", "folds"]
    rows = []
    for name, it in found.items():
        report = it["report"]
        unit = report["diagonal"]
        largest = max(report["largest_to_input"], report["largest_from_input"]) / unit
        rows.append(
            [
                name.removesuffix(".obj"),
                f"{it['vertices']:,}",
                f"{report['blocks']:,} of {int((report['quads'] / report['blocks']) ** 0.5) + 1}^2",
                f"{report['quads'] / it['vertices']:.1f} x",
                f"{report['rms_to_input'] / unit:.1e}",
                f"{report['rms_from_input'] / unit:.1e}",
                f"{largest:.1e}",
                f"{report['folds']:,} ({report['folds'] / report['quads']:.2%})",
            ]
        )
    yield from table(head, rows)
    yield ""
    head = ["mesh, RMS error", "Draco, decimated", "for this error", "ratio", "one exact stream", "ratio"]
    rows = []
    for name, it in found.items():
        for error in ERRORS:
            # A coder whose settings go in steps has the files that it makes. Those of ours go in none.
            draco = min((row["bytes"] for row in it["draco"] if row["rms"] <= error), default=None)
            each, stream = (bytes_at(it[key], "rms", error) for key in ("each", "stream"))
            rows.append(
                [
                    f"{name.removesuffix('.obj')}, {error:.0e}",
                    _bytes(draco),
                    _bytes(each),
                    _ratio(each, draco),
                    _bytes(stream),
                    _ratio(stream, draco),
                ]
            )
    yield from table(head, rows)


def _bytes(size: float | None) -> str:
    return "not reached" if size is None else f"{size:,.0f}"


def _ratio(size: float | None, peer: float | None) -> str:
    return "" if size is None or peer is None else bold(size / peer, 1.0)
