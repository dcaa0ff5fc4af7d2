"""Units of x and y beside those of the CRS: lengths and angles by the names that files of the CF conventions use.

Sources: UDUNITS-2, on which CF 1.11, section 3.1, relies; EPSG's units as pyproj has them for axes of a CRS.
"""

from __future__ import annotations

import math
import re
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

__all__ = ["Conversion", "conversions_of"]

_SURVEY_FOOT = 1200 / 3937

#: Metres of lengths by their names in the singular, and symbols.
_LENGTHS = {
    **dict.fromkeys(("m", "meter", "metre"), 1.0),
    **dict.fromkeys(("ft", "foot", "feet", "international_foot", "international_feet"), 0.3048),
    **dict.fromkeys(("us_survey_foot", "us_survey_feet", "survey_foot", "survey_feet"), _SURVEY_FOOT),
    **dict.fromkeys(("us_foot", "us_feet", "foot_us", "feet_us", "us_ft", "ftus"), _SURVEY_FOOT),
    **dict.fromkeys(("in", "inch", "international_inch"), 0.0254),
    **dict.fromkeys(("yd", "yard", "international_yard"), 0.9144),
    **dict.fromkeys(("mi", "mile", "international_mile", "statute_mile"), 1609.344),
    **dict.fromkeys(("us_statute_mile", "us_survey_mile"), 5280 * _SURVEY_FOOT),
    **dict.fromkeys(("nmile", "nautical_mile", "nmi"), 1852.0),
    **dict.fromkeys(("fathom", "us_survey_fathom"), 6 * _SURVEY_FOOT),
}

_WORDS = {
    "micro": 1e-6,
    "milli": 1e-3,
    "centi": 1e-2,
    "deci": 0.1,
    "deca": 10.0,
    "hecto": 100.0,
    "kilo": 1e3,
    "mega": 1e6,
}
_SYMBOLS = {"um": 1e-6, "mm": 1e-3, "cm": 1e-2, "dm": 0.1, "dam": 10.0, "hm": 100.0, "km": 1e3}
_LENGTHS |= {prefix + name: power for prefix, power in _WORDS.items() for name in ("meter", "metre")} | _SYMBOLS

#: Radians of angles.
_ANGLES = {
    **dict.fromkeys(("rad", "radian"), 1.0),
    **dict.fromkeys(("mrad", "milliradian"), 1e-3),
    **dict.fromkeys(("urad", "microradian"), 1e-6),
    **dict.fromkeys(("deg", "degree", "arc_degree", "arcdeg", "°"), math.pi / 180),
    **dict.fromkeys(("gon", "grad"), math.pi / 200),
    **dict.fromkeys(("arc_minute", "arcmin", "arcminute"), math.pi / 10800),
    **dict.fromkeys(("arc_second", "arcsec", "arcsecond"), math.pi / 648000),
}

#: A unit is a multiple of a named one, such as "km", "1000 m" or "1e3*metre".
_UNIT = re.compile(r"(?P<times>[0-9.]+(?:[eE][-+]?[0-9]+)?)?[\s*]*(?P<name>[^\W\d].*|°)", re.DOTALL)

#: Degrees with a direction.
_DIRECTION = re.compile(r"(deg(?:ree)?s?|°)_?(?:east|north|e|n|true)")

#: Letters that a name in the plural has at least; symbols have no plural ("ms" are milliseconds).
_SHORTEST_PLURAL = 5


@dataclass(frozen=True)
class Conversion:
    """How x or y of a file become those of the CRS.

    Attributes
    ----------
    factor : float
        What values are multiplied by.
    unit : str
        The name of the unit that they have then.
    """

    factor: float
    unit: str


def conversions_of(units: Mapping[str, Any], crs: str | None) -> tuple[dict[str, Conversion], list[str]]:
    """Compare the units of x and y with those of the axes of a CRS.

    Angles of a geostationary projection are as many of its lengths as the satellite is high, as PROJ has it.

    Parameters
    ----------
    units : mapping of {"x", "y"} to object
        What the file says; nothing: they are those of the CRS.
    crs : str or None
        WKT.

    Returns
    -------
    conversions : dict of {"x", "y"} to Conversion
        Of those that differ.
    notes : list of str
        What is converted, and what cannot be.
    """
    known = _axis_unit(crs)
    if known is None:
        return {}, []
    angular, size, name, height = known
    conversions: dict[str, Conversion] = {}
    texts: dict[str, list[str]] = {}
    for letter, text in units.items():
        if not isinstance(text, str) or not text.strip():
            continue
        unit, shown = _unit(text), repr(text.strip()[:40])
        if unit is not None and (unit[0] == angular or (unit[0] and height is not None)):
            factor = unit[1] * (height if height is not None and unit[0] != angular else 1.0) / size
            if not math.isclose(factor, 1, rel_tol=1e-9):
                conversions[letter] = Conversion(factor, name)
                texts.setdefault(f"converted from {shown} to the {name} of the CRS, by {factor:.10g}", []).append(
                    letter
                )
        else:
            texts.setdefault(f"in {shown}, which is not converted to the {name} of the CRS", []).append(letter)
    return conversions, [
        f"{' and '.join(letters)} {'are' if len(letters) > 1 else 'is'} {words}" for words, letters in texts.items()
    ]


def _axis_unit(crs: str | None) -> tuple[bool, float, str, float | None] | None:
    """Return whether axes of a CRS are angles, their unit in metres or radians, its name, a satellite's height."""
    if crs is None:
        return None
    try:
        import pyproj

        system = pyproj.CRS.from_wkt(crs)
        axis = system.axis_info[0]
        size, name = float(axis.unit_conversion_factor), str(axis.unit_name)
        operation = system.coordinate_operation
        satellite = operation is not None and operation.method_name.lower().startswith("geostationary")
        height = float(system.to_cf()["perspective_point_height"]) if satellite else None
    except Exception:  # pyproj is not installed, or does not understand what anybody may have written
        return None
    return (system.is_geographic, size, name, height) if size > 0 else None


def _unit(text: str) -> tuple[bool, float] | None:
    """Return whether a unit is an angle, and its size in radians or metres; None: it is not known."""
    match = _UNIT.fullmatch(text.strip())
    if match is None:
        return None
    try:
        times = float(match["times"] or 1)
    except ValueError:
        return None
    if not 0 < times < math.inf:
        return None
    symbol = match["name"].strip()
    if symbol == "Mm":  # no millimetre
        return False, times * 1e6
    name = re.sub(r"[\s_.-]+", "_", symbol.lower()).strip("_")
    if direction := _DIRECTION.fullmatch(name):
        name = direction[1]
    plural = len(name) >= _SHORTEST_PLURAL or name == "degs"
    for spelling in (name, *((name.removesuffix("s"), name.removesuffix("es")) if plural else ())):
        for table, angular in ((_LENGTHS, False), (_ANGLES, True)):
            if spelling in table:
                return angular, times * table[spelling]
    return None
