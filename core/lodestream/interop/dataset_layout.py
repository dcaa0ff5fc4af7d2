"""How a surface lies in an xarray Dataset: which arrays there are, over which dimensions, under which names.

Heights are a variable over ``y`` and ``x``, whose coordinates follow from the metadata. x, y, z are a variable z over
``row`` and ``column`` with x and y as coordinates of both. Attributes are variables beside them. The attribute
``lodestream`` of the Dataset holds, as JSON, what has no other place.
"""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..coordinates.coordinate_rules import VALUES
from ..coordinates.height_fields import coordinates
from ..coordinates.seams import wrapped
from ..errors import FormatError
from ..formats.netcdf.attribute_texts import attributes_of
from ..formats.netcdf.single_numbers import SCALARS, numbers_in
from ..formats.netcdf.values import PACKING
from ..formats.notes import survives, warn
from ..surface import DTYPES, Block, Closed, Surface

__all__ = [
    "MARK",
    "ORDERED",
    "Axes",
    "Grid",
    "Part",
    "axes_of",
    "in_json",
    "is_ordered",
    "mark_of",
    "parts_of",
    "said_of",
    "single_of",
    "values_of",
]

#: The attribute of a Dataset that holds what has no other place.
MARK = "lodestream"

#: Metadata that coordinates say, or that stand in attributes of the CF conventions.
_TOLD = ("geotransform", "grid", "axes", "nodes", "crs", "unit", "tags", "angles", "dtype")

#: What metadata say of angles that were unwrapped.
_ANGLE = ("channel", "period", "low")

#: Metadata that are true of rows and columns in their order only.
ORDERED = ("faces", "poles", "turn")

#: What tags say of the values of a file, which are decoded here, and what xarray has in the encoding of a variable.
_OF_THE_FILE = frozenset((*PACKING, "dtype", "coordinates", "grid_mapping"))


def is_ordered(metadata: Mapping[str, Any]) -> bool:
    """Whether a Dataset needs numbers of rows and columns, which tell whether they are as they were."""
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
    """

    shape: tuple[int, int]
    closed: Closed
    channels: int
    dtype: np.dtype[Any]
    attributes: tuple[tuple[str, np.dtype[Any], int], ...]
    holes: bool
    metadata: Mapping[str, Any]

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
        axes = axes_of(self)
        return ("x", "y") if axes is not None and axes.x_axis == 0 else ("y", "x")


@dataclass(frozen=True)
class Part:
    """One variable of a Dataset.

    Attributes
    ----------
    name : str
    dims : tuple of str
    dtype : numpy dtype
        As it stands in the Dataset: floats for integers with holes, which are NaN.
    channel : int or None
        The channel of the points; None for heights and attributes.
    attribute : str or None
        The attribute of the surface.
    coordinate : bool
        Whether it is x or y.
    angle : (float, float) or None
        The full turn of angles that were unwrapped, and the least of them in the file.
    attrs : dict
    """

    name: str
    dims: tuple[str, ...]
    dtype: np.dtype[Any]
    channel: int | None = None
    attribute: str | None = None
    coordinate: bool = False
    angle: tuple[float, float] | None = None
    attrs: dict[str, Any] = field(default_factory=dict)


def parts_of(grid: Grid) -> list[Part]:
    """The variables of a block, the heights (or z) first where it has any."""
    dims = grid.dims
    taken = {"x", "y", "xc", "yc", "spatial_ref", *dims}
    taken |= {"row", "column"} if is_ordered(grid.metadata) else set()
    dtype = _with_nan(grid.shown) if grid.holes else grid.shown
    parts: list[Part] = []
    name = grid.metadata.get("variable")
    heights = _free(name if isinstance(name, str) and name else "z", taken)
    unit = grid.metadata.get("unit")
    attrs = said_of(grid.metadata, heights) | ({"units": unit} if isinstance(unit, str) else {})
    if not grid.channels:
        parts.append(Part(heights, dims, dtype, attrs=attrs))
    elif grid.channels > 2:
        parts.append(Part(heights, dims, dtype, channel=2, attrs=attrs))
    parts += [Part(_free(f"attribute_{k - 3}", taken), dims, grid.dtype, channel=k) for k in range(3, grid.channels)]
    for own, kind, components in grid.attributes:
        label = _free(own, taken)
        shape = (*dims, _free(f"{label}_component", taken)) if components else dims
        parts.append(Part(label, shape, kind, attribute=own, attrs=said_of(grid.metadata, own)))
    letters = "xy" if grid.channels else ""
    angles = _angles(grid.metadata)
    return parts + [Part(it, dims, dtype, k, coordinate=True, angle=angles.get(k)) for k, it in enumerate(letters)]


def _angles(metadata: Mapping[str, Any]) -> dict[int, tuple[float, float]]:
    """The channels of angles that were unwrapped; whoever made the container may have written anything."""
    found = {}
    for angle in given if isinstance(given := metadata.get("angles"), Sequence) else ():
        if isinstance(angle, Mapping) and all(isinstance(angle.get(key), int | float) for key in _ANGLE):
            channel, period, low = (angle[key] for key in _ANGLE)
            found[int(channel)] = float(period), float(low)
    return found


def values_of(block: Block, part: Part) -> NDArray[Any]:
    """The values of a variable: shape (H, W), or (H, W, K) of an attribute with components; NaN in holes.

    Raises
    ------
    FormatError
        If integers with holes need more bits than the float that has NaN.
    """
    if part.attribute is not None:
        return block.attributes[part.attribute]
    points = block.points if part.channel is None else block.points[..., part.channel]
    if part.angle is not None:
        points = wrapped(points, *part.angle)
    if block.mask is None or part.dtype.kind != "f" or (part.channel or 0) > 2:
        return points.astype(part.dtype, copy=False)
    hidden = ~block.mask if block.kept is None else ~(block.mask | block.kept)
    if points.dtype != part.dtype and not survives(points[~hidden], part.dtype):
        raise FormatError(f"expected integers that {part.dtype} holds, since holes are NaN in xarray, got larger ones")
    values = points.astype(part.dtype)
    values[hidden] = np.nan
    return values


def _with_nan(dtype: np.dtype[Any]) -> np.dtype[Any]:
    """The type of floats for values of this type, some of which are NaN."""
    if dtype.kind == "f":
        return dtype
    return np.dtype(np.float32 if dtype.itemsize < 4 else np.float64)


def _free(name: str, taken: set[str]) -> str:
    while name in taken:
        name += "_"
    taken.add(name)
    return name


def said_of(metadata: Mapping[str, Any], name: str) -> dict[str, Any]:
    """What tags of a NetCDF say of one variable."""
    return {key: value for key, value in attributes_of(metadata, name).items() if key not in _OF_THE_FILE}


@dataclass(frozen=True)
class Axes:
    """Coordinates of a height field that each run along one axis.

    Attributes
    ----------
    x, y : arrays of shape (length of the axis,)
    x_axis : {0, 1}
        The axis that x runs along; y runs along the other.
    """

    x: NDArray[Any]
    y: NDArray[Any]
    x_axis: int


def axes_of(grid: Grid) -> Axes | None:
    """The coordinates of heights by row and by column; None where they have none, or x and y depend on both.

    Raises
    ------
    InputError
        If the metadata hold no such rules.
    """
    metadata, shape = grid.metadata, grid.shape
    if grid.channels or not any(metadata.get(key) for key in ("grid", "axes", "geotransform")):
        return None
    runs = _runs(metadata)
    if runs is None:
        return None
    lines = []
    for axis in (0, 1):
        size = (shape[0], 1) if axis == 0 else (1, shape[1])
        thin = (max(size[0], 2 - size[1] + 1), size[1]) if size == (1, 1) else size
        nodes = metadata.get("nodes")
        own = {**metadata, "nodes": [at and at[: thin[k]] for k, at in enumerate(nodes)]} if nodes else metadata
        planes = coordinates(Surface(np.zeros(thin, grid.dtype), metadata=own))
        lines.append([plane[: size[0], : size[1]].reshape(-1) for plane in planes])
    return Axes(np.array(lines[runs][0]), np.array(lines[1 - runs][1]), runs)


def _runs(metadata: Mapping[str, Any]) -> int | None:
    """The axis that x runs along; None where x or y change along both, or along the same."""
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


def mark_of(grid: Grid, parts: Sequence[Part]) -> str:
    """What the Dataset's attribute `MARK` holds, as JSON."""
    heights = next((part.name for part in parts if part.attribute is None and part.channel in (None, 2)), None)
    names = {part.name: part.attribute for part in parts if part.attribute is not None}
    metadata, lost = in_json({key: value for key, value in grid.metadata.items() if key not in _TOLD})
    if lost:
        warn(f"the Dataset is made without {', '.join(lost)}, which JSON cannot hold")
    mark = {"shape": list(grid.shape), "closed": list(grid.closed), "dims": list(grid.dims)}
    mark |= {"variable": heights, "attributes": names}
    rest = {key: value for key, value in _scalars(grid).items() if key not in single_of(grid, parts)}
    metadata = {key: value for key, value in metadata.items() if key != SCALARS} | ({SCALARS: rest} if rest else {})
    tags = _other_tags(grid, parts)
    return json.dumps(mark | {"metadata": metadata | ({"tags": tags} if tags else {})})


def single_of(grid: Grid, parts: Sequence[Part]) -> dict[str, float | int]:
    """The single numbers that are coordinates of a Dataset: those whose names nothing else has."""
    taken = {*grid.dims, "x", "y", "xc", "yc", "row", "column", "spatial_ref"}
    taken |= {name for part in parts for name in (part.name, part.attribute or part.name, *part.dims)}
    return {name: number for name, number in numbers_in(grid.metadata).items() if name not in taken}


def _scalars(grid: Grid) -> Mapping[str, Any]:
    scalars = grid.metadata.get(SCALARS)
    return scalars if isinstance(scalars, Mapping) else {}


def in_json(metadata: Mapping[str, Any]) -> tuple[dict[str, Any], list[str]]:
    """The metadata that JSON can hold, and the keys of the others."""
    kept, lost = {}, []
    for key, value in metadata.items():
        try:
            json.dumps(value)
        except (TypeError, ValueError):
            lost.append(str(key))
        else:
            kept[key] = value
    return kept, lost


def _other_tags(grid: Grid, parts: Sequence[Part]) -> dict[str, Any]:
    """The tags that stand in no attribute of the Dataset or of a variable."""
    tags = grid.metadata.get("tags")
    if not isinstance(tags, Mapping):
        return {}
    names = [*(part.attribute or part.name for part in parts if not part.coordinate), *single_of(grid, parts)]
    told = {f"{name}#{key}" for name in names for key in said_of(grid.metadata, name)}
    texts = tags.get("")
    plain = texts
    if isinstance(texts, Mapping):
        plain = {k: v for k, v in texts.items() if not str(k).startswith("NC_GLOBAL#") and k not in told}
    return {key: value for key, value in {**tags, "": plain}.items() if value}
