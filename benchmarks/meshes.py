"""Time and memory to recognise meshes of a million quads, and to read them from files, in a shuffled order."""

from __future__ import annotations

import io
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from .arrays import ROOT
from .measure import memory, note, table

SIDE = 1000
STATUS = Path("/proc/self/status")
SMALL = 12


def main() -> None:
    """Print the table."""
    if not STATUS.exists():
        print("\nskipped: meshes (this system does not tell a process its peak)")
        return
    rows = []
    for name in MESHES:
        command = [sys.executable, "-m", "benchmarks.meshes", name]
        output = subprocess.run(command, check=True, capture_output=True, text=True, cwd=ROOT).stdout
        words, *figures = output.splitlines()
        seconds, peak, reading, reading_peak = figures
        rows.append([name, words, seconds, memory(int(peak)), reading, memory(int(reading_peak))])
    head = ["mesh", "recognised", "seconds", "peak", "seconds from OBJ", "peak from OBJ"]
    table("Recognition of meshes", head, rows)
    note(
        "A million quads, or the triangles they are split into, in random order, over vertices in random order; half "
        "of the faces have the opposite winding. Each mesh in a separate process with compiled kernels. The peak is "
        "that of the whole process, with the libraries and the mesh. From OBJ: reading the file, recognition, and "
        "making the surface. Processor times."
    )


def _quads(side: int, closed: bool) -> NDArray[np.int64]:
    last = side if closed else side - 1
    r, c = np.arange(last)[:, None], np.arange(last)[None, :]
    below, right = (r + 1) % side, (c + 1) % side
    corners = (r * side + c, r * side + right, below * side + right, below * side + c)
    return np.stack(np.broadcast_arrays(*corners), axis=-1).reshape(-1, 4)


def _halves(quads: NDArray[np.int64]) -> NDArray[np.int64]:
    return quads[:, [[0, 1, 2], [0, 2, 3]]].reshape(-1, 3)


def _cube(side: int) -> NDArray[np.int64]:
    """Quads of the surface of a cube, six patches of which meet at vertices of three."""
    patch = int(np.sqrt(side * side / 6))
    places = []
    for axis in range(3):
        for level in (0, patch):
            i, j = (index.reshape(-1) for index in np.indices((patch, patch)))
            corners = [(i, j), (i + 1, j), (i + 1, j + 1), (i, j + 1)]
            place = [np.insert(np.stack(corner, axis=-1), axis, level, axis=1) for corner in corners]
            places.append(np.stack(place, axis=1))
    every = np.concatenate(places).reshape(-1, 3)
    numbers = every @ np.array([(patch + 1) ** 2, patch + 1, 1])
    _, inverse = np.unique(numbers, return_inverse=True)
    return inverse.reshape(-1, 4)


MESHES: dict[str, Callable[[int], NDArray[np.int64]]] = {
    "open grid": lambda side: _quads(side + 1, False),
    "torus": lambda side: _quads(side, True),
    "torus, triangles": lambda side: _halves(_quads(side, True)),
    "cube": _cube,
}


def shuffled(faces: NDArray[np.int64]) -> tuple[NDArray[np.float64], NDArray[np.int64]]:
    """Vertices at random places, and the faces over them in another order and another sense."""
    rng = np.random.default_rng(0)
    vertices = int(faces.max()) + 1
    faces = rng.permutation(vertices)[faces][rng.permutation(len(faces))]
    faces = np.where(rng.random(len(faces))[:, None] < 0.5, faces, faces[:, ::-1])
    return rng.random((vertices, 3)), faces


def recognise(name: str) -> None:
    """Print what is recognised, seconds and peak of it, and seconds and peak of reading it; in a process of its own."""
    import lodestream
    from lodestream.mesh import Mesh
    from lodestream.mesh.recognise import recognise

    points, faces = shuffled(MESHES[name](SMALL))
    recognise(Mesh.of(points, faces))  # loads the kernels
    points, faces = shuffled(MESHES[name](SIDE))
    mesh = Mesh.of(points, faces)
    start = time.process_time()
    surface = recognise(mesh).surface()
    seconds = time.process_time() - start
    print(surface.metadata["recognised"].split(";")[0])
    print(f"{seconds:.1f}\n{_peak()}")
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "mesh.obj"
        path.write_bytes(_obj(points, faces))
        del points, faces, mesh, surface
        _forget_peak()
        start = time.process_time()
        lodestream.read(path)
        print(f"{time.process_time() - start:.1f}\n{_peak()}")


def _obj(points: NDArray[np.float64], faces: NDArray[np.int64]) -> bytes:
    file = io.BytesIO()
    np.savetxt(file, points, "v %.9g %.9g %.9g")
    np.savetxt(file, faces + 1, "f " + " ".join(["%d"] * faces.shape[1]))
    return file.getvalue()


def _forget_peak() -> None:
    Path("/proc/self/clear_refs").write_text("5")


def _peak() -> int:
    line = next(line for line in STATUS.read_text().splitlines() if line.startswith("VmHWM"))
    return 1024 * int(line.split()[1])


if __name__ == "__main__":
    recognise(sys.argv[1])
