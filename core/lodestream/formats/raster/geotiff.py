"""Write GeoTIFF: bands of numbers with a place, a mask and a CRS, by GDAL's GTiff driver."""

from __future__ import annotations

import errno
import os
import shutil
import warnings
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np
from numpy.typing import NDArray

from ...parallel import threads
from ...surface import Surface
from ..beside import folder_beside
from ..holes import occurs
from ..notes import listing, metadata_left_out, survives, warn, warn_left_out, with_nul_shown
from . import gdal
from .tags import describe, missing
from .writing_heights import even_heights, geotransform, warn_off

__all__ = ["write", "write_tiff"]

_TITLE = "GeoTIFF"

#: Metadata that a GeoTIFF holds.
_HELD = (
    *("geotransform", "grid", "axes", "crs", "unit", "scale", "offset"),
    *("area_or_point", "description", "tags", "bands"),
)

#: Sides of the tiles of an image that is at least so large.
_TILE = 256
#: Values that are written at a time, about.
_AT_ONCE = 1 << 22
#: float64 has all integers up to here.
_EXACT = 1 << 53
#: A disk with fewer bytes is full.
_FULL = 1 << 20


def write(surface: Surface, file: BinaryIO) -> None:
    """Write heights as band 1 and attributes as further bands, with holes, place, CRS, unit, scale and tags.

    Holes get the value of ``nodata`` in the metadata where their type can hold it and no height has it, else NaN; in
    integers without such a value a mask inside the file says where they are.
    """
    write_tiff(surface, file, lambda path, predictor: path)


def write_tiff(surface: Surface, file: BinaryIO, finish: Callable[[Path, int], Path]) -> None:
    """Write a GeoTIFF, and copy a file made from it to `file`.

    Parameters
    ----------
    surface : Surface
    file : binary file
        Only its ``write`` is used.
    finish : callable
        Takes the path of the GeoTIFF, alone in its folder, and TIFF's predictor for its values; returns the path of
        the file to hand over.

    Raises
    ------
    UnavailableError
        If rasterio is not installed.
    FormatError
        If a GeoTIFF cannot hold the surface.
    OSError
        If the file cannot be written, as on a full disk.
    """
    rasterio = gdal.require_rasterio(_TITLE)
    surface = with_nul_shown(_TITLE, even_heights(surface, _TITLE))
    if any(surface.closed):
        warn("GeoTIFF cannot express closed axes")
    warn_left_out(_TITLE, metadata_left_out(surface, _HELD))
    names, bands, dtype = _bands(surface)
    nodata = _nodata(surface, bands, dtype)
    profile = _profile(surface, len(bands), dtype, nodata)
    with folder_beside(file) as folder, _told(folder), warnings.catch_warnings():
        warnings.simplefilter("ignore", rasterio.errors.NotGeoreferencedWarning)
        path = folder / "data.tif"
        with (
            rasterio.Env(GDAL_TIFF_INTERNAL_MASK=True, GDAL_PAM_ENABLED="NO"),
            rasterio.open(path, "w", **profile) as dataset,
        ):
            crs = _locate(dataset, surface)
            describe(dataset, surface.metadata, names, bands, surface.mask)
            for number, band in enumerate(bands, 1):
                for rows in _strips(band.shape):
                    window = (rows.start, rows.stop), (0, band.shape[1])
                    values = band[rows].astype(dtype, copy=False)
                    values = _shown(surface, values, rows, nodata) if number == 1 else values
                    dataset.write(values, number, window=window)
            if surface.mask is not None and nodata is None:
                for rows in _strips(surface.shape):
                    dataset.write_mask(surface.mask[rows], window=((rows.start, rows.stop), (0, surface.shape[1])))
        path = finish(path, profile["predictor"])
        with rasterio.Env(**gdal.ALONE), rasterio.open(path, driver="GTiff") as dataset:
            lost = missing(dataset, surface.metadata, names)
            same = crs is None or dataset.crs == crs
            spelled = not same and dataset.crs is not None and dataset.crs.to_dict() == crs.to_dict()
            lost += ["a part of the CRS"] * (not same and not spelled)
            _check(dataset, surface, bands, dtype, nodata)
        with path.open("rb") as written:
            shutil.copyfileobj(written, file)
    warn_left_out(_TITLE, lost, "which GDAL does not write")
    if spelled:
        warn(f"{_TITLE} has the CRS as GDAL spells it, with other names or axes, and the same parameters")


@contextmanager
def _told(folder: Path) -> Iterator[None]:
    """Raise errors of the disk in place of GDAL's vague errors.

    Raises
    ------
    OSError
        In place of any of them.
    """
    from rasterio._err import CPLE_BaseError
    from rasterio.errors import RasterioError

    try:
        yield
    except (CPLE_BaseError, RasterioError) as error:
        if shutil.disk_usage(folder).free < _FULL:
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC)) from None
        reason = " ".join(str(error).replace(f"{folder}{os.sep}", "").split())
        raise OSError(errno.EIO, f"GDAL has not written the whole file: {reason[:120]}") from None


def _check(
    dataset: Any, surface: Surface, bands: Sequence[NDArray[Any]], dtype: np.dtype[Any], nodata: float | None
) -> None:
    """Compare the written file with the surface.

    Errors of GDAL's writing threads, such as a full disk, are not reported.

    Raises
    ------
    OSError, RasterioError
        If it is not there.
    """
    from rasterio.errors import RasterioIOError

    mask = surface.mask if nodata is None else None
    for rows in _strips(surface.shape):
        window = (rows.start, rows.stop), (0, surface.shape[1])
        for number, band in enumerate(bands, 1):
            written = band[rows].astype(dtype, copy=False)
            written = _shown(surface, written, rows, nodata) if number == 1 else written
            stored = dataset.read(number, window=window)
            if not np.array_equal(stored, written, equal_nan=stored.dtype.kind == "f"):
                raise RasterioIOError(f"other values in rows {rows.start} to {rows.stop - 1}")
        if mask is not None and not np.array_equal(dataset.read_masks(1, window=window) > 0, mask[rows]):
            raise RasterioIOError(f"another mask in rows {rows.start} to {rows.stop - 1}")


def _strips(shape: tuple[int, ...]) -> Iterator[slice]:
    """Yield slices of all rows, some rows of tiles at a time: a surface may be larger than memory."""
    n_rows = max(_TILE, _AT_ONCE // shape[1] // _TILE * _TILE)
    return (slice(start, min(start + n_rows, shape[0])) for start in range(0, shape[0], n_rows))


def _shown(surface: Surface, heights: NDArray[Any], rows: slice, nodata: float | None) -> NDArray[Any]:
    """Return some rows of the heights, in the type of all bands, with the nodata value in holes."""
    if surface.mask is None:
        return heights
    kept = surface.blocks[0].kept
    valued = surface.mask[rows] if kept is None else surface.mask[rows] | kept[rows]
    return np.where(valued, heights, heights.dtype.type(0 if nodata is None else nodata))


def _profile(surface: Surface, count: int, dtype: np.dtype[Any], nodata: float | None) -> dict[str, Any]:
    """Return the profile with which rasterio makes the file."""
    rows, columns = surface.shape
    profile: dict[str, Any] = {
        "driver": "GTiff",
        "height": rows,
        "width": columns,
        "count": count,
        "dtype": dtype,
        "nodata": nodata,
        "compress": "deflate",
        "predictor": 3 if dtype.kind == "f" else 2 if dtype.itemsize < 8 else 1,  # libtiff before 4.4
        "bigtiff": "if_safer",
        "num_threads": str(threads()),
        "photometric": "minisblack",  # or GDAL takes bands of bytes for colours, and the fourth for what is transparent
    }
    if min(rows, columns) >= _TILE:
        profile |= {"tiled": True, "blockxsize": _TILE, "blockysize": _TILE}
    return profile


def _bands(surface: Surface) -> tuple[list[str], list[NDArray[Any]], np.dtype[Any]]:
    """Return the names and values of all bands, and their common type in a TIFF."""
    names, bands = [""], [surface.points]
    for name, values in surface.attributes.items():
        parts = values.reshape(*surface.shape, -1)
        count = parts.shape[2]
        names += [name if count == 1 else f"{name}_{part}" for part in range(count)]
        bands += [parts[..., part] for part in range(count)]
    common = np.result_type(*bands)
    for name, band in zip(names, bands, strict=True):
        if not all(survives(band[rows], common) for rows in _strips(band.shape)):
            warn(f"GeoTIFF has one type for all bands: {name or 'heights'} are rounded to {common}")
    return names, bands, common


def _nodata(surface: Surface, bands: Sequence[NDArray[Any]], dtype: np.dtype[Any]) -> float | None:
    """Return the nodata value in the type of all bands, which GDAL has for each of them; None if there is none."""
    value = _number(surface.metadata.get("nodata"))
    if value is not None and _holds(dtype, value) and not _occurs(surface, bands, dtype.type(value)):
        return value
    return float("nan") if surface.mask is not None and dtype.kind == "f" else None


def _occurs(surface: Surface, bands: Sequence[NDArray[Any]], value: Any) -> bool:
    """Return whether a valid height, or a value of another band there, is this value."""
    return any(occurs(value, band.__getitem__, surface.shape, surface.mask) for band in bands)


def _holds(dtype: np.dtype[Any], value: float) -> bool:
    """Return whether a type has a value, which GDAL takes as a float64; larger integers would be rounded."""
    if dtype.kind == "f":
        return bool(np.isnan(value) or abs(value) <= float(np.finfo(dtype).max))
    limits = np.iinfo(dtype)
    return value == np.rint(value) and max(limits.min, -_EXACT) <= value <= min(limits.max, _EXACT)


def _number(text: Any) -> float | None:
    """Return a number of the metadata, which may be text; None if there is none."""
    try:
        return float(text) if isinstance(text, int | float | str) else None
    except (ValueError, OverflowError):
        return None


def _locate(dataset: Any, surface: Surface) -> Any:
    """Write the place and the CRS; return the CRS, None if there is none."""
    from rasterio.crs import CRS
    from rasterio.errors import CRSError
    from rasterio.transform import Affine

    transform = geotransform(surface)
    if transform is not None:
        dataset.transform = Affine.from_gdal(*transform)
        warn_off(surface, transform, _TITLE)
    if surface.metadata.get("crs"):
        try:
            dataset.crs = CRS.from_wkt(str(surface.metadata["crs"]))
        except CRSError as error:
            warn(f"the CRS is left out, which GDAL does not know: {listing([error])}")
    return dataset.crs
