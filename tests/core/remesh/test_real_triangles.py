"""Real meshes, if they are there."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from lodestream.errors import FormatError
from lodestream.remesh.remeshing import remesh_triangles
from lodestream.remesh.samples import quads_of

igl = pytest.importorskip("igl")
MESHES = Path(__file__).parents[4] / "shared" / "data" / "meshes"
pytestmark = pytest.mark.skipif(not MESHES.is_dir(), reason="there is no shared/data/meshes")


def mesh_of(name: str) -> tuple[np.ndarray, np.ndarray]:
    vertices, faces = igl.read_triangle_mesh(str(MESHES / name))[:2]
    return np.asarray(vertices, np.float64)[:, :3], np.asarray(faces, np.int64)


@pytest.mark.parametrize(("name", "rms", "largest"), [("cow.obj", 6e-4, 1e-2), ("fertility.off", 6e-4, 1e-2)])
@pytest.mark.long
def test_thin_limbs_and_handles_are_covered(name: str, rms: float, largest: float) -> None:
    vertices, faces = mesh_of(name)
    result = remesh_triangles(vertices, faces, error=rms)
    quads = quads_of(result.grids.numbers)
    edges = np.sort(np.stack([quads, np.roll(quads, -1, axis=1)], axis=-1).reshape(-1, 2), axis=1)
    unique, count = np.unique(edges, axis=0, return_counts=True)
    assert (count == 2).all()
    assert result.grids.count - len(unique) + len(quads) == result.mesh.characteristic().sum()
    assert result.distances.rms <= rms
    assert result.distances.largest <= largest
    assert result.folds <= 0.005 * len(quads)


def test_an_edge_of_three_faces_is_refused() -> None:
    with pytest.raises(FormatError, match="got 1 edges with three or more"):
        remesh_triangles(*mesh_of("suzanne.obj"))
