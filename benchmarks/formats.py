"""Readers and writers on a million vertices, in megabytes of arrays a second, beside the bare library's read."""

from __future__ import annotations

import io
import tempfile
import warnings
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

import lodestream as ls
from lodestream import formats

from .arrays import fractal
from .measure import medians, note, table

SIDE = 1000

Array = NDArray[Any]


@dataclass(frozen=True)
class Case:
    """A format that is read.

    Attributes
    ----------
    file : str
        Name of the file.
    make : callable
        Writes the file at a path.
    bare : callable
        Reads its values with the library alone, as one would by hand; None where there is none.
    library : str
    options : dict
    """

    file: str
    make: Callable[[Path], Any]
    bare: Callable[[Path], Any] | None
    library: str
    options: dict[str, Any]


def heights() -> Array:
    """Whole metres on 1000 x 1000 points."""
    return (fractal(1025)[:SIDE, :SIDE] // 16).astype(np.int16)


def _tiff(path: Path) -> None:
    import rasterio

    crs = rasterio.crs.CRS.from_epsg(26711).to_wkt()
    ls.write(ls.Surface(heights(), metadata={"geotransform": [500000.0, 30.0, 0.0, 4e6, 0.0, -30.0], "crs": crs}), path)


def _rasterio(driver: str, path: Path) -> Array:
    import rasterio

    with warnings.catch_warnings():
        warnings.simplefilter("ignore", rasterio.errors.NotGeoreferencedWarning)
        with rasterio.open(path, driver=driver) as dataset:
            values: Array = dataset.read(1)
    return values


def _copied(driver: str, path: Path) -> None:
    import rasterio.shutil

    _tiff(path.with_suffix(".tif"))
    rasterio.shutil.copy(path.with_suffix(".tif"), path, driver=driver)


def _ascii(path: Path) -> None:
    header = f"ncols {SIDE}\nnrows {SIDE}\nxllcorner 0\nyllcorner 0\ncellsize 30"
    np.savetxt(path, heights(), fmt="%d", header=header, comments="")


def _npz(path: Path) -> Array:
    with np.load(path) as arrays:
        values: Array = arrays["z"]
    return values


def _png(path: Path) -> None:
    ls.write(ls.Surface(heights().astype(np.uint16)), path)


def _pillow(path: Path) -> Array:
    from PIL import Image

    with Image.open(path) as image:
        return np.asarray(image)


def _netcdf(engine: Any, path: Path) -> None:
    import xarray

    axes = {"y": 4e6 - 30.0 * np.arange(SIDE), "x": 5e5 + 30.0 * np.arange(SIDE)}
    dataset = xarray.Dataset({"z": (("y", "x"), heights().astype(np.float32))}, axes)
    encoding: Any = {"z": {"zlib": True}} if engine == "h5netcdf" else None
    dataset.to_netcdf(path, engine=engine, encoding=encoding)


def _xarray(engine: str, path: Path) -> Array:
    import xarray

    with xarray.open_dataset(path, engine=engine) as dataset:
        values: Array = dataset["z"].values
    return values


CASES = [
    Case("a.npy", lambda path: np.save(path, heights()), np.load, "numpy", {}),
    Case("a.npz", lambda path: np.savez_compressed(path, z=heights()), _npz, "numpy", {}),
    Case("a.tif", _tiff, partial(_rasterio, "GTiff"), "rasterio", {}),
    Case("a.png", _png, _pillow, "Pillow", {}),
    Case("classic.nc", partial(_netcdf, "scipy"), partial(_xarray, "scipy"), "xarray, scipy", {}),
    Case("deflated.nc", partial(_netcdf, "h5netcdf"), partial(_xarray, "h5netcdf"), "xarray, h5netcdf", {}),
    Case("a.asc", _ascii, partial(_rasterio, "AAIGrid"), "rasterio", {}),
    Case("a.dem", partial(_copied, "USGSDEM"), partial(_rasterio, "USGSDEM"), "rasterio", {}),
    Case("a.txt", lambda path: np.savetxt(path, heights(), fmt="%d"), partial(np.loadtxt, ndmin=2), "numpy", {}),
]


def main() -> None:
    """Print a table for reading and one for writing."""
    with tempfile.TemporaryDirectory() as folder, warnings.catch_warnings():
        warnings.simplefilter("ignore")
        _read(Path(folder))
    _write()


def _read(folder: Path) -> None:
    rows = []
    for case in CASES:
        path = folder / case.file
        case.make(path)
        surface = formats.read(path, **case.options)
        size = sum(array.nbytes for block in surface.blocks for array in (block.points, *block.attributes.values()))
        work: dict[str, Callable[[], object]] = {"ours": partial(formats.read, path, **case.options)}
        if case.bare is not None:
            work["bare"] = partial(case.bare, path)
        seconds = medians(work, 3)
        rates = [f"{size / seconds[name] / 1e6:.0f}" if name in seconds else "" for name in ("ours", "bare")]
        ratio = f"{seconds['ours'] / seconds['bare']:.2f}" if "bare" in seconds else ""
        vertices = sum(block.points.shape[0] * block.points.shape[1] for block in surface.blocks)
        rows.append([case.file, case.library, f"{vertices:,}", str(surface.dtype), *rates, ratio])
    head = ["file", "library", "vertices", "type", "MB/s", "MB/s of the library alone", "times its time"]
    table("Reading files of a million vertices", head, rows)
    note("MB are those of the arrays in memory. Lodestream reads an .asc as float64, GDAL alone as float32 or int32.")


def _write() -> None:
    surface = ls.Surface(heights().astype(np.uint16))
    names = [format_.name for format_ in formats.formats() if format_.write]
    work: dict[str, Callable[[], object]] = {
        name: partial(formats.write_stream, surface, name, io.BytesIO()) for name in names
    }
    seconds = medians(work, 3)
    rows = [[name, f"{surface.points.nbytes / seconds[name] / 1e6:.1f}", f"{seconds[name]:.2f}"] for name in names]
    table(f"Writing {SIDE} x {SIDE} heights of uint16", ["format", "MB/s", "seconds"], rows)
