"""Small files of every format that is read, for the commands of docs/formats.md."""

from __future__ import annotations

import shutil
import warnings
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

import lodestream as ls
from lodestream import formats

__all__ = ["make"]

DATA = Path(__file__).parents[3] / "shared" / "data"


def hills(shape: tuple[int, int] = (15, 20)) -> NDArray[np.int16]:
    rows, columns = np.indices(shape)
    heights: NDArray[np.int16] = (100 + 40 * np.sin(rows / 4) + 30 * np.cos(columns / 3)).astype(np.int16)
    return heights


def torus(rows: int = 12, columns: int = 16) -> ls.Surface:
    u, v = (np.arange(n) * 2 * np.pi / n for n in (rows, columns))
    ring = 3 + np.cos(u)[:, None]
    height = np.broadcast_to(np.sin(u)[:, None], (rows, columns))
    return ls.Surface(np.stack([ring * np.cos(v), ring * np.sin(v), height], axis=2), (True, True))


def make(path: Path) -> None:
    """Write the sample of this name, or skip the test where its library or file is not there."""
    if path.name == "hill.lode":
        pytest.importorskip("rasterio")
        path.write_bytes(ls.encode(ls.Surface(hills(), metadata={"geotransform": [500000, 30, 0, 4000000, 0, -30]})))
    elif path.suffix == ".lode":
        path.write_bytes(ls.encode(torus()))
    else:
        _MAKERS[path.name](path)


def _npz(path: Path) -> None:
    np.savez(path, height=hills(), east=np.arange(20) * 30.0, north=np.arange(15) * -30.0, other=np.ones((15, 20)))


def _tiff(path: Path) -> None:
    pytest.importorskip("rasterio")
    ls.write(ls.Surface(hills(), metadata={"geotransform": [500000, 30, 0, 4000000, 0, -30]}), path)


def _dem(path: Path) -> None:
    rasterio, copies = pytest.importorskip("rasterio"), pytest.importorskip("rasterio.shutil")
    wkt = rasterio.crs.CRS.from_epsg(26711).to_wkt()
    whole = ls.Surface(hills(), metadata={"geotransform": [500000, 30, 0, 4000000, 0, -30], "crs": wkt})
    ls.write(whole, path.with_suffix(".tif"))
    copies.copy(path.with_suffix(".tif"), path, driver="USGSDEM")


def _netcdf(path: Path) -> None:
    xarray = pytest.importorskip("xarray")
    pytest.importorskip("scipy")
    depth = np.stack([hills(), hills() + 5]).astype(np.float32)
    months = xarray.Variable("time", [0.0, 31.0], {"units": "days since 2001-01-01"})
    dataset = xarray.Dataset({"depth": (("time", "y", "x"), depth), "time": months})
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        dataset.to_netcdf(path, engine="scipy")


def _zarr(path: Path) -> None:
    pytest.importorskip("zarr")
    xarray = pytest.importorskip("xarray")
    pytest.importorskip("scipy")
    _netcdf(path.with_suffix(".nc"))
    with xarray.open_dataset(path.with_suffix(".nc"), engine="scipy") as dataset:
        dataset.to_zarr(path, zarr_format=2)


def _png(path: Path) -> None:
    pytest.importorskip("PIL")
    from PIL import Image

    code = (hills().astype(np.int64) + 10000) * 10
    Image.fromarray(np.dstack([code >> 16, code >> 8 & 255, code & 255]).astype(np.uint8)).save(path)


def _ascii(path: Path) -> None:
    pytest.importorskip("rasterio")
    header = "ncols 20\nnrows 15\nxllcorner 500000\nyllcorner 4000000\ncellsize 30\nNODATA_value -9999"
    np.savetxt(path, hills(), fmt="%d", header=header, comments="")


def _hgt(path: Path) -> None:
    pytest.importorskip("rasterio")
    hills((1201, 1201)).astype(">i2").tofile(path)


def _trimesh(path: Path) -> None:
    trimesh = pytest.importorskip("trimesh")
    mesh: Any = torus().to_trimesh()
    assert isinstance(mesh, trimesh.Trimesh)
    mesh.export(path)


def _off(path: Path) -> None:
    points = torus().points.reshape(-1, 3)
    r, c = np.indices((12, 16)).reshape(2, -1)
    corners = [(r % 12) * 16 + c % 16 for r, c in ((r, c), (r, c + 1), (r + 1, c + 1), (r + 1, c))]
    lines = ["OFF", f"{len(points)} {len(r)} 0"]
    lines += [" ".join(map(repr, point)) for point in points.tolist()]
    lines += [f"4 {' '.join(map(str, face))}" for face in np.stack(corners, axis=1).tolist()]
    path.write_text("\n".join(lines) + "\n")


def _pcd(path: Path) -> None:
    rows, columns = np.indices((15, 20))
    points = np.stack((columns, rows, hills()), axis=-1).reshape(-1, 3)
    header = (
        "VERSION 0.7\nFIELDS x y z\nSIZE 4 4 4\nTYPE F F F\nCOUNT 1 1 1\nWIDTH 20\nHEIGHT 15\n"
        "VIEWPOINT 0 0 0 1 0 0 0\nPOINTS 300\nDATA ascii"
    )
    np.savetxt(path, points, fmt="%g", header=header, comments="")


def _vtk(path: Path) -> None:
    pytest.importorskip("vtkmodules")
    points = np.stack(np.meshgrid(np.arange(3.0), np.arange(5.0), np.arange(4.0), indexing="ij"), axis=-1)
    header = "# vtk DataFile Version 3.0\nbox\nASCII\nDATASET STRUCTURED_GRID\nDIMENSIONS 4 5 3\nPOINTS 60 float"
    np.savetxt(path, points[..., ::-1].reshape(-1, 3), fmt="%g", header=header, comments="")


def _vts(path: Path) -> None:
    pytest.importorskip("vtkmodules")
    ls.write(torus(), path)


def _cgns(path: Path) -> None:
    pytest.importorskip("vtkmodules")
    if not (DATA / path.name).exists():
        pytest.skip(f"the real file {path.name} is not beside this project")
    shutil.copy(DATA / path.name, path)


def _plot3d(path: Path) -> None:
    x, y = np.meshgrid(np.arange(9.0), np.arange(6.0))
    blocks = [np.stack((x + 9 * number, y, x * y)) for number in range(2)]
    numbers = "\n".join(" ".join(map(repr, block.ravel().tolist())) for block in blocks)
    path.write_text(f"2\n9 6 1 9 6 1\n{numbers}\n")


_MAKERS: dict[str, Callable[[Path], Any]] = {
    "hill.npy": lambda path: np.save(path, hills()),
    "hill.npz": _npz,
    "hill.tif": _tiff,
    "hill.dem": _dem,
    "sea.nc": _netcdf,
    "sea.zarr": _zarr,
    "fuji.png": _png,
    "hill.asc": _ascii,
    "N37W122.hgt": _hgt,
    "torus.obj": lambda path: formats.write(torus(), path),
    "torus.off": _off,
    "torus.stl": _trimesh,
    "torus.glb": _trimesh,
    "torus.vts": _vts,
    "scan.pcd": _pcd,
    "box.vtk": _vtk,
    "plate_surf.cgns": _cgns,
    "wing.fmt": _plot3d,
    "X.dat": lambda path: np.savetxt(path, torus().points[..., 0]),
    "Y.dat": lambda path: np.savetxt(path, torus().points[..., 1]),
    "Z.dat": lambda path: np.savetxt(path, torus().points[..., 2]),
}
