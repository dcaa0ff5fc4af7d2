"""NetCDF-4, written by h5netcdf in strips of rows: heights over x and y, attributes as variables beside them."""

from __future__ import annotations

import shutil
import warnings
from concurrent.futures import Future, ThreadPoolExecutor
from pathlib import Path
from threading import Event
from typing import Any, BinaryIO

import numpy as np

from ...errors import FormatError, UnavailableError
from ...surface import Surface
from ..beside import folder_beside
from ..notes import with_nul_shown
from .hdf5_output import Output
from .stored import Contents, Variable, contents_of, strips

__all__ = ["write"]

_DEFLATE = {"compression": "gzip", "compression_opts": 1, "shuffle": True}

#: Rows and columns of a chunk.
_CHUNK = 256


def write(surface: Surface, file: BinaryIO) -> None:
    """Write what `Surface.to_xarray` says of a surface.

    Holes are ``_FillValue``: NaN, or a number that no height has. The values are written some rows at a time, so that
    the surface may be larger than memory.

    Raises
    ------
    UnavailableError
        If h5netcdf is not installed.
    FormatError
        If it refuses what the surface is called.
    """
    try:
        import h5netcdf  # noqa: F401
    except ImportError:
        raise UnavailableError(
            "expected h5netcdf for NetCDF, which is not installed: pip install 'lodestream[formats]'"
        ) from None
    contents = contents_of(with_nul_shown("NetCDF", surface), "NetCDF")
    with folder_beside(file) as folder, warnings.catch_warnings():
        warnings.simplefilter("ignore")  # about what other programs may not read
        path = folder / "data.nc"
        try:
            # Signals are handled in the main thread: an interruption in a call that HDF5 makes kills the process.
            with ThreadPoolExecutor(1) as aside:
                stop = Event()
                try:
                    writing = aside.submit(_write_all, path, contents, stop)
                except RuntimeError:  # a server's process may have no second thread, and nobody interrupts it
                    _write_all(path, contents, stop)
                else:
                    _wait(writing, stop)
        except (ValueError, TypeError, KeyError) as error:
            raise FormatError(f"expected a surface that NetCDF can hold, got one that it refuses: {error}") from None
        with path.open("rb") as written:
            shutil.copyfileobj(written, file)


def _wait(writing: Future[None], stop: Event) -> None:
    try:
        writing.result()
    except BaseException:
        stop.set()
        raise


def _write_all(path: Path, contents: Contents, stop: Event) -> None:
    import h5netcdf

    with Output(path) as output:
        try:
            with h5netcdf.File(output, "w") as group:
                group.attrs.update(contents.attributes)
                for name, variable in contents.variables.items():
                    _write(group, name, variable, output, stop)
        finally:
            output.check()


def _write(group: Any, name: str, variable: Variable, output: Output, stop: Event) -> None:
    """Write one variable, and the dimensions of it that are new, unless nobody waits for it any more."""
    for dim, length in zip(variable.dims, variable.shape, strict=True):
        if dim not in group.dimensions:
            group.dimensions[dim] = length
    said: dict[str, Any] = {"fillvalue": variable.fill}
    if len(variable.shape) > 1:
        sides = (min(length, _CHUNK) for length in variable.shape[:2])
        said |= {**_DEFLATE, "chunks": (*sides, *[1] * (len(variable.shape) - 2))}
    made = group.create_variable(name, variable.dims, variable.dtype, **said)
    made.attrs.update(variable.attributes)
    if not variable.shape:
        made[...] = variable.rows(slice(None))
        return
    for rows, values in strips(variable, _CHUNK if len(variable.shape) > 1 else variable.shape[0]):
        made[rows] = np.ascontiguousarray(values)
        output.check()
        if stop.is_set():
            return
