"""A structured surface in memory: what readers make, `encode` takes and `decode` gives back."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from .errors import InputError

__all__ = ["Closed", "Surface"]

#: Whether the rows and the columns of a grid wrap: ``(True, False)`` means that axis 0 is a circle.
Closed = tuple[bool, bool]

_DTYPES = ["int8", "int16", "int32", "int64", "uint8", "uint16", "uint32", "uint64", "float32", "float64"]


class Surface:
    """One structured block of points.

    Parameters
    ----------
    points : array of shape (H, W), (H, W, 2), (H, W, 3) or (H, W, C > 3)
        Heights; planar points; x, y, z; x, y, z and C - 3 attributes. A curve is (N, 1, C). Integers of 8 to 64 bits
        or float32/float64, of either byte order; not copied when already in native order and C-contiguous.
    closed : (bool, bool)
        ``(rows, columns)``: ``rows`` says that axis 0 wraps, so that row H - 1 is followed by row 0.
    metadata : mapping of str to plain values
        Anything that MessagePack can hold, kept with the surface: name, unit, ``crs`` (WKT), ``geotransform`` (six
        numbers in GDAL's order), source format, ...

    Raises
    ------
    InputError
        When the array is not of such a shape or type, is empty, has fewer than two points, or holds NaN or infinities.
    """

    def __init__(
        self,
        points: ArrayLike,
        closed: Closed = (False, False),
        *,
        metadata: Mapping[str, Any] | None = None,
    ) -> None:
        array = np.asarray(points)
        if array.ndim not in (2, 3) or (array.ndim == 3 and array.shape[2] < 2):
            raise InputError(
                f"expected an array of shape (H, W), (H, W, 2), (H, W, 3) or (H, W, C > 3), got shape {array.shape}"
            )
        if array.dtype.newbyteorder("=").name not in _DTYPES:
            raise InputError(f"expected integers of 8 to 64 bits or float32 or float64, got {array.dtype}")
        if array.shape[0] * array.shape[1] < 2:
            raise InputError(f"expected a grid of at least two points, got {array.shape[0]} x {array.shape[1]}")
        if len(closed) != 2:
            raise InputError(f"expected closed=(rows, columns), got {closed!r}")
        self.points: NDArray[Any] = np.ascontiguousarray(array, dtype=array.dtype.newbyteorder("="))
        self.closed: Closed = (bool(closed[0]), bool(closed[1]))
        self.metadata: dict[str, Any] = dict(metadata or {})
        if array.dtype.kind == "f":
            self._refuse_holes()

    def _refuse_holes(self) -> None:
        finite = np.isfinite(self.points)
        if finite.all():
            return
        holes = ~(finite if self.points.ndim == 2 else finite.all(axis=2))
        count = int(holes.sum())
        row, column = (int(i) for i in np.unravel_index(int(holes.argmax()), holes.shape))
        raise InputError(
            f"expected finite values, got NaN or infinity at {count} of {holes.size} points, first at row {row}, "
            f"column {column} (holes are not supported yet)"
        )

    @property
    def shape(self) -> tuple[int, int]:
        """Rows and columns of the grid."""
        return self.points.shape[0], self.points.shape[1]

    def __repr__(self) -> str:
        return f"Surface({' x '.join(map(str, self.points.shape))} {self.points.dtype}, closed={self.closed})"
