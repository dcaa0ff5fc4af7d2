"""Write COG: a GeoTIFF in tiles, with overviews and its directories first, so that programs read windows by ranges.

It is written by GDAL's COG driver, and read as a GeoTIFF. Source: OGC 21-026, Cloud Optimized GeoTIFF Standard.
"""

from __future__ import annotations

from pathlib import Path
from typing import BinaryIO

from ...parallel import threads
from ...surface import Surface
from . import gdal
from .geotiff import write_tiff

__all__ = ["SUFFIXES", "sniff", "write"]

SUFFIXES = (".cog.tif", ".cog.tiff")

#: The codes of TIFF's predictors as the COG driver calls them.
_PREDICTORS = {1: "NO", 2: "STANDARD", 3: "FLOATING_POINT"}


def sniff(head: bytes, suffix: str) -> bool:
    """Return False: such a file is read as a GeoTIFF."""
    return False


def write(surface: Surface, file: BinaryIO) -> None:
    """Write a GeoTIFF with overviews, whose values are means of the finer ones."""
    write_tiff(surface, file, _optimised)


def _optimised(path: Path, predictor: int) -> Path:
    """Make a COG from a GeoTIFF, which is removed, so that the disk holds at most two files of that size."""
    rasterio = gdal.require_rasterio("COG")
    from rasterio.shutil import copy

    target = path.with_name("cog.tif")
    with rasterio.Env(GDAL_TIFF_INTERNAL_MASK=True, GDAL_PAM_ENABLED="NO"):
        copy(
            path,
            target,
            driver="COG",
            compress="DEFLATE",
            predictor=_PREDICTORS[predictor],
            bigtiff="IF_SAFER",
            num_threads=str(threads()),
            overviews="IGNORE_EXISTING",
            resampling="AVERAGE",
        )
    path.unlink()
    return target
