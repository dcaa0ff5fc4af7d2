"""GeoTIFF: one band of heights, through GDAL's GTiff driver and no other.

GDAL opens a VRT whatever its name, and through it any file or host; and it looks for further files beside the one that
it opens. So the first bytes are checked before GDAL sees the file, one driver is allowed, and the folder is hidden.
"""

from __future__ import annotations

import math
import os
import warnings
from typing import Any

import numpy as np

from ..errors import FormatError, InputError, TooLargeError
from ..surface import Surface
from .source import Source, number

__all__ = ["read", "sniff"]

_MAGICS = (b"II*\0", b"MM\0*", b"II+\0", b"MM\0+")  # both byte orders, classic and BigTIFF

#: Nothing is looked for beside the file: no .aux.xml, .ovr, .msk, no world file.
_ALONE = {
    "GDAL_DISABLE_READDIR_ON_OPEN": "EMPTY_DIR",
    "GDAL_PAM_ENABLED": "NO",
    "GDAL_GEOREF_SOURCES": "INTERNAL",
}

#: A tile is decoded whole, so it may be larger than the surface, but not by any amount.
_HARMLESS_TILE = 1 << 24


def sniff(head: bytes, suffix: str) -> bool:
    """Whether a file begins like a TIFF."""
    return head.startswith(_MAGICS)


def read(source: Source) -> Surface:
    """Read the only band, or the one that the option ``band`` names, as heights."""
    try:
        import rasterio
        from rasterio.errors import NotGeoreferencedWarning, RasterioError
    except ImportError:
        raise FormatError(
            "expected rasterio for reading GeoTIFF, which is not installed: install lodestream[formats]"
        ) from None
    path = os.path.realpath(source.path)
    if path.startswith("/vsi"):
        raise FormatError("expected a file outside /vsi..., a prefix that GDAL takes for its virtual file systems")
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", NotGeoreferencedWarning)  # a grid without a place is a surface too
        try:
            with rasterio.Env(**_ALONE), rasterio.open(path, driver="GTiff") as dataset:
                band = _check(source, dataset)
                points = dataset.read(band)
                metadata = source.metadata("geotiff") | _metadata(dataset, band)
        except InputError:
            raise
        except (RasterioError, OSError, ValueError) as error:
            # The cause says what failed, and the path may be a server's own.
            reason = str(error.__cause__ or error).replace(path, "the file")
            raise FormatError(f"expected a whole GeoTIFF, got one that GDAL cannot read: {reason}") from None
    _refuse_nodata(points, metadata.get("nodata"))
    return Surface(points, metadata=metadata)


def _check(source: Source, dataset: Any) -> int:
    """Check by the header alone; return the band to read."""
    if dataset.subdatasets:
        raise FormatError(f"expected a GeoTIFF of one image, got {len(dataset.subdatasets)} images")
    band = source.integer_option("band", 1, dataset.count)
    if band is None and dataset.count > 1:
        raise FormatError(
            f"expected one band of heights, got {dataset.count} bands: choose with band=1 to band={dataset.count} "
            "(several bands together are not supported yet)"
        )
    band = band or 1
    if dataset.dtypes[band - 1].startswith("complex"):
        raise FormatError(f"expected integers or floating-point numbers, got {dataset.dtypes[band - 1]}")
    dtype = np.dtype(dataset.dtypes[band - 1])
    source.check_array((dataset.height, dataset.width), dtype)
    source.check_expansion(dataset.height * dataset.width * dtype.itemsize)
    rows, columns = dataset.block_shapes[band - 1]
    if rows * columns > max(dataset.height * dataset.width, _HARMLESS_TILE):
        raise TooLargeError(f"expected tiles no larger than the image, got tiles of {number(rows)} x {number(columns)}")
    return band


def _metadata(dataset: Any, band: int) -> dict[str, Any]:
    metadata: dict[str, Any] = {}
    if dataset.crs:
        metadata["crs"] = dataset.crs.to_wkt()
    transform = [float(value) for value in dataset.transform.to_gdal()]
    if not dataset.transform.is_identity and all(map(math.isfinite, transform)):
        metadata["geotransform"] = transform
    nodata = dataset.nodatavals[band - 1]
    if nodata is not None:
        metadata["nodata"] = _plain(nodata)
    if dataset.units[band - 1]:
        metadata["unit"] = dataset.units[band - 1]
    if (dataset.scales[band - 1], dataset.offsets[band - 1]) != (1.0, 0.0):
        metadata["scale"], metadata["offset"] = float(dataset.scales[band - 1]), float(dataset.offsets[band - 1])
    return metadata


def _plain(nodata: float) -> int | float | str:
    """Make the value one that JSON holds too, which has no NaN; ``float()`` takes it back."""
    if not math.isfinite(nodata):
        return str(nodata)
    return int(nodata) if nodata == int(nodata) else float(nodata)


def _refuse_nodata(points: Any, nodata: float | str | None) -> None:
    if nodata is None or not math.isfinite(float(nodata)):
        return  # NaN and infinities are refused by Surface
    holes = points == nodata
    count = int(np.count_nonzero(holes))
    if count:
        row, column = divmod(int(holes.argmax()), holes.shape[1])
        raise InputError(
            f"expected a value everywhere, got nodata ({nodata}) at {count} of {holes.size} points, first at row "
            f"{row}, column {column} (holes are not supported yet)"
        )
