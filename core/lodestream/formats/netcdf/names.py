"""Which variables of a NetCDF are x, y or times: by the CF conventions, by their names where a file says nothing."""

from __future__ import annotations

import re
from collections.abc import Mapping
from typing import Any

__all__ = [
    "AXIS_WORDS",
    "axis_words",
    "is_east",
    "is_geographic",
    "is_longitude",
    "is_time",
    "letter_of",
    "letters_of",
    "time_of",
]

_EAST = ("degrees_east", "degree_east", "degrees_e", "degree_e", "degreese", "degreee")
_NORTH = ("degrees_north", "degree_north", "degrees_n", "degree_n", "degreesn", "degreen")

#: What a surface keeps of what a file says of x and y, as tags ``x#units`` and the like.
AXIS_WORDS = ("standard_name", "long_name", "units")

#: Units of CF for the coordinates of a geographic CRS, and their standard names.
_DEGREES = {"x": ("longitude", "degrees_east"), "y": ("latitude", "degrees_north")}

#: What x is called in the files of models (NEMO, ROMS, POP, WRF), with the word for y in its place: before it stand
#: the letters of a staggered grid or a word, behind it such letters or a word.
_MATES = {
    **{"longitudes": "latitudes", "longitude": "latitude", "lons": "lats", "lon": "lat", "long": "lat"},
    **{"eastings": "northings", "easting": "northing", "east": "north", "glam": "gphi", "xx": "yy", "x": "y"},
}
_WORD = r"(?:nav|grid|mesh|nodes?|cells?|points?|coords?|cent(?:er|re)|corners?|geo|rho|psi)"
_X_NAME = re.compile(
    rf"(?P<before>(?:{_WORD}_?)?(?:[xtuvfqcpr](?=l))?)(?P<word>{'|'.join(sorted(_MATES, key=len, reverse=True))})"
    rf"(?P<behind>(?:_?(?:{_WORD}|coord(?:inate)?s?|vert|[a-z0-9]))?)",
    re.IGNORECASE,
)

#: Units of variables that may be a coordinate although nothing says so.
_UNITS = frozenset(("", "1", "m", "km", "metre", "metres", "meter", "meters", "deg", "degree", "degrees"))


def is_geographic(crs: Any) -> bool:
    """Whether a WKT is one of longitudes and latitudes."""
    return isinstance(crs, str) and crs.lstrip().upper().startswith(("GEOGCS", "GEOGCRS", "GEODCRS", "GEOGRAPHICCRS"))


def axis_words(letter: str, crs: Any) -> dict[str, str]:
    """What the conventions say of x or y under a CRS (WKT, or nothing)."""
    if is_geographic(crs):
        standard, units = _DEGREES[letter]
        return {"standard_name": standard, "units": units}
    return {"standard_name": f"projection_{letter}_coordinate"} if crs else {}


def letter_of(name: str, attributes: Mapping[str, Any]) -> str | None:
    """Whether the conventions, or a plain name, make a variable x or y."""
    standard, units = (str(attributes.get(key, "")).lower() for key in ("standard_name", "units"))
    axis = str(attributes.get("axis", "")).upper()
    plain = name.lower()
    if standard in ("longitude", "projection_x_coordinate", "grid_longitude") or units in _EAST or axis == "X":
        return "x"
    if standard in ("latitude", "projection_y_coordinate", "grid_latitude") or units in _NORTH or axis == "Y":
        return "y"
    if plain in ("x", "lon", "longitude", "easting"):
        return "x"
    return "y" if plain in ("y", "lat", "latitude", "northing") else None


def letters_of(dataset: Any) -> dict[str, str]:
    """The variables that are x or y: those of the conventions first, then pairs of names that mean both.

    A pair has the same dimensions, or is of two vectors along different ones; its attributes say nothing else.
    """
    variables = {str(name): variable for name, variable in dataset.variables.items()}
    letters = {name: letter for name, it in variables.items() if (letter := letter_of(name, it.attrs))}
    by_case = {name.lower(): name for name in variables}
    for name, variable in variables.items():
        match = _X_NAME.fullmatch(name)
        if match is None:
            continue
        other = by_case.get(f"{match['before']}{_MATES[match['word'].lower()]}{match['behind']}".lower())
        if other is None or {name, other} & letters.keys() or not _says_nothing(variable, variables[other]):
            continue
        dims = variable.dims, variables[other].dims
        if dims[0] == dims[1] or (len(dims[0]) == len(dims[1]) == 1):
            letters |= {name: "x", other: "y"}
    return letters


def _says_nothing(*variables: Any) -> bool:
    return all(
        variable.dtype.kind in "iuf"
        and not {"standard_name", "axis"} & set(variable.attrs)
        and str(variable.attrs.get("units", "")).strip().lower() in _UNITS
        for variable in variables
    )


def is_east(units: Any) -> bool:
    """Whether units are degrees to the east."""
    return str(units).lower() in _EAST


def is_longitude(name: str, attributes: Mapping[str, Any]) -> bool:
    """Whether the values of a variable are degrees around the Earth."""
    standard, units = (str(attributes.get(key, "")).lower() for key in ("standard_name", "units"))
    if units in _EAST:
        return True
    match = _X_NAME.fullmatch(name)
    called = match is not None and match["word"].lower().startswith("lon")
    return units.startswith("degree") and (standard == "longitude" or (not standard and called))


def is_time(dataset: Any, dim: str) -> bool:
    """Whether a dimension is one of times."""
    attributes = dataset.variables[dim].attrs if dim in dataset.variables else {}
    said = str(attributes.get("axis", "")).upper() == "T" or dim.lower().startswith("time")
    return said or time_of(dataset, dim) is not None


def time_of(dataset: Any, dim: str) -> str | None:
    """The variable with the dates along a dimension: of its own name, or another, such as ``time_centered`` of NEMO."""
    own = dataset.variables.get(dim)
    if own is not None and own.dims == (dim,) and _is_date(own):
        return dim
    if own is not None and not (str(own.attrs.get("axis", "")).upper() == "T" or dim.lower().startswith("time")):
        return None  # the dimension is something else, of which there may be dates too
    along = [str(name) for name, it in dataset.variables.items() if it.dims == (dim,) and _is_date(it)]
    named = {word for it in dataset.variables.values() for word in str(it.attrs.get("coordinates", "")).split()}
    return next((name for name in along if name in named), along[0] if along else None)


def _is_date(variable: Any) -> bool:
    return variable.dtype.kind in "iuf" and " since " in str(variable.attrs.get("units", ""))
