"""GeoTIFF: bands of numbers with a place, a mask and a CRS, read and written by GDAL's GTiff driver."""

from __future__ import annotations

import shutil
import tempfile
import warnings
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np
from numpy.typing import NDArray

from ...surface import Surface
from ..notes import listing, metadata_left_out, survives, warn, warn_left_out
from ..source import Source
from . import gdal, tiff_guard
from .tags import describe, missing
from .writing_heights import even_heights, geotransform, warn_off

__all__ = ["READ_OPTIONS", "read", "sniff", "write", "write_tiff"]

READ_OPTIONS = {"band": "number of the band of heights, from 1 (default: 1); the others become attributes"}

_MAGICS = (b"II*\0", b"MM\0*", b"II+\0", b"MM\0+")  # both byte orders, classic and BigTIFF
_TITLE = "GeoTIFF"

#: Metadata that a GeoTIFF holds.
_HELD = (
    *("geotransform", "grid", "axes", "crs", "unit", "scale", "offset"),
    *("area_or_point", "description", "tags", "bands"),
)

#: Sides of the tiles of an image that is at least so large.
_TILE = 256


def sniff(head: bytes, suffix: str) -> bool:
    """Whether a file begins like a TIFF."""
    return head.startswith(_MAGICS)


def read(source: Source) -> Surface:
    """Read the first band, or the one that the option ``band`` names, as heights and the others as attributes."""
    tiff_guard.check(source.path)
    return gdal.read(source, "GTiff", "geotiff", _TITLE, "data.tif")


def write(surface: Surface, file: BinaryIO) -> None:
    """Write heights as band 1 and attributes as further bands, with holes, place, CRS, unit, scale and tags.

    Holes get the value of ``nodata`` in the metadata where their type can hold it and no height has it, else NaN; in
    integers without such a value a mask inside the file says where they are.
    """
    write_tiff(surface, file, lambda path, predictor: path)


def write_tiff(surface: Surface, file: BinaryIO, finish: Callable[[Path, int], Path]) -> None:
    """Write a GeoTIFF, and what is made of it to `file`.

    Parameters
    ----------
    surface : Surface
    file : binary file
        Only its ``write`` is used.
    finish : callable
        Takes the path of the GeoTIFF, alone in its folder, and TIFF's predictor for its values; returns the path of
        the file to hand over.
    """
    rasterio = gdal.require_rasterio(_TITLE)
    surface = even_heights(surface, _TITLE)
    if any(surface.closed):
        warn("GeoTIFF cannot express closed axes")
    warn_left_out(_TITLE, metadata_left_out(surface, _HELD))
    names, bands = _bands(surface)
    nodata = _nodata(surface, bands[0])
    if surface.mask is not None:
        kept = surface.blocks[0].kept
        said = surface.mask if kept is None else surface.mask | kept
        bands[0] = np.where(said, bands[0], bands[0].dtype.type(0 if nodata is None else nodata))
    profile = _profile(surface, bands, nodata)
    with tempfile.TemporaryDirectory(prefix="lodestream-") as folder, warnings.catch_warnings():
        warnings.simplefilter("ignore", rasterio.errors.NotGeoreferencedWarning)
        path = Path(folder) / "data.tif"
        with (
            rasterio.Env(GDAL_TIFF_INTERNAL_MASK=True, GDAL_PAM_ENABLED="NO"),
            rasterio.open(path, "w", **profile) as dataset,
        ):
            crs = _locate(dataset, surface)
            valid = bands[0] if surface.mask is None else bands[0][surface.mask]
            describe(dataset, surface.metadata, names, [valid, *bands[1:]])
            for number, band in enumerate(bands, 1):
                dataset.write(band, number)
            if surface.mask is not None and nodata is None:
                dataset.write_mask(surface.mask)
        path = finish(path, profile["predictor"])
        with rasterio.Env(**gdal.ALONE), rasterio.open(path, driver="GTiff") as dataset:
            lost = missing(dataset, surface.metadata, names)
            lost += ["all of the CRS"] * (crs is not None and dataset.crs != crs)
        with path.open("rb") as written:
            shutil.copyfileobj(written, file)
    warn_left_out(_TITLE, lost, "which GDAL does not write")


def _profile(surface: Surface, bands: Sequence[NDArray[Any]], nodata: float | None) -> dict[str, Any]:
    """How rasterio makes the file."""
    rows, columns = surface.shape
    profile: dict[str, Any] = {
        "driver": "GTiff",
        "height": rows,
        "width": columns,
        "count": len(bands),
        "dtype": bands[0].dtype,
        "nodata": nodata,
        "compress": "deflate",
        "predictor": 3 if bands[0].dtype.kind == "f" else 2 if bands[0].dtype.itemsize < 8 else 1,  # libtiff before 4.4
        "bigtiff": "if_safer",
        "photometric": "minisblack",  # or GDAL takes bands of bytes for colours, and the fourth for what is transparent
    }
    if min(rows, columns) >= _TILE:
        profile |= {"tiled": True, "blockxsize": _TILE, "blockysize": _TILE}
    return profile


def _bands(surface: Surface) -> tuple[list[str], list[NDArray[Any]]]:
    """Names and values of all bands, which have one type in a TIFF."""
    names, bands = [""], [surface.points]
    for name, values in surface.attributes.items():
        parts = values.reshape(*surface.shape, -1)
        count = parts.shape[2]
        names += [name if count == 1 else f"{name}_{part}" for part in range(count)]
        bands += [parts[..., part] for part in range(count)]
    common = np.result_type(*bands)
    for name, band in zip(names, bands, strict=True):
        if not survives(band, common):
            warn(f"GeoTIFF has one type for all bands: {name or 'heights'} are rounded to {common}")
    return names, [band.astype(common, copy=False) for band in bands]


def _nodata(surface: Surface, heights: NDArray[Any]) -> float | None:
    """The value that stands for holes; None where there is none."""
    given = surface.metadata.get("nodata")
    valid = heights if surface.mask is None else heights[surface.mask]
    value = _number(given)
    if value is not None:
        if heights.dtype.kind == "f" and np.isnan(value):
            return value
        limits: Any = np.finfo(heights.dtype) if heights.dtype.kind == "f" else np.iinfo(heights.dtype)
        held = float(limits.min) <= value <= float(limits.max) and (heights.dtype.kind == "f" or value == int(value))
        if held and not (valid == heights.dtype.type(value)).any():
            return value
    return float("nan") if surface.mask is not None and heights.dtype.kind == "f" else None


def _number(text: Any) -> float | None:
    """The number that metadata give, which text may be; None where they give none."""
    try:
        return float(text) if isinstance(text, int | float | str) else None
    except (ValueError, OverflowError):
        return None


def _locate(dataset: Any, surface: Surface) -> Any:
    """Write the place and the CRS; give the latter, None where there is none."""
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
