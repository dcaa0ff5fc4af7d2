"""Ways in which a Dataset of xarray becomes a surface, and the notes that are said of it."""

from __future__ import annotations

import warnings
from collections.abc import Callable
from pathlib import Path
from typing import Any, TypeVar

import xarray as xr

import lodestream as ls
from lodestream.errors import FormatWarning

__all__ = ["Opener", "by_netcdf", "by_xarray", "by_zarr", "noted"]

Opener = Callable[..., ls.Surface]
_Result = TypeVar("_Result")


def by_netcdf(data: xr.Dataset, folder: Path, **options: Any) -> ls.Surface:
    """Write a NetCDF-4 file, and read it."""
    data.to_netcdf(folder / "a.nc", engine="h5netcdf")
    return ls.read(folder / "a.nc", **options)


def by_zarr(data: xr.Dataset, folder: Path, **options: Any) -> ls.Surface:
    """Write a Zarr store, and read it."""
    data.to_zarr(folder / "a.zarr", mode="w", consolidated=False)
    return ls.read(folder / "a.zarr", **options)


def by_xarray(data: xr.Dataset, folder: Path, **options: Any) -> ls.Surface:
    """Write a NetCDF-4 file, let xarray decode it, and take what it gives."""
    data.to_netcdf(folder / "d.nc", engine="h5netcdf")
    with xr.open_dataset(folder / "d.nc", engine="h5netcdf") as opened:
        return ls.Surface.from_xarray(opened, **{"attributes": [], **options})


def noted(make: Callable[[], _Result]) -> tuple[_Result, list[str]]:
    """Call a function; return its result and the notes that it gives."""
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always", FormatWarning)
        result = make()
    return result, [str(warning.message) for warning in caught]
