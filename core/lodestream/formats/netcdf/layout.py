"""How a surface lies in a Dataset of xarray, a NetCDF or a Zarr store: which variables, over which dimensions.

`to_xarray` makes a Dataset of it, the writers of NetCDF and Zarr make files of it, so that these say the same.

Heights are a variable over ``y`` and ``x``, whose coordinates follow from the metadata. x, y, z are a variable z over
``row`` and ``column`` with x and y as coordinates of both. Attributes are variables beside them. `mark` says what has
no other place.

Source: NetCDF Climate and Forecast (CF) Metadata Conventions 1.11; names of coordinates and of the grid mapping as
rioxarray has them.
"""

from __future__ import annotations

import json
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ...coordinates.coordinate_rules import VALUES
from ...coordinates.height_fields import coordinates
from ...coordinates.seams import angles_of, wrapped
from ...errors import FormatError, InputError
from ...surface import DTYPES, Block, Closed, Surface
from ..holes import Rows, fill_of
from ..notes import survives
from .attribute_texts import attributes_of
from .crs import MAPPING, beside_crs, grid_mapping
from .names import REFERENCES, axis_words, is_east, is_geographic, is_rotated
from .single_numbers import numbers_in
from .values import PACKING

__all__ = [
    "CONVENTIONS",
    "MAPPING",
    "ORDERED",
    "Grid",
    "Part",
    "axis_attributes",
    "dataset_attributes",
    "is_ordered",
    "packing_of",
    "parts_of",
    "said_of",
    "scale_of",
    "values_of",
]

#: What a Dataset follows.
CONVENTIONS = "CF-1.11"

#: Metadata that are true of rows and columns in their order only.
ORDERED = ("faces", "poles", "turn")

#: Metadata that say where heights lie.
_PLACE = ("grid", "axes", "geotransform")

#: Names that only what they stand for has.
_RESERVED = frozenset(("x", "y", "xc", "yc", MAPPING))

#: Attributes that tags do not make: what says how values are stored, which are decoded here; names of other variables,
#: which may not be there; and what the libraries write themselves.
_NO_ATTRIBUTES = frozenset(
    (
        *(*PACKING, "dtype", *REFERENCES, "ancillary_variables"),
        *("CLASS", "NAME", "REFERENCE_LIST", "DIMENSION_LIST", "_NCProperties", "_nc3_strict"),
        *("_Netcdf4Dimid", "_Netcdf4Coordinates", "_ARRAY_DIMENSIONS"),
    )
)

#: Characters that no name of an attribute has in NetCDF; names of variables have fewer, as CF advises.
_NO_NAME = re.compile(r"[\x00-\x1f\x7f/]|^\s|\s$|^$")
_UNSAFE = re.compile(r"[^\w.+@-]|^[^A-Za-z_]+", re.ASCII)

_EAST = {"standard_name": "longitude", "long_name": "longitude", "units": "degrees_east", "axis": "X"}
_NORTH = {"standard_name": "latitude", "long_name": "latitude", "units": "degrees_north", "axis": "Y"}


def is_ordered(metadata: Mapping[str, Any]) -> bool:
    """Return whether a Dataset needs numbers of rows and columns, which tell whether they are as they were."""
    return any(metadata.get(key) for key in ORDERED)


@dataclass(frozen=True)
class Grid:
    """What is known of one block before its values are.

    Attributes
    ----------
    shape : (int, int)
    closed : (bool, bool)
    channels : int
        Numbers at a point, without attributes; 0 for heights of shape (H, W).
    dtype : numpy dtype
        Of the points.
    attributes : tuple of (name, dtype, components)
        Components are 0 for an array (H, W), otherwise K of (H, W, K).
    holes : bool
        Whether there may be any.
    metadata : mapping
        Of the surface.
    unwrapped : bool
        Whether points have the angles that metadata say were unwrapped so, rather than those of their file.
    """

    shape: tuple[int, int]
    closed: Closed
    channels: int
    dtype: np.dtype[Any]
    attributes: tuple[tuple[str, np.dtype[Any], int], ...]
    holes: bool
    metadata: Mapping[str, Any]
    unwrapped: bool = True

    @classmethod
    def of(cls, block: Block, metadata: Mapping[str, Any]) -> Grid:
        """That of a block in memory."""
        attributes = tuple(
            (name, values.dtype, values.shape[2] if values.ndim == 3 else 0)
            for name, values in block.attributes.items()
        )
        channels = block.points.shape[2] if block.points.ndim == 3 else 0
        dtype = block.points.dtype
        return cls(block.shape, block.closed, channels, dtype, attributes, block.mask is not None, metadata)

    @property
    def shown(self) -> np.dtype[Any]:
        """The type that points have in a Dataset: the one of their file, if unwrapping angles needed another."""
        name = self.metadata.get("dtype")
        return np.dtype(name) if self.channels and isinstance(name, str) and name in DTYPES else self.dtype

    @property
    def dims(self) -> tuple[str, str]:
        """Names of the dimensions of rows and columns."""
        if self.channels:
            return "row", "column"
        return ("x", "y") if _x_axis(self.metadata) == 0 else ("y", "x")

    @property
    def has_place(self) -> bool:
        """Whether there is something to say in a grid mapping."""
        return bool(self.metadata.get("crs")) or (not self.channels and self._transform is not None)

    @property
    def mapping(self) -> dict[str, Any]:
        """Attributes of the grid mapping; its geotransform is that of heights, of which it says all places."""
        transform = None if self.channels else self._transform
        return grid_mapping({"crs": self.metadata.get("crs"), "geotransform": transform})

    @property
    def _transform(self) -> Any:
        """The geotransform; None where it does not say where rows and columns are, as of levels that are not even."""
        return None if "nodes" in self.metadata else self.metadata.get("geotransform")


@dataclass(frozen=True)
class Part:
    """One variable.

    Attributes
    ----------
    name : str
    dims : tuple of str
    shape : tuple of int
    dtype : numpy dtype
        As it stands in a Dataset: floats for integers with holes, which are NaN.
    stored : numpy dtype
        That of the values, without regard to holes.
    channel : int or None
        The channel of the points; None for heights, and for what has no values of points.
    attribute : str or None
        The attribute of the surface.
    rows : callable or None
        Gives values that follow from the metadata, of some rows, a slice of the first dimension; or the single number.
        None: the values are those of a block, see `values_of`.
    coordinate : bool
        Whether it is a coordinate.
    holes : bool
        Whether values may be missing.
    angle : (float, float) or None
        The full turn of angles that were unwrapped, and the least of them in the file.
    attrs : dict
    source : str
        The name that it would have if it were free, and allowed by the conventions.
    """

    name: str
    dims: tuple[str, ...]
    shape: tuple[int, ...]
    dtype: np.dtype[Any]
    stored: np.dtype[Any]
    channel: int | None = None
    attribute: str | None = None
    rows: Rows | None = None
    coordinate: bool = False
    holes: bool = False
    angle: tuple[float, float] | None = None
    attrs: dict[str, Any] = field(default_factory=dict)
    source: str = ""

    @property
    def is_main(self) -> bool:
        """Whether it is the heights, or z."""
        return self.rows is None and self.attribute is None and self.channel in (None, 2)

    @property
    def is_number(self) -> bool:
        """Whether it is one of the single numbers of the metadata."""
        return not self.dims and self.name != MAPPING

    @property
    def is_index(self) -> bool:
        """Whether it is the coordinate of a dimension of its name."""
        return self.dims == (self.name,)


def parts_of(grid: Grid) -> list[Part]:
    """Return the variables of a block, the heights (or z) first where it has any, coordinates last.

    Raises
    ------
    InputError
        If the metadata hold no rules of coordinates, but something in their place.
    """
    data, taken = _data_parts(grid)
    places = _points_as_coordinates(grid) if grid.channels else _coordinates_of_heights(grid)
    if is_ordered(grid.metadata):
        for dim, name, length in zip(grid.dims, ("row", "column"), grid.shape, strict=True):
            places.append(_known(name, (dim,), np.arange(length)))
    if grid.has_place:
        places.append(
            _known(MAPPING, (), np.array(0, np.int64), beside_crs(said_of(grid.metadata, MAPPING)) | grid.mapping)
        )
    for name, number in numbers_in(grid.metadata).items():
        if name not in taken and not _UNSAFE.search(name):
            places.append(_known(name, (), np.array(number), said_of(grid.metadata, name)))
    return data + places


def _data_parts(grid: Grid) -> tuple[list[Part], set[str]]:
    """Return heights, or z, and attributes; and the names that are taken, as they were asked for and as they became."""
    dims, shape = grid.dims, grid.shape
    taken = {*_RESERVED, *dims}
    taken |= {"row", "column"} if is_ordered(grid.metadata) else set()
    dtype = _with_nan(grid.shown) if grid.holes else grid.shown
    parts: list[Part] = []
    name = grid.metadata.get("variable")
    source = name if isinstance(name, str) and name else "z"
    heights = _free(source, taken)
    unit = grid.metadata.get("unit")
    attrs = (
        said_of(grid.metadata, source) | ({"units": unit} if isinstance(unit, str) else {}) | scale_of(grid.metadata)
    )
    if grid.channels != 2:
        channel = 2 if grid.channels else None
        parts.append(
            Part(heights, dims, shape, dtype, grid.shown, channel, holes=grid.holes, attrs=attrs, source=source)
        )
    further = [(_free(f"attribute_{k - 3}", taken), k) for k in range(3, grid.channels)]
    parts += [Part(label, dims, shape, grid.dtype, grid.dtype, channel=k) for label, k in further]
    for source, kind, components in grid.attributes:
        label = _free(source, taken)
        over = (*dims, _free(f"{label}_component", taken)) if components else dims
        lengths = (*shape, components) if components else shape
        said = {} if source in _RESERVED else said_of(grid.metadata, source)  # these tags are those of x and y
        said |= scale_of(grid.metadata, source)
        parts.append(Part(label, over, lengths, kind, kind, attribute=source, attrs=said, source=source))
    return parts, taken | {"row", "column"} | {source for source, *_ in grid.attributes}


def _points_as_coordinates(grid: Grid) -> list[Part]:
    """x and y of points."""
    dtype = _with_nan(grid.shown) if grid.holes else grid.shown
    given = angles_of(grid.metadata) if grid.unwrapped else []
    angles = {number: (period, low) for number, period, low in given}
    letters = axis_attributes(grid)
    return [
        Part(
            letter,
            grid.dims,
            grid.shape,
            dtype,
            grid.shown,
            channel,
            coordinate=True,
            holes=grid.holes,
            angle=angles.get(channel),
            attrs=letters[letter],
        )
        for channel, letter in enumerate("xy")
    ]


def _coordinates_of_heights(grid: Grid) -> list[Part]:
    """x and y of heights: each along one axis, or of a rotated raster both, under the names of rioxarray; or none."""
    metadata = grid.metadata
    if not any(metadata.get(key) for key in _PLACE):
        return []
    letters, x_axis = axis_attributes(grid), _x_axis(metadata)
    if x_axis is not None:
        lines = _lines(grid, x_axis)
        return [_known(letter, (letter,), line, letters[letter]) for letter, line in zip("xy", lines, strict=True)]
    whole = Surface(np.broadcast_to(np.zeros((), grid.dtype), grid.shape), metadata=dict(metadata))
    first = coordinates(whole, slice(0, 1))

    def of(channel: int) -> Rows:
        return lambda rows: coordinates(whole, slice(*rows.indices(grid.shape[0])[:2]))[channel]

    return [
        Part(
            f"{letter}c",
            grid.dims,
            grid.shape,
            first[channel].dtype,
            first[channel].dtype,
            rows=of(channel),
            coordinate=True,
            attrs=letters[letter],
        )
        for channel, letter in enumerate("xy")
    ]


def _known(name: str, dims: tuple[str, ...], values: NDArray[Any], attrs: Mapping[str, Any] | None = None) -> Part:
    """Return a small coordinate whose values are there."""
    rows = values.__getitem__ if dims else lambda _: values
    dtype = values.dtype
    return Part(name, dims, values.shape, dtype, dtype, rows=rows, coordinate=True, attrs=dict(attrs or {}))


def values_of(block: Block, part: Part, rows: slice = slice(None), fill: Any = None) -> NDArray[Any]:
    """Return the values of a variable: shape (row, column), or (row, column, K) of an attribute with components.

    Parameters
    ----------
    block : Block
    part : Part
        One whose values are those of a block.
    rows : slice
    fill : number of the type in which they are stored, optional
        What stands for missing values; None: NaN, in the type of the part.

    Raises
    ------
    FormatError
        If integers with holes need more bits than the float that has NaN.
    """
    if part.attribute is not None:
        return block.attributes[part.attribute][rows]
    points = block.points[rows] if part.channel is None else block.points[rows, ..., part.channel]
    if part.angle is not None:
        points = wrapped(points, *part.angle)
    if block.mask is None or not part.holes:
        return points.astype(part.stored, copy=False)
    hidden = ~block.mask[rows] if block.kept is None else ~(block.mask[rows] | block.kept[rows])
    if fill is not None and not np.isnan(fill):
        values = points.astype(part.stored)
        values[hidden | np.isnan(values)] = fill
        return values
    if points.dtype != part.dtype and not survives(points[~hidden], part.dtype):
        raise FormatError(f"expected integers that {part.dtype} holds, since holes are NaN in xarray, got larger ones")
    values = points.astype(part.dtype)
    values[hidden] = np.nan
    return values


def packing_of(block: Block, part: Part, nodata: Any) -> dict[str, Any]:
    """Return how a file stores a variable with holes, as xarray has it in an encoding; empty where none is missing.

    Integers with holes are integers again where one of them is no value, and floats with NaN where every one is.

    Parameters
    ----------
    block : Block
    part : Part
    nodata
        What stands for missing heights where it can, see `fill_of`.
    """
    if block.mask is None or not part.holes:
        return {}
    known = block.mask if block.kept is None else block.mask | block.kept

    def stored(rows: slice) -> NDArray[Any]:
        points = block.points[rows] if part.channel is None else block.points[rows, ..., part.channel]
        return (points if part.angle is None else wrapped(points, *part.angle)).astype(part.stored, copy=False)

    fill = fill_of(stored, part.stored, known, nodata if part.is_main else None)
    if fill is None or part.stored == part.dtype:
        return {"_FillValue": part.dtype.type(np.nan) if fill is None else fill}
    return {"dtype": part.stored.name, "_FillValue": fill}


def _with_nan(dtype: np.dtype[Any]) -> np.dtype[Any]:
    """Return the type of floats for values of this type, some of which are NaN."""
    if dtype.kind == "f":
        return dtype
    return np.dtype(np.float32 if dtype.itemsize < 4 else np.float64)


def _free(name: str, taken: set[str]) -> str:
    """Return a name like this one that CF allows and nothing has yet."""
    name = _UNSAFE.sub("_", name) or "_"
    while name in taken:
        name += "_"
    taken.add(name)
    return name


def said_of(metadata: Mapping[str, Any], name: str) -> dict[str, Any]:
    """Return the attributes that tags make for a variable, for x or y, or for the file (NC_GLOBAL)."""
    said = attributes_of(metadata, name).items()
    return {key: _plain(it) for key, it in said if key not in _NO_ATTRIBUTES and not _NO_NAME.search(key)}


def scale_of(metadata: Mapping[str, Any], attribute: str | None = None) -> dict[str, float]:
    """Return by what stored numbers of the heights or of an attribute are multiplied, and what is added.

    Returns
    -------
    dict
        ``scale_factor`` and ``add_offset``; empty: they are the values.
    """
    bands = metadata.get("bands")
    said: Any = metadata if attribute is None else bands.get(attribute) if isinstance(bands, Mapping) else None
    if not isinstance(said, Mapping) or not {"scale", "offset"} & set(said):
        return {}
    numbers = said.get("scale", 1.0), said.get("offset", 0.0)
    if not all(isinstance(number, int | float) for number in numbers):
        return {}
    return {"scale_factor": float(numbers[0]), "add_offset": float(numbers[1])}


def _plain(value: Any) -> Any:
    """Return a text, a list of texts or numbers, as NetCDF has them; what else JSON can say as a text of it."""
    if isinstance(value, str | int | float | np.ndarray | np.generic) and not isinstance(value, bool):
        return value
    texts = isinstance(value, list) and bool(value) and all(isinstance(word, str) for word in value)
    return value if texts else json.dumps(value)


def dataset_attributes(grid: Grid) -> dict[str, Any]:
    """Return the attributes of the Dataset or of the file, without the mark."""
    name = grid.metadata.get("name")
    title = {"title": name} if isinstance(name, str) and name else {}
    return title | said_of(grid.metadata, "NC_GLOBAL") | {"Conventions": CONVENTIONS}


def axis_attributes(grid: Grid) -> dict[str, dict[str, Any]]:
    """Return the attributes of x and y: by the conventions, and as a file said (tags ``x#units``, ...)."""
    crs = grid.metadata.get("crs")
    degrees = {number for number, *_ in angles_of(grid.metadata)}
    x, y = (said_of(grid.metadata, letter) for letter in "xy")
    if is_rotated(crs):
        return {"x": axis_words("x", crs) | {"axis": "X"} | x, "y": axis_words("y", crs) | {"axis": "Y"} | y}
    if is_geographic(crs) or degrees == {0} or (not crs and is_east(x.get("units"))):
        return {"x": _EAST | x, "y": _NORTH | y}
    words = {letter: {"standard_name": f"projection_{letter}_coordinate"} if crs or degrees else {} for letter in "xy"}
    return {"x": {**words["x"], "axis": "X"} | x, "y": {**words["y"], "axis": "Y"} | y}


def _x_axis(metadata: Mapping[str, Any]) -> int | None:
    """Return the axis that x of heights runs along; None where x and y depend on both, or there are none.

    Raises
    ------
    InputError
        If the metadata hold no such rules.
    """
    if not any(metadata.get(key) for key in _PLACE):
        return None
    try:
        return _axis_of_rules(metadata)
    except (TypeError, ValueError, LookupError):  # whoever made the container may have written anything
        said = {key: metadata[key] for key in _PLACE if key in metadata}
        raise InputError(f"expected rules of coordinates in the metadata, got {str(said)[:80]!a}") from None


def _axis_of_rules(metadata: Mapping[str, Any]) -> int | None:
    if "grid" not in metadata and "axes" in metadata:
        axes = metadata["axes"]
        return 0 if isinstance(axes, Mapping) and axes.get("rows") == "x" else 1
    if "grid" in metadata:
        rules: Sequence[Any] = metadata["grid"]
    else:
        transform = metadata["geotransform"]
        rules = [[transform[0], *transform[1:3], 0.5], [transform[3], *transform[4:6], 0.5]]
    found = []
    for own, rule in zip((1, 0), rules, strict=True):
        if len(rule) != 4 or rule[-1] == VALUES:
            found.append(own)
        elif rule[1] and rule[2]:
            return None
        else:
            found.append(0 if rule[2] else 1)
    return found[0] if found[0] != found[1] else None


def _lines(grid: Grid, x_axis: int) -> tuple[NDArray[Any], NDArray[Any]]:
    """x and y of heights, each along its axis.

    Raises
    ------
    InputError
        If the metadata hold no such rules.
    """
    metadata, shape = grid.metadata, grid.shape
    lines = []
    for axis in (0, 1):
        size = (shape[0], 1) if axis == 0 else (1, shape[1])
        thin = (max(size[0], 2 - size[1] + 1), size[1]) if size == (1, 1) else size
        nodes = metadata.get("nodes")
        near = {**metadata, "nodes": [at and at[: thin[k]] for k, at in enumerate(nodes)]} if nodes else metadata
        planes = coordinates(Surface(np.zeros(thin, grid.dtype), metadata=dict(near)))
        lines.append([plane[: size[0], : size[1]].reshape(-1) for plane in planes])
    return np.array(lines[x_axis][0]), np.array(lines[1 - x_axis][1])
