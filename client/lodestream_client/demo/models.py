"""The two surfaces of the demo."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from lodestream.errors import LodestreamError
from lodestream.surface import Surface

if TYPE_CHECKING:
    from ..bodies import Source

__all__ = ["Model", "jacksboro", "torus"]

_EARTH_DEGREE = 111_320.0  # metres in one degree of latitude


@dataclass(frozen=True)
class Model:
    """One surface to show.

    Attributes
    ----------
    title, unit : str
        For people; the unit is that of the errors.
    stem : str
        Of the names of files.
    points : array
        The original, which what comes is compared with.
    source : path or Surface
        What is uploaded.
    options : mapping
        Options of the upload.
    placed : callable
        Makes of received points a surface in metres, for writing.
    """

    title: str
    unit: str
    stem: str
    points: NDArray[Any]
    source: Source
    options: dict[str, str]
    placed: Callable[[NDArray[Any]], Surface]

    def errors(self, points: NDArray[Any]) -> tuple[float, float]:
        """RMS and maximum distance of points from the original."""
        difference = points.astype(np.float64) - self.points
        squares = difference**2 if difference.ndim == 2 else (difference**2).sum(axis=2)
        return float(np.sqrt(squares.mean())), float(np.sqrt(squares.max()))


def jacksboro() -> Model:
    """The Jacksboro fault in Tennessee: an elevation model of 344 x 403 whole metres, which matplotlib brings along.

    Raises
    ------
    LodestreamError
        When matplotlib or its sample data are not installed.
    """
    try:
        from matplotlib import cbook

        path = Path(cbook._get_data_path("sample_data", "jacksboro_fault_dem.npz"))
        with np.load(path) as arrays:
            heights = arrays["elevation"]
            dx, dy, south = (float(arrays[name]) for name in ("dx", "dy", "ymin"))
    except (ImportError, OSError) as error:
        raise LodestreamError(
            f"the demo needs matplotlib and its sample data (pip install 'lodestream[plot]'): {error}"
        ) from None
    across = dx * _EARTH_DEGREE * float(np.cos(np.radians(south)))
    down = dy * _EARTH_DEGREE

    def placed(points: NDArray[Any]) -> Surface:
        return Surface(points, metadata={"geotransform": [0.0, across, 0.0, points.shape[0] * down, 0.0, -down]})

    return Model(
        "Jacksboro fault, heights on a grid of 344 x 403",
        "m",
        "jacksboro",
        heights,
        path,
        {"array": "elevation"},
        placed,
    )


def torus(rows: int = 384, columns: int = 192) -> Model:
    """A bumpy torus that closes in both directions, float32."""
    u = np.linspace(0.0, 2 * np.pi, rows, endpoint=False)[:, None]
    v = np.linspace(0.0, 2 * np.pi, columns, endpoint=False)[None, :]
    swell = 0.10 * np.cos(5 * u) * np.cos(2 * v + u) + 0.05 * np.sin(9 * u + 4 * v) * np.cos(3 * v)
    grain = 0.018 * np.cos(31 * u + 3 * v) * np.cos(17 * v - 2 * u) + 0.006 * np.sin(53 * u - 29 * v)
    tube = 0.85 + swell + grain
    ring = 2.1 + 0.12 * np.cos(3 * u)
    x = (ring + tube * np.cos(v)) * np.cos(u)
    y = (ring + tube * np.cos(v)) * np.sin(u)
    z = tube * np.sin(v) + 0.25 * np.sin(2 * u)
    points = np.stack([x, y, z], axis=2).astype(np.float32)
    surface = Surface(points, (True, True), metadata={"name": "Torus"})
    return Model(
        f"Torus, x y z on a grid of {rows} x {columns} that closes both ways",
        "",
        "torus",
        points,
        surface,
        {},
        lambda values: Surface(values, (True, True)),
    )
