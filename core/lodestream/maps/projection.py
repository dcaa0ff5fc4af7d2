"""A coordinate reference system: from longitudes and latitudes to its x and y and back, and the unit of its heights."""

from __future__ import annotations

import math
import re
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..errors import InputError, OptionError
from ..interop.optional import require_library

__all__ = ["EARTH_RADIUS", "Projection", "crs_wkt"]

#: Of the sphere of Web Mercator, and the larger half axis of WGS 84; in metres.
EARTH_RADIUS = 6378137.0

_CODE = re.compile(r"[A-Za-z]+:\d+(\+\d+)?")
_WGS84 = "EPSG:4326"
_LONGEST = 1 << 16  # letters of a WKT; metadata have no longer one


def crs_wkt(code: str) -> str:
    """Return the WKT of a CRS that is named by its code.

    Parameters
    ----------
    code : str
        Such as "EPSG:32611", or "EPSG:6340+5703" with a vertical CRS.

    Raises
    ------
    OptionError
        If PROJ has no such CRS.
    UnavailableError
        If pyproj is not installed.

    Examples
    --------
    >>> from lodestream.maps import crs_wkt
    >>> crs_wkt("EPSG:32611")[:40]
    'PROJCRS["WGS 84 / UTM zone 11N",BASEGEOG'
    """
    pyproj = require_library("pyproj", "maps")
    if not _CODE.fullmatch(code):
        raise OptionError(f"expected a CRS such as EPSG:32611, got {code[:80]!a}")
    try:
        return str(pyproj.CRS.from_user_input(code).to_wkt())
    except pyproj.exceptions.CRSError:
        raise OptionError(f"expected a CRS that PROJ knows, such as EPSG:32611, got {code[:80]!a}") from None


class Projection:
    """The horizontal part of a CRS, with x to the east first, beside longitudes and latitudes of WGS 84.

    Parameters
    ----------
    wkt : str
        Also a compound CRS.

    Attributes
    ----------
    turn : float or None
        What x and longitude of a geographic CRS repeat after, in its unit; None for others.
    plain : bool
        Whether x and y are longitudes and latitudes of the Earth's own poles.
    vertical : float or None
        Metres upwards of one unit of a compound CRS's heights, negative for depths; None if it has no vertical axis.

    Raises
    ------
    InputError
        If PROJ does not understand it, or it is not of the Earth's surface.
    UnavailableError
        If pyproj is not installed.
    """

    def __init__(self, wkt: str) -> None:
        pyproj = require_library("pyproj", "maps")
        try:
            if len(wkt) > _LONGEST:
                raise pyproj.exceptions.CRSError("too long")
            crs = pyproj.CRS.from_wkt(wkt)
            flat = next((part for part in crs.sub_crs_list if not part.is_vertical), crs).to_2d()
            if not (flat.is_geographic or flat.is_projected):
                raise pyproj.exceptions.CRSError(f"{flat.name[:60]!a} is of type {flat.type_name}")
            self._transformer = pyproj.Transformer.from_crs(_WGS84, flat, always_xy=True)
        except pyproj.exceptions.ProjError as error:
            reason = " ".join(str(error).split())[:120]
            raise InputError(f"expected a CRS that PROJ understands and can place on the Earth: {reason}") from None
        self.turn = None
        if flat.is_geographic:
            self.turn = round(2 * math.pi / flat.axis_info[0].unit_conversion_factor, 9)
        self.plain = bool(flat.is_geographic and not flat.is_derived)
        self.vertical = _vertical(crs)

    def to_plane(
        self, longitudes: NDArray[np.float64], latitudes: NDArray[np.float64]
    ) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Return x and y of places in degrees, all of one shape; infinite where the projection has none."""
        x, y = self._transformer.transform(longitudes, latitudes, errcheck=False)
        return np.asarray(x), np.asarray(y)

    def to_degrees(
        self, x: NDArray[np.float64], y: NDArray[np.float64]
    ) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Return longitudes and latitudes of positions, all of one shape; infinite where there are none."""
        longitudes, latitudes = self._transformer.transform(x, y, errcheck=False, direction="INVERSE")
        return np.asarray(longitudes), np.asarray(latitudes)


def _vertical(crs: Any) -> float | None:
    """Return what `Projection.vertical` is of a CRS of pyproj."""
    for axis in crs.axis_info:
        if axis.direction in ("up", "down"):
            metres = float(axis.unit_conversion_factor)
            return -metres if axis.direction == "down" else metres
    return None
