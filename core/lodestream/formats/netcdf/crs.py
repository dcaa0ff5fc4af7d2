"""The CRS of a Dataset: its WKT, or what pyproj makes of the attributes of its grid mapping; and back.

Source: CF conventions 1.11, section 5.6 and appendix F.
"""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from ...errors import UnavailableError
from .names import REFERENCES, associated
from .values import PACKING

__all__ = ["MAPPING", "beside_crs", "crs_of", "grid_mapping"]

#: Attributes that describe an ellipsoid: any of these sets does.
_ELLIPSOIDS = ({"earth_radius"}, {"semi_major_axis", "semi_minor_axis"}, {"semi_major_axis", "inverse_flattening"})

#: The grid mapping that rioxarray and GDAL name so, where no variable names one. What is written has this name too.
MAPPING = "spatial_ref"

#: Attributes of a grid mapping that a CRS, or a geotransform, says again.
_OF_CRS = frozenset(
    (
        *("crs_wkt", "spatial_ref", "GeoTransform", "grid_mapping_name", "towgs84", "geoid_name"),
        *("geographic_crs_name", "projected_crs_name", "horizontal_datum_name", "geopotential_datum_name"),
        *("reference_ellipsoid_name", "prime_meridian_name", "longitude_of_prime_meridian", "earth_radius"),
        *("semi_major_axis", "semi_minor_axis", "inverse_flattening", "false_easting", "false_northing"),
        *("grid_north_pole_latitude", "grid_north_pole_longitude", "north_pole_grid_longitude"),
        *("latitude_of_projection_origin", "longitude_of_projection_origin", "longitude_of_central_meridian"),
        *("straight_vertical_longitude_from_pole", "standard_parallel", "azimuth_of_central_line"),
        *("scale_factor_at_central_meridian", "scale_factor_at_projection_origin"),
        *("perspective_point_height", "sweep_angle_axis", "fixed_angle_axis"),
    )
)

#: Parts of an extended attribute: the name of a grid mapping, and the coordinates that it is for.
_PART = re.compile(r"([^\s:]+)\s*:\s*([^:]*)(?=\s[^\s:]+\s*:|$)")


def crs_of(dataset: Any, name: str, places: Sequence[str]) -> tuple[str | None, str | None, list[str]]:
    """Find the CRS of a variable.

    Parameters
    ----------
    dataset : Dataset of xarray
    name : str
        The variable.
    places : sequence of str
        Names of its coordinates x and y. Of several grid mappings, the one for these counts.

    Returns
    -------
    crs : str or None
        As WKT.
    mapping : str or None
        Name of the variable of the grid mapping.
    notes : list of str
        What pyproj does not understand.

    Raises
    ------
    UnavailableError
        If the CRS needs pyproj, and it is not installed.
    """
    variables = dataset.variables
    mappings = associated(dataset, name)["grid_mapping"] or [MAPPING]
    text = variables[name].attrs.get("grid_mapping", "")
    of_places = {part[1]: set(part[2].split()) for part in _PART.finditer(str(text))}
    mappings.sort(key=lambda mapping: -len(of_places.get(mapping, set()) & set(places)))
    mapping = mappings[0]
    if mapping not in variables:
        words = str(text).strip()
        return None, None, [f"the grid mapping {words[:40]!r} of {name} is not there"] if words else []
    attributes = variables[mapping].attrs
    for key in ("crs_wkt", "spatial_ref"):
        wkt = attributes.get(key)
        if isinstance(wkt, str) and wkt.strip():
            return wkt, mapping, []
    if "grid_mapping_name" not in attributes:
        # xarray writes the names of scalar coordinates on every variable, fill values on all floats.
        unnamed = set(attributes) - {"GeoTransform", *REFERENCES, *PACKING}
        return None, mapping, [f"left out {mapping}, a grid mapping without a name"] if unnamed else []
    try:
        import pyproj
    except ImportError:
        raise UnavailableError(
            "expected pyproj for a CRS in attributes of the CF conventions, which is not installed: install "
            "lodestream[formats]"
        ) from None
    try:
        crs = pyproj.CRS.from_cf(_with_meridian({key: _plain(value) for key, value in attributes.items()}))
    except Exception as error:  # a file may say anything, and pyproj fails in several ways
        reason = " ".join(str(error).split())[:120] or type(error).__name__
        return None, mapping, [f"left out the grid mapping {mapping}, which pyproj does not understand: {reason}"]
    return str(crs.to_wkt()), mapping, []


def beside_crs(attributes: Mapping[str, Any]) -> dict[str, Any]:
    """Choose the attributes of a grid mapping that its CRS does not say, such as a name or a code."""
    return {str(key): value for key, value in attributes.items() if key not in _OF_CRS}


def _with_meridian(attributes: dict[str, Any]) -> dict[str, Any]:
    """Name Greenwich where an ellipsoid is described and no prime meridian is.

    pyproj takes Greenwich there too, but looks for its longitude by name among all objects of PROJ: 0.4 s for a file.
    """
    described = any(names <= attributes.keys() for names in _ELLIPSOIDS)
    if not described or attributes.keys() & {"prime_meridian_name", "longitude_of_prime_meridian"}:
        return attributes
    return {**attributes, "prime_meridian_name": "Greenwich", "longitude_of_prime_meridian": 0.0}


def grid_mapping(metadata: Mapping[str, Any]) -> dict[str, Any]:
    """Say a CRS in attributes of a grid mapping: CF's by pyproj, WKT under both names in use, and the geotransform."""
    crs, transform = metadata.get("crs"), metadata.get("geotransform")
    attributes: dict[str, Any] = {}
    if crs:
        attributes = {**_said_by_cf(str(crs)), "crs_wkt": str(crs), "spatial_ref": str(crs)}
    if transform is not None:
        attributes["GeoTransform"] = " ".join(repr(float(value)) for value in transform)
    return attributes


def _said_by_cf(wkt: str) -> dict[str, Any]:
    try:
        import pyproj

        attributes = pyproj.CRS.from_wkt(wkt).to_cf()
    except Exception:  # pyproj is not installed, or whoever made the surface may have written anything
        return {}
    return {key: np.array(value) if isinstance(value, tuple) else value for key, value in attributes.items()}


def _plain(value: Any) -> Any:
    """Return a number of an attribute as Python has it, several as a list."""
    if isinstance(value, np.ndarray | np.generic):
        return value.tolist() if np.size(value) != 1 else np.ravel(value)[0].item()
    return value
