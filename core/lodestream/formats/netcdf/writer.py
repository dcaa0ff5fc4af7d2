"""NetCDF-4, written by the CF conventions: heights over x and y, attributes as variables beside them.

Source: NetCDF Climate and Forecast (CF) Metadata Conventions 1.11, and what GDAL's netCDF driver reads of a CRS.
"""

from __future__ import annotations

import re
import shutil
import tempfile
import warnings
from collections.abc import Mapping
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np
from numpy.typing import NDArray

from ...coordinates.height_fields import coordinates
from ...errors import FormatError, UnavailableError
from ...surface import Surface
from ..notes import listing, metadata_left_out, warn, warn_left_out

__all__ = ["write"]

_PLACE = ("geotransform", "grid", "axes")
_HELD = (*_PLACE, "crs", "unit", "tags", "nodata", "variable")

#: What our own variables say; a tag of the same name is left out.
_OURS = frozenset(
    [
        "units",
        "standard_name",
        "axis",
        "coordinates",
        "grid_mapping",
        "ancillary_variables",
        "Conventions",
        "crs_wkt",
        "spatial_ref",
        "GeoTransform",
        "_FillValue",
        "missing_value",
        "scale_factor",
        "add_offset",
        "_Unsigned",
    ]
)

#: The name of a file's own attributes among GDAL's.
_GLOBAL = "NC_GLOBAL"

#: Units of CF for the coordinates of a geographic CRS, and their standard names.
_DEGREES = {"x": ("longitude", "degrees_east"), "y": ("latitude", "degrees_north")}

_UNSAFE = re.compile(r"[^\w.+@-]|^[^A-Za-z_]+", re.ASCII)
_DEFLATE = {"zlib": True, "complevel": 1, "shuffle": True}


def write(surface: Surface, file: BinaryIO) -> None:
    """Write heights, or z over two-dimensional x and y; planar points as x and y alone.

    Holes are ``_FillValue``: NaN, or a number that no height has. A CRS is a grid mapping with its WKT.

    Raises
    ------
    UnavailableError
        If xarray or h5netcdf is not installed.
    FormatError
        If these refuse what the surface is called.
    """
    try:
        import h5netcdf  # noqa: F401 - for a better message than xarray's
        import xarray
    except ImportError:
        raise UnavailableError(
            "expected xarray and h5netcdf for NetCDF, which are not both installed: install lodestream[formats]"
        ) from None
    names = _Names(surface)
    variables, coordinates_ = _variables(surface, names)
    closed = ["closure"] * any(surface.closed)
    lost = _add_tags(surface, names, variables)
    warn_left_out("NetCDF", [*closed, *lost, *metadata_left_out(surface, _HELD)])
    if names.changed:
        warn(f"NetCDF is written with {listing(names.changed)}")
    encoding: dict[str, Any] = {name: dict(_DEFLATE) for name, (dims, *_) in variables.items() if len(dims) > 1}
    for name, (_, _, attributes) in variables.items():
        fill = attributes.pop("_FillValue", None)
        encoding.setdefault(name, {})["_FillValue"] = fill
    attributes = {"Conventions": "CF-1.11"} | names.of_file
    if isinstance(surface.metadata.get("name"), str):
        attributes = {"title": surface.metadata["name"]} | attributes
    with tempfile.TemporaryDirectory(prefix="lodestream-") as folder, warnings.catch_warnings():
        warnings.simplefilter("ignore")  # of xarray, about what other programs may not read
        path = Path(folder) / "data.nc"
        try:
            dataset = xarray.Dataset(variables, attrs=attributes).set_coords(coordinates_)
            dataset.to_netcdf(path, engine="h5netcdf", encoding=encoding)
        except (ValueError, TypeError, KeyError) as error:
            raise FormatError(f"expected a surface that NetCDF can hold, got one that it refuses: {error}") from None
        with path.open("rb") as written:
            shutil.copyfileobj(written, file)


class _Names:
    """The names of variables, each once and as CF allows them, and attributes of the file."""

    def __init__(self, surface: Surface) -> None:
        self.geographic = _is_geographic(surface.metadata.get("crs"))
        self.x, self.y = ("lon", "lat") if self.geographic else ("x", "y")
        self.changed: list[str] = []
        self.of_file: dict[str, str] = {}
        self._taken = {self.x, self.y, "crs"}
        self.main = self.new(str(surface.metadata.get("variable") or "height"))
        self.attributes = {name: self.new(name) for name in surface.attributes}

    def new(self, name: str) -> str:
        """A name like this one that is still free."""
        free = _UNSAFE.sub("_", name) or "_"
        while free in self._taken:
            free += "_"
        self._taken.add(free)
        if free != name:
            self.changed.append(f"{name} as {free}")
        return free


def _variables(surface: Surface, names: _Names) -> tuple[dict[str, Any], list[str]]:
    """Dimensions, values and attributes of each variable by its name, and which are coordinates."""
    points, mask, metadata = surface.points, surface.mask, surface.metadata
    variables: dict[str, Any] = {}
    placed = any(metadata.get(key) is not None for key in _PLACE)
    dims = (names.y, names.x)
    if points.ndim == 3:
        planes: list[NDArray[Any]] = [points[..., 0], points[..., 1]]
        dims = ("row", "column")
    else:
        planes = list(coordinates(surface)) if placed else []
    vectors = [_vector(plane, axis) for plane, axis in zip(planes, (1, 0), strict=False)] if points.ndim == 2 else []
    if any(vector is None for vector in vectors):
        dims = ("row", "column")
    for letter, name, plane, number in zip("xy", (names.x, names.y), planes, (0, 1), strict=False):
        said = _axis(letter, names.geographic, bool(metadata.get("crs")))
        vector = vectors[number] if dims[1] == names.x else None
        if vector is not None:
            variables[name] = ((dims[1 - number],), vector, {**said, "axis": letter.upper()})
        else:
            variables[name] = (dims, *_filled(plane, mask, said))
    beside = {"coordinates": f"{names.y} {names.x}"} if dims[0] == "row" and planes else {}
    if metadata.get("crs"):
        beside["grid_mapping"] = "crs"
        variables["crs"] = ((), np.int32(0), _mapping(surface))
    if points.ndim == 2 or points.shape[2] > 2:
        heights = points if points.ndim == 2 else points[..., 2]
        said = {"units": metadata["unit"]} if isinstance(metadata.get("unit"), str) else {}
        values, attributes = _filled(heights, mask, said, metadata.get("nodata"))
        others = [*names.attributes.values()]
        attributes |= {"ancillary_variables": " ".join(others)} if others else {}
        variables[names.main] = (dims, values, attributes)
    for channel in range(3, points.shape[2] if points.ndim == 3 else 0):
        variables[names.new(f"attribute_{channel - 3}")] = (dims, points[..., channel], {})
    for name, array in surface.attributes.items():
        own = names.attributes[name]
        variables[own] = ((*dims, f"{own}_component")[: array.ndim], array, {})
    for name, (of, _, attributes) in variables.items():
        if of[:2] == dims and name not in (names.x, names.y):
            attributes.update(beside)
    return variables, [name for name in (names.x, names.y) if name in variables]


def _vector(plane: NDArray[Any], axis: int) -> NDArray[Any] | None:
    """The line of a coordinate (H, W) along an axis; None where it differs from line to line."""
    line = plane[0] if axis == 1 else plane[:, 0]
    whole = np.broadcast_to(line[None, :] if axis == 1 else line[:, None], plane.shape)
    return np.ascontiguousarray(line) if np.array_equal(plane, whole) else None


def _axis(letter: str, geographic: bool, located: bool) -> dict[str, str]:
    if geographic:
        standard, units = _DEGREES[letter]
        return {"standard_name": standard, "units": units}
    return {"standard_name": f"projection_{letter}_coordinate"} if located else {}


def _filled(
    values: NDArray[Any], mask: NDArray[np.bool_] | None, said: Mapping[str, Any], nodata: Any = None
) -> tuple[NDArray[Any], dict[str, Any]]:
    """Values with those of holes replaced, and the attributes of their variable."""
    if mask is None:
        return values, dict(said)
    fill = _fill(values, mask, nodata)
    if fill is None:
        warn(f"NetCDF is written with values in {int((~mask).sum()):,} holes, since the heights have every number")
        return values, dict(said)
    return np.where(mask, values, fill), {**said, "_FillValue": fill}


def _fill(values: NDArray[Any], mask: NDArray[np.bool_], nodata: Any) -> Any:
    """The value of holes, in the type of the values: the given one, NaN, or an integer that none of them is."""
    dtype, valid = values.dtype, values[mask]
    candidates: list[float] = [nodata] if isinstance(nodata, int | float) and np.isfinite(nodata) else []
    if dtype.kind == "f":
        fits = [dtype.type(it) for it in candidates if abs(it) <= np.finfo(dtype).max]
        return next((it for it in fits if not (valid == it).any()), dtype.type(np.nan))
    limits = np.iinfo(dtype)
    candidates += [-9999, limits.min, limits.max]
    if valid.size:
        candidates += [int(valid.min()) - 1, int(valid.max()) + 1]
    for it in candidates:
        if it == int(it) and limits.min <= it <= limits.max and not (valid == dtype.type(int(it))).any():
            return dtype.type(int(it))
    return None


def _mapping(surface: Surface) -> dict[str, Any]:
    """What the variable of the CRS says: its WKT under both names in use, and the place for GDAL."""
    wkt = str(surface.metadata["crs"])
    attributes: dict[str, Any] = {"crs_wkt": wkt, "spatial_ref": wkt}
    transform = surface.metadata.get("geotransform")
    if surface.points.ndim == 2 and transform is not None and "nodes" not in surface.metadata:
        attributes["GeoTransform"] = " ".join(repr(float(value)) for value in transform)
    if _is_geographic(wkt):
        attributes["grid_mapping_name"] = "latitude_longitude"
    return attributes


def _is_geographic(crs: Any) -> bool:
    return isinstance(crs, str) and crs.lstrip().upper().startswith(("GEOGCS", "GEOGCRS", "GEODCRS", "GEOGRAPHICCRS"))


def _add_tags(surface: Surface, names: _Names, variables: Mapping[str, Any]) -> list[str]:
    """Give the file and its variables the attributes that GDAL's tags say they had; what is lost, in words."""
    tags = surface.metadata.get("tags")
    lost = []
    of_variable = {str(surface.metadata.get("variable") or names.main): names.main, **names.attributes}
    for space, values in tags.items() if isinstance(tags, Mapping) else ():
        for key, text in values.items() if isinstance(values, Mapping) else ():
            owner, sharp, name = str(key).partition("#")
            fits = not space and isinstance(text, str) and name and name not in _OURS and not _UNSAFE.search(name)
            if fits and sharp and owner == _GLOBAL:
                names.of_file[name] = text
            elif fits and sharp and of_variable.get(owner) in variables:
                variables[of_variable[owner]][2].setdefault(name, text)
            elif not (sharp and name in _OURS):
                lost.append(f"tag {key}")
    return lost
