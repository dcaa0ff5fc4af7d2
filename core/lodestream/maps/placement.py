"""Where a height field lies on the Earth: places of the grid at longitudes and latitudes, bounds, cells, zooms."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..errors import InputError
from ..surface import Closed
from .grid_places import GridPlaces
from .projection import EARTH_RADIUS, Projection
from .tile_grids import FINEST_ZOOM, LATITUDE_LIMIT, MESH_NODES, Box

__all__ = ["Placement"]

#: Rows and columns of the full grid at which bounds are looked for.
_SAMPLES = 129

#: A gap of more degrees between longitudes is outside the field; between samples around the Earth there are fewer.
_GAP = 6.0

#: Beyond this latitude the meridians are too close for bounds from samples, unless they are the columns of the field.
_POLAR = 85.0

#: How far bounds from samples may be off, in parts of their extent.
_INEXACT = 1e-3

#: At most so many positions along each axis of a tile go through PROJ; those between lie on straight lines. Over a
#: 64th of a tile, that is 0.05 pixels of zoom 0, and less at every other.
_POSITIONS = 67

#: A step between neighbouring positions that is so many times the usual one is a seam of the projection.
_SEAM = 16.0


@dataclass(frozen=True)
class Placement:
    """The rules of a grid's coordinates, and their CRS.

    Attributes
    ----------
    projection : Projection
    grid : GridPlaces
    closed : (bool, bool)
        Which axes of the grid are closed.
    """

    projection: Projection
    grid: GridPlaces
    closed: Closed

    @classmethod
    def of(cls, metadata: Mapping[str, Any], shape: tuple[int, int], closed: Closed) -> Placement:
        """Place a grid of heights by its metadata.

        Raises
        ------
        InputError
            If they lack a CRS or a position, or it is not on the Earth.
        UnavailableError
            If pyproj is not installed.
        """
        crs = metadata.get("crs")
        if not isinstance(crs, str) or not crs:
            raise InputError("expected heights with a CRS, got none: encode with --crs, such as EPSG:32611")
        projection = Projection(crs)
        placed = cls(projection, GridPlaces.of(metadata, shape, closed, projection.turn), closed)
        _ = placed.bounds, placed.cell  # what has none is refused now, and no tile waits for them
        return placed

    def places(
        self, longitudes: NDArray[np.float64], latitudes: NDArray[np.float64]
    ) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Return the rows and columns of the grid at a grid of places on the Earth.

        Parameters
        ----------
        longitudes : float64, shape (column,)
            In degrees, evenly spaced, of any turn.
        latitudes : float64, shape (row,)

        Returns
        -------
        two float64 arrays, shape (row, column)
            NaN where the field is not. Along closed axes they are continuous, so they may be of any turn.
        """
        found = np.full((2, len(latitudes), len(longitudes)), np.nan)
        near = self._near(longitudes, latitudes)
        window = tuple(slice(at[0], at[-1] + 1) for at in map(np.flatnonzero, near) if len(at))
        if len(window) < 2:
            return found[0], found[1]
        rows, columns = self.grid.places(*self._positions(longitudes[window[1]], latitudes[window[0]]))
        inside = self.grid.inside(rows, columns, self.closed) & near[0][window[0], None] & near[1][None, window[1]]
        for axis, places in enumerate((rows, columns)):
            if self.closed[axis] and inside.any():
                length = self.grid.shape[axis]
                middle = float(places[inside][0])
                places = middle + (places - middle + length / 2) % length - length / 2
            found[axis][window] = np.where(inside, places, np.nan)
        return found[0], found[1]

    def _positions(
        self, longitudes: NDArray[np.float64], latitudes: NDArray[np.float64]
    ) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Return x and y at a grid of places, shape (row, column); infinite where there are none."""
        lines = [np.arange(len(line)) for line in (latitudes, longitudes)]
        coarse = [np.append(at[: -1 : -(-len(at) // _POSITIONS)], at[-1]) for at in lines]
        x, y = self._transformed(longitudes[coarse[1]], latitudes[coarse[0]])
        if all(len(few) == len(at) for few, at in zip(coarse, lines, strict=True)):
            return x, y
        if self.projection.turn is not None:
            x = np.unwrap(x, period=self.projection.turn, axis=1)
        if not (_is_smooth(x) and _is_smooth(y)):
            return self._transformed(longitudes, latitudes)
        return _between(x, coarse, lines), _between(y, coarse, lines)

    def _transformed(
        self, longitudes: NDArray[np.float64], latitudes: NDArray[np.float64]
    ) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        return self.projection.to_plane(*np.meshgrid((longitudes + 180) % 360 - 180, latitudes))

    def _near(
        self, longitudes: NDArray[np.float64], latitudes: NDArray[np.float64]
    ) -> tuple[NDArray[np.bool_], NDArray[np.bool_]]:
        """Return which latitudes and which longitudes are within the bounds.

        Far from its zone, a projection may have any values, or take long to find that it has none.
        """
        west, south, east, north = self.bounds
        across, up = ((high - low) * _INEXACT + 1e-9 for low, high in ((west, east), (south, north)))
        columns = (longitudes - west + across) % 360 <= east - west + 2 * across
        return (latitudes >= south - up) & (latitudes <= north + up), columns | (east - west >= 360)

    @cached_property
    def bounds(self) -> Box:
        """West, south, east and north in degrees: west from -180 to 180, east beyond 180 if it crosses the dateline.

        Raises
        ------
        InputError
            If no place of the grid is on the Earth.
        """
        rows, columns = np.meshgrid(
            *(np.linspace(-0.5, length - 0.5, _SAMPLES) for length in self.grid.shape), indexing="ij"
        )
        x, y = self.grid.positions(rows, columns)
        if self.projection.turn is not None:
            y = np.clip(y, -self.projection.turn / 4, self.projection.turn / 4)  # half a cell beyond the pole
        longitudes, latitudes = self.projection.to_degrees(x, y)
        known = np.isfinite(longitudes) & np.isfinite(latitudes)
        if not known.any():
            raise InputError("expected a position on the Earth in the CRS of the heights, got none")
        south, north = float(latitudes[known].min()), float(latitudes[known].max())
        if not self.projection.plain:
            poles = [latitude for latitude in (-90.0, 90.0) if self._has_pole(latitude)]
            south, north = min([south, *poles]), max([north, *poles])
        around = not self.projection.plain and max(-south, north) > _POLAR
        west, east = (-180.0, 180.0) if around else _extent(longitudes[known])
        return west, south, east, north

    def _has_pole(self, latitude: float) -> bool:
        rows, columns = self.grid.places(*self._transformed(np.zeros(1), np.array([latitude])))
        return bool(self.grid.inside(rows, columns, self.closed).all())

    @cached_property
    def cell(self) -> float:
        """Metres from node to node in the middle of the field; along the axis where they are closer.

        Raises
        ------
        InputError
            If the middle is not on the Earth.
        """
        row, column = (max((length - 2) / 2, 0) for length in self.grid.shape)
        rows, columns = np.array([row, row, row + 1]), np.array([column, column + 1, column])
        longitudes, latitudes = map(np.radians, self.projection.to_degrees(*self.grid.positions(rows, columns)))
        # On a sphere: straight through the Earth is as far as on its surface, between neighbours.
        out = np.cos(latitudes)
        points = np.stack((out * np.cos(longitudes), out * np.sin(longitudes), np.sin(latitudes)), axis=1)
        metres = float(np.linalg.norm(points[1:] - points[0], axis=1).min() * EARTH_RADIUS)
        if not 0 < metres < math.inf:
            raise InputError("expected a position on the Earth in the middle of the heights, got none")
        return metres

    @property
    def latitude(self) -> float:
        """The middle of the bounds."""
        return (self.bounds[1] + self.bounds[3]) / 2

    def web_zoom(self, size: int = 256) -> int:
        """Return the first zoom of Web Mercator whose pixels, ``size`` along an edge, are no larger than the cells."""
        cosine = math.cos(math.radians(min(abs(self.latitude), LATITUDE_LIMIT)))
        return _zoom(2 * math.pi * EARTH_RADIUS * cosine / size / self.cell)

    def mesh_zoom(self) -> int:
        """Return the first zoom of the geographic scheme whose meshes have nodes at least as close as the cells."""
        return _zoom(math.pi * EARTH_RADIUS / (MESH_NODES - 1) / self.cell)

    def meets(self, box: Box) -> bool:
        """Return whether a box has places within the bounds."""
        west, south, east, north = self.bounds
        shifts = (-360, 0, 360)
        return (
            any(box[0] + turn < east and west < box[2] + turn for turn in shifts) and box[1] < north and south < box[3]
        )


def _zoom(ratio: float) -> int:
    """Return how often a step must be halved until it is no larger than 1; a little more than 1 is none.

    One zoom more is left, which some tiles have.
    """
    return min(max(math.ceil(math.log2(ratio) - 1e-6), 0), FINEST_ZOOM - 1)


def _extent(longitudes: NDArray[np.float64]) -> tuple[float, float]:
    """Return west and east of longitudes of any turn, shape (N,): around their largest gap."""
    around = np.sort((longitudes + 180) % 360 - 180)
    gaps = np.diff(around, append=around[0] + 360)
    widest = int(gaps.argmax())
    if gaps[widest] <= _GAP:
        return -180.0, 180.0
    west = float(around[(widest + 1) % len(around)])
    return west, west + 360.0 - float(gaps[widest])


def _is_smooth(values: NDArray[np.float64]) -> bool:
    """Return whether values at a grid, shape (row, column), are finite and steps between neighbours about the same."""
    if not np.isfinite(values).all():
        return False
    for axis in (0, 1):
        steps = np.abs(np.diff(values, axis=axis))
        if steps.size and steps.max() > _SEAM * np.median(steps) + 1e-6 * np.ptp(values):
            return False
    return True


def _between(
    values: NDArray[np.float64], coarse: list[NDArray[np.int64]], lines: list[NDArray[np.int64]]
) -> NDArray[np.float64]:
    """Return values of a coarse grid, shape (row, column), at all places of two lines, linearly."""
    for axis, (few, at) in enumerate(zip(coarse, lines, strict=True)):
        start = np.clip(np.searchsorted(few, at, "right") - 1, 0, len(few) - 2)
        share = (at - few[start]) / (few[start + 1] - few[start])
        low, high = values.take(start, axis), values.take(start + 1, axis)
        values = low + (high - low) * (share[:, None] if axis == 0 else share[None, :])
    return values
