"""Curvilinear files pushed to a real server and pulled as files that other libraries read."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from lodestream import formats
from lodestream.surface import Surface

from .conftest import Run

DATA = Path(__file__).parents[3] / "shared" / "data"

#: Files, options, the suffix to pull as, and whether that format warns of what it cannot hold.
CASES = [
    (("combxyz.bin", "combq.bin"), {"plane": "k-1"}, "vts", True),
    (("multi-bin-2D.xyz",), {}, "ply", False),
    (("StructuredGrid.vts",), {"plane": "k0"}, "obj", True),
    (("office.binary.vtk",), {"plane": "j3"}, "glb", False),
    (("corner.cgns",), {}, "ply", False),
    (("bun000.ply",), {}, "vts", False),
]


def vertices(path: Path) -> NDArray[Any]:
    """Vertices that are no holes, as another library reads them."""
    if path.suffix != ".vts":
        trimesh = pytest.importorskip("trimesh")
        return np.asarray(trimesh.load(path, process=False, force="mesh").vertices)
    pytest.importorskip("vtkmodules")
    from vtkmodules.util.numpy_support import vtk_to_numpy
    from vtkmodules.vtkIOXML import vtkXMLStructuredGridReader

    reader = vtkXMLStructuredGridReader()
    reader.SetFileName(str(path))
    reader.Update()
    grid = reader.GetOutput()
    points: NDArray[Any] = vtk_to_numpy(grid.GetPoints().GetData())
    ghosts = grid.GetPointData().GetArray("vtkGhostType")
    return points if ghosts is None else points[vtk_to_numpy(ghosts) == 0]


def valid_places(surface: Surface) -> NDArray[np.float32]:
    places = []
    for block in surface.blocks:
        points = block.points.reshape(-1, block.points.shape[2])
        places.append(points if block.mask is None else points[block.mask.reshape(-1)])
    points = np.concatenate(places)
    if points.shape[1] == 2:
        points = np.concatenate([points, np.zeros((len(points), 1))], axis=1)
    return unique(points)


def unique(points: NDArray[Any]) -> NDArray[np.float32]:
    """Each place once, as glTF has them."""
    rounded = np.ascontiguousarray(points.astype(np.float32) + np.float32(0))
    return np.unique(rounded, axis=0)


@pytest.mark.parametrize(("files", "options", "suffix", "warns"), CASES, ids=[case[0][0] for case in CASES])
@pytest.mark.long
def test_a_curvilinear_file_goes_through_a_server(
    server: str, run: Run, tmp_path: Path, files: tuple[str, ...], options: dict[str, str], suffix: str, warns: bool
) -> None:
    paths = [DATA / name for name in files]
    for path in paths:
        if not path.exists():
            pytest.skip(f"the real file {path.name} is not beside this project")
    if paths[0].suffix in (".vts", ".vtk", ".cgns"):
        pytest.importorskip("vtkmodules")
    given = [word for key, value in options.items() for word in ("-o", f"{key}={value}")]
    code, output, errors = run("push", *paths, server, *given)
    assert code == 0, errors
    url = output.splitlines()[-1]
    out = tmp_path / f"out.{suffix}"
    code, _, errors = run("pull", url, out)
    assert code == 0, errors
    assert ("is written with" in errors) == warns
    surface = formats.read(*paths, **options)  # type: ignore[arg-type]
    expected, found = valid_places(surface), unique(vertices(out))
    if suffix == "glb" and warns:  # rounded to float32 from the middle of the box, and moved back
        assert len(vertices(out)) >= len(expected)
        np.testing.assert_allclose(np.sort(found, axis=0)[[0, -1]], np.sort(expected, axis=0)[[0, -1]], atol=1e-6)
    else:
        np.testing.assert_array_equal(found, expected)
