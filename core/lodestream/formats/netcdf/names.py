"""Which variables of a Dataset are x, y or times: by cf-xarray, or by names where attributes say nothing."""

from __future__ import annotations

import re
import warnings
from collections.abc import Mapping
from typing import Any

__all__ = [
    "AXIS_WORDS",
    "REFERENCES",
    "associated",
    "axis_words",
    "is_angle",
    "is_date",
    "is_east",
    "is_geographic",
    "is_geographic_coordinate",
    "is_grid_mapping",
    "is_longitude",
    "is_rotated",
    "is_time",
    "letters_of",
    "mate_of",
    "time_of",
]

#: What cf-xarray calls x and y; a longitude first, whatever else it is.
_ROLES = {"longitude": "x", "latitude": "y", "X": "x", "Y": "y"}

#: Names that mean x or y where no attribute says anything else.
_PLAIN = {
    **dict.fromkeys(("x", "lon", "longitude", "easting"), "x"),
    **dict.fromkeys(("y", "lat", "latitude", "northing"), "y"),
}

#: Attributes that refer to other variables, but for ``ancillary_variables``, which are no part of a variable.
REFERENCES = ("bounds", "coordinates", "grid_mapping", "climatology", "cell_measures", "formula_terms")

#: Those that cf-xarray follows.
_KINDS = ("coordinates", "grid_mapping", "bounds", "ancillary_variables", "cell_measures")

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
    """Return whether a WKT is one of longitudes and latitudes."""
    return isinstance(crs, str) and crs.lstrip().upper().startswith(("GEOGCS", "GEOGCRS", "GEODCRS", "GEOGRAPHICCRS"))


def is_rotated(crs: Any) -> bool:
    """Return whether a WKT is one of longitudes and latitudes of another pole."""
    return is_geographic(crs) and "DERIVINGCONVERSION[" in crs.upper()


def axis_words(letter: str, crs: Any) -> dict[str, str]:
    """Return what the conventions say of x or y under a CRS (WKT, or nothing)."""
    if is_rotated(crs):
        return {"standard_name": f"grid_{_DEGREES[letter][0]}", "units": "degrees"}
    if is_geographic(crs):
        standard, units = _DEGREES[letter]
        return {"standard_name": standard, "units": units}
    return {"standard_name": f"projection_{letter}_coordinate"} if crs else {}


def letters_of(dataset: Any) -> dict[str, str]:
    """Find the variables that are x or y, by cf-xarray; then pairs of names that mean both.

    A pair has the same dimensions, or is of two vectors along different ones; its attributes say nothing else.

    Returns
    -------
    dict of str to {"x", "y"}
        Variables that the conventions know come first.
    """
    variables = {str(name): variable for name, variable in dataset.variables.items()}
    letters = _by_conventions(variables)
    by_case = {name.lower(): name for name in variables}
    for name in variables:
        other = by_case.get(mate_of(name).lower())
        if other is None or {name, other} & letters.keys() or not _says_nothing(variables[name], variables[other]):
            continue
        dims = variables[name].dims, variables[other].dims
        if set(dims[0]) == set(dims[1]) or (len(dims[0]) == len(dims[1]) == 1):
            letters |= {name: "x", other: "y"}
    return letters


def mate_of(name: str) -> str:
    """Give the name of y that belongs to a name of x, such as ``XLAT_M`` to ``XLONG_M``; empty: it is no such name."""
    match = _X_NAME.fullmatch(name)
    return "" if match is None else f"{match['before']}{_MATES[match['word'].lower()]}{match['behind']}"


def associated(dataset: Any, name: str) -> dict[str, list[str]]:
    """Find the variables that the attributes of a variable refer to, by cf-xarray.

    Returns
    -------
    dict of str to list of str
        Of each of the attributes ``coordinates``, ``grid_mapping``, ``bounds``, ``ancillary_variables`` and
        ``cell_measures`` the variables that are there.
    """
    import cf_xarray  # noqa: F401  # adds the accessor
    import xarray

    texts = {
        key: text for key, text in dataset.variables[name].attrs.items() if key in _KINDS and isinstance(text, str)
    }
    words = {word.rstrip(":") for text in texts.values() for word in text.split()} & set(dataset.variables)
    # Of a Dataset with thousands of variables cf-xarray takes minutes; these are all that it needs to see.
    outline = xarray.Dataset(dict.fromkeys(words, ((), 0)) | {name: ((), 0, texts)})
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # of variables that are not there, and attributes that cannot be read
        related = outline.cf.get_associated_variable_names(name, error=False)
    return {key: [str(other) for other in related[key]] for key in _KINDS}


def _by_conventions(variables: Mapping[str, Any]) -> dict[str, str]:
    """Return the variables that the criteria of cf-xarray make x or y; units are recognised in other spellings too."""
    from cf_xarray.criteria import coordinate_criteria

    def is_role(role: str, attributes: Mapping[str, Any]) -> bool:
        criteria = coordinate_criteria[role].items()
        return any(isinstance(text := attributes.get(key), str) and text in values for key, values in criteria)

    letters = {}
    for name, variable in variables.items():
        if variable.dtype.kind not in "iuf":
            continue
        attributes = dict(variable.attrs)
        attributes["units"] = _canonical(attributes.get("units"))
        attributes |= {key: str(attributes[key]).lower() for key in ("standard_name",) if key in attributes}
        attributes |= {key: str(attributes[key]).upper() for key in ("axis",) if key in attributes}
        # A longitude with axis Y, as of a turned grid, is x all the same.
        letter = next((letter for role, letter in _ROLES.items() if is_role(role, attributes)), None)
        if letter := letter or _PLAIN.get(name.lower()):
            letters[name] = letter
    return letters


def _canonical(units: Any) -> Any:
    """Return units of longitudes and latitudes as the conventions spell them; others as they are."""
    plain = str(units).strip().lower().replace("_", " ").replace("degrees", "degree")
    if plain in ("degree east", "degree e", "degreee", "degree longitude"):
        return "degrees_east"
    return "degrees_north" if plain in ("degree north", "degree n", "degreen", "degree latitude") else units


def _says_nothing(*variables: Any) -> bool:
    return all(
        variable.dtype.kind in "iuf"
        and not {"standard_name", "axis"} & set(variable.attrs)
        and str(variable.attrs.get("units", "")).strip().lower() in _UNITS
        for variable in variables
    )


def is_east(units: Any) -> bool:
    """Return whether units are degrees to the east."""
    return bool(_canonical(units) == "degrees_east")


def is_angle(attributes: Mapping[str, Any]) -> bool:
    """Return whether the units of a coordinate are degrees."""
    return str(attributes.get("units", "")).strip().lower().startswith("deg")


def is_geographic_coordinate(variable: Any) -> bool:
    """Return whether x or y is a longitude or latitude, by its standard name or its unit, an angle."""
    standard, units = (str(variable.attrs.get(key, "")).strip().lower() for key in ("standard_name", "units"))
    return standard in ("longitude", "latitude") or units.startswith(("deg", "rad"))


def is_grid_mapping(variable: Any) -> bool:
    """Return whether a variable says a CRS, or where the cells of a raster lie."""
    return bool({"crs_wkt", "spatial_ref", "grid_mapping_name", "GeoTransform"} & set(variable.attrs))


def is_longitude(name: str, attributes: Mapping[str, Any]) -> bool:
    """Return whether the values of a variable are degrees around the Earth."""
    standard, units = (str(attributes.get(key, "")).lower() for key in ("standard_name", "units"))
    if is_east(units):
        return True
    match = _X_NAME.fullmatch(name)
    called = match is not None and match["word"].lower().startswith("lon")
    return units.startswith("degree") and (standard == "longitude" or (not standard and called))


def is_time(dataset: Any, dim: str) -> bool:
    """Return whether a dimension is one of times."""
    attributes = dataset.variables[dim].attrs if dim in dataset.variables else {}
    said = str(attributes.get("axis", "")).upper() == "T" or dim.lower().startswith("time")
    return said or time_of(dataset, dim) is not None


def time_of(dataset: Any, dim: str) -> str | None:
    """Return the variable with the dates along a dimension: of its name, or as ``time_centered`` of NEMO."""
    own = dataset.variables.get(dim)
    if own is not None and own.dims == (dim,) and is_date(own):
        return dim
    if own is not None and not (str(own.attrs.get("axis", "")).upper() == "T" or dim.lower().startswith("time")):
        return None  # the dimension is something else, of which there may be dates too
    along = [str(name) for name, it in dataset.variables.items() if it.dims == (dim,) and is_date(it)]
    named = {word for it in dataset.variables.values() for word in str(it.attrs.get("coordinates", "")).split()}
    return next((name for name in along if name in named), along[0] if along else None)


def is_date(variable: Any) -> bool:
    """Return whether the values of a variable are dates, as numbers since one of them."""
    return variable.dtype.kind in "iuf" and " since " in str(variable.attrs.get("units", ""))
