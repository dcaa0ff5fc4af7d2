"""Read rasters through rasterio, each by exactly one driver of GDAL.

GDAL opens a VRT whatever its name, and through it any file or host; and it looks for further files beside the one that
it opens. So the first bytes are checked before GDAL sees a file, one driver is allowed, and the file is opened by a
link of its own in an empty folder.
"""

from __future__ import annotations

import math
import os
import tempfile
import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ...errors import FormatError, InputError, TooLargeError, UnavailableError
from ...surface import Surface
from ..longitudes import close_around
from ..notes import listing, warn
from ..source import Source, number
from .tags import read_tags

__all__ = ["ALONE", "read", "require_rasterio"]

#: Nothing is looked for beside the file: no .aux.xml, .ovr, .msk, no world file.
ALONE = {
    "GDAL_DISABLE_READDIR_ON_OPEN": "EMPTY_DIR",
    "GDAL_PAM_ENABLED": "NO",
    "GDAL_GEOREF_SOURCES": "INTERNAL",
}

#: A tile is decoded whole, so it may be larger than the surface, but not by any amount.
_HARMLESS_TILE = 1 << 24

#: Rows that are read at a time are a multiple of the first, of about so many values.
_TILE_ROWS, _AT_ONCE = 512, 1 << 24

#: Each becomes an attribute, and rasterio and GDAL look through all bands for some of what they say of one.
_MOST_BANDS = 1 << 12


def require_rasterio(format_name: str) -> Any:
    """Import and return rasterio.

    Raises
    ------
    UnavailableError
        If it is not installed; ``format_name`` is what the message says needs it.
    """
    try:
        import rasterio
    except ImportError:
        raise UnavailableError(
            f"expected rasterio for {format_name}, which is not installed: pip install 'lodestream[formats]'"
        ) from None
    return rasterio


def read(source: Source, driver: str, format_name: str, title: str, file_name: str, **options: str) -> Surface:
    """Read one band as heights and the others as attributes.

    Parameters
    ----------
    source : Source
        Its content has been found to be of this format.
    driver : str
        GDAL's name of the only driver that is allowed.
    format_name, title : str
        Our name of the format, and what people call it.
    file_name : str
        What GDAL is to think that the file is called.
    **options
        Options of the driver.
    """
    with _opened(source, driver, title, file_name, options) as dataset:
        band = _check(source, dataset, title)
        points = _values(dataset, band, source)
        mask = _mask(dataset, band, source)
        others = _attributes(dataset, band)
        metadata = source.metadata(format_name) | _metadata(dataset, band) | read_tags(dataset, band, others)
        attributes = _others(dataset, others, source)
        _warn_left_out(dataset)
        geographic = bool(dataset.crs and dataset.crs.is_geographic)
    if mask is not None and points.dtype.kind == "f":
        for rows in _strips(points.shape):
            strip = points[rows]
            strip[np.isinf(strip) & ~mask[rows]] = np.nan  # nodata that is infinite: no value, as the file says
    surface = Surface(points, mask=mask, attributes=attributes, metadata=metadata)
    transform = metadata.get("geotransform")
    if geographic and transform and transform[2] == transform[4] == 0:
        return close_around(surface, (1, transform[1]), source.closed)
    return surface


@contextmanager
def _opened(source: Source, driver: str, title: str, file_name: str, options: dict[str, str]) -> Iterator[Any]:
    rasterio = require_rasterio(title)
    errors = rasterio.errors
    with tempfile.TemporaryDirectory(prefix="lodestream-") as folder, warnings.catch_warnings():
        warnings.simplefilter("ignore", errors.NotGeoreferencedWarning)  # a grid without a place is a surface too
        path = Path(folder) / file_name
        path.symlink_to(os.path.realpath(source.path))
        try:
            with rasterio.Env(**ALONE), rasterio.open(path, driver=driver, **options) as dataset:
                yield dataset
        except InputError:
            raise
        except (errors.RasterioError, OSError, ValueError) as error:
            # The first cause says what failed, the others where; and the path may be a server's own.
            cause: BaseException = error
            while cause.__cause__ is not None:
                cause = cause.__cause__
            reason = str(cause).replace(str(path), "the file").replace(f"{file_name}: ", "")
            raise FormatError(f"GDAL cannot read this {title}, which may be damaged or cut short: {reason}") from None


def _check(source: Source, dataset: Any, title: str) -> int:
    """Check a dataset by its header alone; return the band to read as heights."""
    if dataset.subdatasets:
        raise FormatError(f"expected a {title} of one image, got {len(dataset.subdatasets)} images")
    if dataset.count > _MOST_BANDS:
        raise TooLargeError(f"expected at most {number(_MOST_BANDS)} bands, got {number(dataset.count)}")
    band = (source.integer_option("band", 1, dataset.count) if "band" in source.options else None) or 1
    total = 0
    for kind, (rows, columns) in zip(dataset.dtypes, dataset.block_shapes, strict=True):
        if kind.startswith("complex"):
            raise FormatError(f"expected integers or floating-point numbers, got {kind}")
        source.check_array((dataset.height, dataset.width), np.dtype(kind))
        total += dataset.height * dataset.width * np.dtype(kind).itemsize
        if rows * columns > max(dataset.height * dataset.width, _HARMLESS_TILE):
            raise TooLargeError(
                f"expected tiles no larger than the image, got tiles of {number(rows)} x {number(columns)}"
            )
    source.check_array((dataset.height, dataset.width, max(2, dataset.count)), np.dtype(np.uint8))
    source.check_expansion(total)
    return band


def _strips(shape: tuple[int, ...]) -> Iterator[slice]:
    """Yield slices of all rows, whole rows of tiles, not many bytes at a time."""
    n_rows = max(_TILE_ROWS, _AT_ONCE // max(shape[1], 1) // _TILE_ROWS * _TILE_ROWS)
    return (slice(start, min(start + n_rows, shape[0])) for start in range(0, shape[0], n_rows))


def _values(dataset: Any, band: int, source: Source) -> NDArray[Any]:
    """Return the values of a band, shape (row, column)."""
    dtype = np.dtype(dataset.dtypes[band - 1])
    if not source.room.takes(dataset.height * dataset.width * dtype.itemsize):
        return np.asarray(dataset.read(band))
    values = source.empty((dataset.height, dataset.width), dtype)
    for rows in _strips(values.shape):
        values[rows] = dataset.read(band, window=((rows.start, rows.stop), (0, dataset.width)))
    return values


def _others(dataset: Any, names: dict[str, int], source: Source) -> dict[str, NDArray[Any]]:
    """Return the values of other bands, by name; shape (row, column)."""
    size = dataset.height * dataset.width * max(np.dtype(kind).itemsize for kind in dataset.dtypes)
    if not names or source.room.takes(size):
        return {name: _values(dataset, band, source) for name, band in names.items()}
    # All at once: rasterio looks at every band of the file whenever it reads.
    return dict(zip(names, dataset.read([*names.values()]), strict=True))


def _mask(dataset: Any, band: int, source: Source) -> NDArray[np.bool_] | None:
    """Return the mask of cells with a value, by nodata, a mask inside the file or transparency, as GDAL finds it."""
    if all(flag.name == "all_valid" for flag in dataset.mask_flag_enums[band - 1]):
        return None
    mask = source.empty((dataset.height, dataset.width), np.dtype(np.bool_))
    for rows in _strips(mask.shape):
        mask[rows] = dataset.read_masks(band, window=((rows.start, rows.stop), (0, dataset.width))) != 0
    return mask


def _attributes(dataset: Any, heights: int) -> dict[str, int]:
    """Return the bands beside the heights by name, without bands of transparency, which are in the mask."""
    names: dict[str, int] = {}
    alphas = _alphas(dataset)
    for band, description in enumerate(dataset.descriptions, 1):
        if band == heights or band in alphas:
            continue
        name = description or f"band_{band}"
        names[name if name not in names else f"{name}_{band}"] = band
    return names


def _warn_left_out(dataset: Any) -> None:
    """Note data of a file that a surface cannot hold."""
    colors = enumerate(dataset.colorinterp, 1)
    left_out = [f"the colour table of band {band}" for band, color in colors if color.name == "palette"]
    left_out += [f"{len(dataset.gcps[0])} ground control points"] * bool(dataset.gcps[0])
    for band in _alphas(dataset):
        if not np.isin(dataset.read(band), (0, 255)).all():
            left_out.append(f"partial transparency in band {band}")
    if left_out:
        warn(f"left out {listing(left_out)}")


def _alphas(dataset: Any) -> list[int]:
    """Return the bands of transparency, which GDAL turns into a mask."""
    kinds = zip(dataset.colorinterp, dataset.dtypes, strict=True)
    return [band for band, (color, kind) in enumerate(kinds, 1) if color.name == "alpha" and kind == "uint8"]


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
    """Return a value that MessagePack and JSON can hold, NaN as text; ``float()`` restores it."""
    if not math.isfinite(nodata):
        return str(nodata)
    return int(nodata) if abs(nodata) < 2**63 and nodata == int(nodata) else float(nodata)
