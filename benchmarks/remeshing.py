"""Triangle meshes resampled into blocks: distances both ways, folds, processor time and peak memory."""

from __future__ import annotations

import json
import subprocess
import sys
import time
from collections.abc import Iterator
from dataclasses import asdict, dataclass

import numpy as np
from numpy.typing import NDArray

from lodestream.remesh.remeshing import remesh_triangles
from tests.core.remesh.scenes import isosurface

from .arrays import ROOT
from .measure import STATUS, Peak, gate, memory, note, table

FOLDER = ROOT.parent / "shared" / "data" / "meshes"
#: Triangles of generated meshes, and the most seconds and bytes that they may take.
GENERATED = {100_000: (15.0, 2e9), 1_000_000: (90.0, 2e9)}
#: Vertices of the real meshes that are taken, at least.
LARGE = 20_000
#: Points over vertices, about; quads along a side of the blocks that have so many; errors that are asked for; and the
#: greatest RMS and largest distance that are aimed at, in parts of the diagonal.
DENSITIES = ((1, 16, 3e-4, 3e-4, 6e-3), (4, 32, 1e-4, 1e-4, 4e-3))
#: Parts of quads that may be folded, and blocks of a closed mesh over those asked for.
FOLDS, BLOCKS = 0.005, 1.5


@dataclass(frozen=True)
class Resampled:
    """What became of a mesh. Distances are in parts of the diagonal."""

    vertices: int
    triangles: int
    closed: bool
    blocks: int
    side: int
    points: int
    rms: float
    largest: float
    folds: float
    seconds: float
    peak: int


def main() -> None:
    """Print the table."""
    if not STATUS.exists():
        print("\nskipped: remeshing (this system does not tell a process its peak)")
        return
    rows = [_row(*case) for case in _cases()]
    head = ["mesh", "triangles", "asked for", "blocks", "points", "RMS", "largest", "folds", "seconds", "peak"]
    table("Triangle meshes resampled", head, rows)
    note(
        "One pass in a process of its own, with one thread. Seconds of the processor, without reading the file. "
        "Distances in parts of the diagonal, the larger of both ways. The peak is that of the whole process. The torus "
        f"is generated, with bumps; the others are those of shared/data/meshes with {LARGE:,} vertices or more."
    )


def _cases() -> Iterator[tuple[str, int | None, float, float, float]]:
    """Yield meshes, blocks and errors to ask for, and aims."""
    for count in GENERATED:
        yield f"torus {count}", None, 2e-4, 2e-4, 6e-3
    for path in sorted([*FOLDER.glob("*.obj"), *FOLDER.glob("*.off")]):
        vertices = len(_mesh(path.name)[0])
        for density, intervals, error, rms, largest in DENSITIES if vertices >= LARGE else ():
            yield path.name, round(density * vertices / intervals**2), error, rms, largest


def _row(name: str, blocks: int | None, error: float, rms: float, largest: float) -> list[str]:
    command = [sys.executable, "-m", "benchmarks.remeshing", name, str(blocks or 0), str(error)]
    output = subprocess.run(command, check=True, capture_output=True, text=True, cwd=ROOT).stdout
    it = Resampled(**json.loads(output.splitlines()[-1]))
    asked = f"{error:g}" if blocks is None else f"{blocks} blocks, {error:g}"
    case = f"{name}, {asked}"
    gate(f"RMS: {case}", it.rms, at_most=rms)
    gate(f"largest distance: {case}", it.largest, at_most=largest)
    gate(f"folds: {case}", 100 * it.folds, at_most=100 * FOLDS, unit=" %")
    if it.closed:
        gate(f"blocks over those asked for: {case}", it.blocks / (blocks or 100), at_most=BLOCKS)
    if name.startswith("torus"):
        seconds, most = GENERATED[int(name.split()[1])]
        gate(f"seconds: {case}", it.seconds, at_most=seconds)
        gate(f"peak: {case}", it.peak / 1e9, at_most=most / 1e9, unit=" GB")
    return [
        name.split(".")[0].split()[0],
        f"{it.triangles:,}",
        asked,
        f"{it.blocks} of {it.side}^2",
        f"{it.points / it.vertices:.2f} x",
        f"{it.rms:.1e}",
        f"{it.largest:.1e}",
        f"{it.folds:.2%}",
        f"{it.seconds:.1f}",
        memory(it.peak),
    ]


def _mesh(name: str) -> tuple[NDArray[np.float64], NDArray[np.int64]]:
    if name.startswith("torus"):
        return torus(int(name.split()[1]))
    import igl

    vertices, faces = igl.read_triangle_mesh(str(FOLDER / name))[:2]
    return np.asarray(vertices, np.float64)[:, :3], np.asarray(faces, np.int64)


def torus(count: int) -> tuple[NDArray[np.float64], NDArray[np.int64]]:
    """A torus with bumps, by marching tetrahedra: vertices, and about so many triangles."""
    size = np.array([3.2, 3.2, 1.4])
    counts = (size * np.sqrt(count) * 0.084).astype(np.int64) + np.array([1, 2, 1])
    axes = [np.linspace(-side / 2, side / 2, steps) for side, steps in zip(size, counts, strict=True)]
    x, y, z = np.meshgrid(*axes, indexing="ij")
    bumps = 0.03 * np.sin(9 * x + 1) * np.sin(11 * y) * np.sin(13 * z + 0.5)
    values = (np.hypot(x, y) - 1) ** 2 + z**2 - 0.16 + bumps + 1e-7
    return isosurface(values, np.array([axis[1] - axis[0] for axis in axes]))


def resample(name: str, blocks: int | None, error: float) -> Resampled:
    """Resample a mesh, and say what became of it."""
    vertices, faces = _mesh(name)
    peak = Peak()
    peak.forget()
    start = time.process_time()
    result = remesh_triangles(vertices, faces, blocks, error)
    seconds = time.process_time() - start
    quads = len(result.grids.numbers) * result.grids.intervals**2
    return Resampled(
        vertices=len(vertices),
        triangles=len(faces),
        closed=not bool(result.mesh.border.any()),
        blocks=len(result.grids.numbers),
        side=result.grids.intervals + 1,
        points=result.grids.count,
        rms=result.distances.rms,
        largest=result.distances.largest,
        folds=result.folds / quads,
        seconds=seconds,
        peak=(peak.base or 0) + (peak.above() or 0),
    )


if __name__ == "__main__":
    print(json.dumps(asdict(resample(sys.argv[1], int(sys.argv[2]) or None, float(sys.argv[3])))))
