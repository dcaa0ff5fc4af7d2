"""NetCDF classic, 64-bit offset and 4: one variable as heights, over the coordinates that the file has for it."""

from __future__ import annotations

import os
import re
import warnings
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ...coordinates.seams import merge
from ...errors import FormatError, InputError, OptionError, TooLargeError, UnavailableError
from ...scratch import Room
from ...sources import windows
from ...surface import Closed, Surface
from ..notes import listing, warn
from ..placed import Coordinate, place
from ..source import Source, check_allowed
from . import hdf5_guard, vmec
from .choice import Choice, choose, others
from .names import AXIS_WORDS, axis_words

__all__ = ["KINDS", "READ_OPTIONS", "chosen_of", "pieces", "read", "sniff", "surface_of"]

#: What is read by other rules than a NetCDF of heights.
KINDS = ("vmec",)

READ_OPTIONS = {
    "variable": "name of the variable with the heights (default: the only one)",
    "x": "name of the variable of x (default: by the CF conventions)",
    "y": "name of the variable of y; with x but without variable, the surface is planar",
    "time": "index of a time, from 0, or the beginning of its date, such as 2001-02",
    "at": "indices along other dimensions, such as depth:0 or depth:3,member:1",
    "attributes": "names of variables of the same shape that become attributes, separated by commas",
    "resolution": "VMEC: number of points the short and the long way around, such as 64x256",
}

#: Attributes that say how values are stored, or which variables belong to them.
_READ = (
    *("_FillValue", "missing_value", "scale_factor", "add_offset", "_Unsigned"),
    *("bounds", "coordinates", "grid_mapping", "climatology", "cell_measures", "formula_terms"),
)

#: What h5py says where HDF5 has told it nothing, as happens where memory is short.
_UNSAID = re.compile(r"unspecified error|failed to walk error stack", re.IGNORECASE)

_CLASSIC = (b"CDF\x01", b"CDF\x02")
_CDF5 = b"CDF\x05"
_HDF5 = b"\x89HDF\r\n\x1a\n"


def sniff(head: bytes, suffix: str) -> bool:
    """Whether a file begins like NetCDF, or like HDF5 and is not named .cgns."""
    return head.startswith((*_CLASSIC, _CDF5)) or (head.startswith(_HDF5) and suffix != ".cgns")


def read(source: Source) -> Surface:
    """Read one variable, its coordinates, and those that options make attributes.

    Raises
    ------
    OptionError
        If the option ``resolution`` is given for a file that is not one of VMEC.
    """
    with _opened(source) as dataset:
        if vmec.is_vmec(dataset) and not {"variable", "x", "y"} & set(source.options):
            check_allowed(("vmec",), source.allowed)
            return vmec.read(source, dataset)
        check_allowed(("netcdf",), source.allowed)
        if "resolution" in source.options:
            raise OptionError("expected resolution= for a VMEC file only, got another NetCDF")
        source.check_expansion(choose(source, dataset).nbytes)
        surface, left_out = chosen_of(source, dataset, "netcdf")
    if left_out:  # said here, for the libraries' own warnings are not shown while the file is open
        warn(f"left out variables of the same grid: {listing(left_out)}; take them with attributes=")
    return surface


def chosen_of(source: Source, dataset: Any, format_name: str) -> tuple[Surface, list[str]]:
    """What is chosen of an xarray Dataset, with values as they are stored; and the variables that are left out.

    Raises
    ------
    InputError
        If nothing can be chosen, or it is no surface.
    """
    choice = choose(source, dataset)
    source.check_array(choice.shape, np.dtype(np.float64))
    left_out = others(dataset, choice)
    return surface_of(source, dataset, choice, format_name), left_out


@contextmanager
def _opened(source: Source) -> Iterator[Any]:
    """The file as an xarray dataset, with values as they are stored; nothing but its header is in memory."""
    with source.path.open("rb") as file:
        head = file.read(8)
    if head.startswith(_CDF5):
        raise FormatError("expected NetCDF classic, 64-bit offset or 4, got CDF-5 (64-bit data), which is not read")
    try:
        import h5netcdf  # noqa: F401 - for a better message than xarray's
        import scipy  # noqa: F401
        import xarray
    except ImportError:
        raise UnavailableError(
            "expected xarray, h5netcdf, h5py and scipy for NetCDF, which are not all installed: install "
            "lodestream[formats]"
        ) from None
    hdf5 = head == _HDF5
    path = os.path.realpath(source.path)  # absolute, so that no library takes it for an address
    try:
        if hdf5:
            hdf5_guard.check(source.path)
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            options: dict[str, Any] = {"engine": "h5netcdf", "phony_dims": "access"} if hdf5 else {"engine": "scipy"}
            with xarray.open_dataset(
                path, decode_cf=False, create_default_indexes=False, cache=False, **options
            ) as dataset:
                yield dataset
    except (InputError, UnavailableError):
        raise
    except MemoryError:
        raise TooLargeError("expected a NetCDF that fits into memory, got one that promises more") from None
    except Exception as error:  # none of these libraries says what it may raise
        reason = " ".join(str(error).replace(path, "the file").split())
        if not reason or isinstance(error, SystemError) or _UNSAID.search(reason):
            raise UnavailableError(
                f"expected the libraries of NetCDF to read the file or to say why not, got {type(error).__name__}: "
                "they may have had too little memory"
            ) from None
        raise FormatError(f"expected a whole NetCDF, got one that is not readable: {reason[:120]}") from None


def surface_of(source: Source, dataset: Any, choice: Choice, format_name: str = "netcdf") -> Surface:
    """What was chosen of an xarray Dataset, with values as they are stored.

    Raises
    ------
    InputError
        If the arrays are no surface.
    """
    said = {} if choice.heights is None else _metadata(dataset, dataset.variables[choice.heights])
    metadata = source.metadata(format_name) | _tags(dataset, choice, said.get("crs"))
    mask: NDArray[np.bool_] | None = None
    axes: list[Coordinate | None] = []
    for found in (choice.x, choice.y):
        if found is None:
            axes.append(None)
            continue
        values, valid = _values(source, dataset.variables[found.name], choice.index)
        if found.axis is None:
            mask = _both(mask, valid)
        axes.append(Coordinate(values, found.axis, found.degrees))
    x, y = (axis or Coordinate(np.arange(choice.shape[1 - number]), 1 - number) for number, axis in enumerate(axes))
    attributes = {name: _raw(source, dataset.variables[name], choice.index) for name in choice.attributes}
    if choice.heights is None:
        points = np.stack(np.broadcast_arrays(x.values, y.values), axis=-1)
        surface = Surface(points, mask=mask, attributes=attributes, metadata=metadata)
        return _closed_fields(source, dataset, choice, merge(surface, source.closed, room=source.room))
    variable = dataset.variables[choice.heights]
    heights, valid = _values(source, variable, choice.index)
    mask = _both(mask, valid)
    metadata |= {"variable": choice.heights} | said
    if choice.x is None and choice.y is None:
        return Surface(heights, mask=mask, attributes=attributes, metadata=metadata)
    extras: dict[str, Any] = {"mask": mask, "attributes": attributes, "metadata": metadata}
    surface = place(heights, x, y, closed=source.closed, room=source.room, **extras)
    return _closed_fields(source, dataset, choice, surface)


def _both(one: NDArray[np.bool_] | None, other: NDArray[np.bool_] | None) -> NDArray[np.bool_] | None:
    """Where both are True; None: everywhere."""
    if one is None or other is None:
        return other if one is None else one
    return one & other


def _chosen(variable: Any, index: Mapping[str, int]) -> Any:
    """A variable without the dimensions of which an index was chosen; nothing is read yet."""
    return variable.isel({dim: at for dim, at in index.items() if dim in variable.dims})


def pieces(variable: Any, room: Room) -> Iterator[tuple[Any, Any]]:
    """What of a variable of xarray is read at a time: an index and that part of it, of which nothing is read yet.

    All of it, unless it is large for the room and has two axes or more; then windows of whole chunks.
    """
    if variable.ndim < 2 or not room.takes(variable.nbytes):
        yield ..., variable
        return
    for window in windows(variable.shape, _chunk(variable)):
        yield window, variable[window]


def _chunk(variable: Any) -> tuple[int, int]:
    """Rows and columns of the chunks that Dask or a file has, 1 where there are none."""
    preferred = variable.encoding.get("preferred_chunks") or {}
    lengths = variable.chunks or [preferred.get(dim, 1) for dim in variable.dims]
    rows, columns = (max(length) if isinstance(length, tuple) else int(length) for length in lengths[:2])
    return max(rows, 1), max(columns, 1)


def _stored(variable: Any) -> NDArray[Any]:
    """Values as they are stored."""
    return _signed(np.asarray(variable.values), variable.attrs)


def _signed(values: NDArray[Any], said: Mapping[str, Any]) -> NDArray[Any]:
    """Integers of any shape with or without a sign, as ``_Unsigned`` says of what NetCDF classic has no type for."""
    kind = {"true": "u", "false": "i"}.get(str(said.get("_Unsigned", "")).lower())
    if kind is None or values.dtype.kind not in "iu" or kind == values.dtype.kind:
        return values
    return values.view(values.dtype.str.replace(values.dtype.kind, kind))


def _raw(source: Source, variable: Any, index: Mapping[str, int]) -> NDArray[Any]:
    """Values as they are stored, shape (row, column); large ones where there is room."""
    variable = _chosen(variable, index)
    out: NDArray[Any] | None = None
    for window, part in pieces(variable, source.room):
        values = _stored(part)
        if window is ...:
            return values
        out = source.empty(variable.shape, values.dtype.newbyteorder("=")) if out is None else out
        out[window] = values
    assert out is not None  # a variable has rows
    return out


def _values(source: Source, variable: Any, index: Mapping[str, int]) -> tuple[NDArray[Any], NDArray[np.bool_] | None]:
    """Values, shape (row, column), and where they are none of those that stand for missing; None: everywhere."""
    variable = _chosen(variable, index)
    out: NDArray[Any] | None = None
    mask: NDArray[np.bool_] | None = None
    for window, part in pieces(variable, source.room):
        values, valid = _decoded(_stored(part), variable.attrs)
        if window is ...:
            return values, valid
        out = source.empty(variable.shape, values.dtype.newbyteorder("=")) if out is None else out
        out[window] = values
        if valid is not None and mask is None:
            mask = source.empty(variable.shape, np.dtype(np.bool_))
            mask[...] = True
        if valid is not None and mask is not None:
            mask[window] = valid
    assert out is not None  # a variable has rows
    return out, mask


def _decoded(raw: NDArray[Any], said: Mapping[str, Any]) -> tuple[NDArray[Any], NDArray[np.bool_] | None]:
    """Values by the conventions' rules for packed ones, and where they are valid; None: everywhere."""
    valid = np.ones(raw.shape, np.bool_)
    for key in ("_FillValue", "missing_value"):
        for missing in np.atleast_1d(said.get(key, [])):
            if isinstance(missing, np.number | int | float):
                if isinstance(missing, np.integer) and (missing.itemsize, "i") == (
                    raw.itemsize,
                    raw.dtype.kind.replace("u", "i"),
                ):
                    missing = _signed(np.array([missing]), said)[0]  # as stored, as the values are
                valid &= raw != missing
                if np.isinf(missing) and raw.dtype.kind == "f":
                    raw = np.where(valid, raw, raw.dtype.type(np.nan))
    mask = None if valid.all() else valid
    scale, offset = (said.get(key) for key in ("scale_factor", "add_offset"))
    if scale is None and offset is None:
        return raw, mask
    factor, added = (float(np.ravel(number)[0]) for number in (1.0 if scale is None else scale, offset or 0.0))
    single = all(getattr(number, "dtype", None) == np.float32 for number in (scale, offset) if number is not None)
    return (raw * factor + added).astype(np.float32 if single else np.float64), mask


def _metadata(dataset: Any, variable: Any) -> dict[str, Any]:
    metadata: dict[str, Any] = {}
    if isinstance(unit := variable.attrs.get("units"), str) and unit.strip():
        metadata["unit"] = unit
    mapping = variable.attrs.get("grid_mapping")
    attributes = dataset.variables[mapping].attrs if mapping in dataset.variables else {}
    crs = attributes.get("crs_wkt", attributes.get("spatial_ref"))
    if isinstance(crs, str) and crs.strip():
        metadata["crs"] = crs
    return metadata


def _tags(dataset: Any, choice: Choice, crs: str | None) -> dict[str, Any]:
    """What the file says of itself and of the variables that are read, under the names that GDAL has for it.

    Coordinates are x and y, whatever the file calls them; what the CRS says of them already is left out.
    """
    tags: dict[str, str] = {}
    names = [*([choice.heights] if choice.heights else []), *choice.attributes]
    said = {"NC_GLOBAL": dataset.attrs, **{name: dataset.variables[name].attrs for name in names}}
    for name, attributes in said.items():
        for key, value in attributes.items():
            if key in _READ or (key == "units" and name == choice.heights):
                continue
            if isinstance(value, np.ndarray):
                text = "{" + ",".join(map(str, value.ravel().tolist())) + "}" if value.size != 1 else str(value.item())
            else:
                text = str(value)
            tags[f"{name}#{key}"] = text
    for letter, found in (("x", choice.x), ("y", choice.y)):
        attributes = {} if found is None else dataset.variables[found.name].attrs
        for key, text in attributes.items():
            if key in AXIS_WORDS and isinstance(text, str) and text != axis_words(letter, crs).get(key):
                tags[f"{letter}#{key}"] = text
    return {"tags": {"": tags}} if tags else {}


def _closed_fields(source: Source, dataset: Any, choice: Choice, surface: Surface) -> Surface:
    """Close the poloidal axis of a tokamak's core, which files of BOUT++ describe by their own numbers."""
    names = ("nx", "ny", "ixseps1", "ixseps2", "jyseps1_1", "jyseps2_2")
    variables = dataset.variables
    if (
        source.closed is not None
        or "y" not in choice.dims
        or not all(name in variables and variables[name].size == 1 for name in names)
    ):
        return surface
    nx, ny, one, two, first, last = (int(np.ravel(variables[name].values)[0]) for name in names)
    closed = [*surface.closed]
    closed[choice.dims.index("y")] |= min(one, two) >= nx and first < 0 and last >= ny - 1
    return _with_closed(surface, closed)


def _with_closed(surface: Surface, closed: Sequence[bool]) -> Surface:
    pair: Closed = (bool(closed[0]), bool(closed[1]))
    if pair == surface.closed:
        return surface
    mask, attributes = surface.mask, surface.attributes
    return Surface(surface.points, pair, mask=mask, attributes=attributes, metadata=surface.metadata)
