"""Surfaces of one file: one for each step along a dimension, or for each variable."""

from __future__ import annotations

import os
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from ..errors import InputError, OptionError
from .member import Member
from .reading import sniff
from .source import UNLIMITED_VERTICES, Source, with_name

__all__ = ["members"]


def members(
    path: str | os.PathLike[str],
    along: str,
    *,
    filename: str | None = None,
    format_name: str | None = None,
    options: Mapping[str, Any],
) -> list[Member]:
    """Return the surfaces of a file along a dimension, or its variables, without reading their values.

    Parameters
    ----------
    path : str or path-like
        A NetCDF or HDF5 file, or the folder of a Zarr store.
    along : str
        Name of a dimension; ``time``: that of times, whatever its name; ``variable``: all variables over surfaces.
    filename, format_name
        Those of `lodestream.read`.
    options : mapping
        Options of the format, as `lodestream.read` takes them.

    Returns
    -------
    list of Member
        In the order of the file.

    Raises
    ------
    FormatError, OptionError
        If the file has no such surfaces, or an option does not fit.
    OSError
        If the file cannot be opened.
    """
    path = Path(path)
    label = filename or os.fspath(path)
    format_ = sniff(path, filename=filename, format_name=format_name)
    try:
        if format_.members is None:
            raise OptionError(f"expected a NetCDF or a Zarr store for each {along}, got a file of {format_.name}")
        for name in options:
            if name not in format_.options:
                raise OptionError(f"expected an option of format {format_.name}, got {name!r}")
        source = Source(path, Path(label).stem, path.stat().st_size, UNLIMITED_VERTICES, options)
        return format_.members(source, along)
    except InputError as error:
        raise with_name(error, label) from None
