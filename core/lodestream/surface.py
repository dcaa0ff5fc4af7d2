"""A structured surface in memory: what readers make, `encode` takes and `decode` gives back."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from .errors import InputError

__all__ = ["Block", "Closed", "Surface"]

#: Whether the rows and the columns of a grid wrap: ``(True, False)`` means that axis 0 is a circle.
Closed = tuple[bool, bool]

_DTYPES = ["int8", "int16", "int32", "int64", "uint8", "uint16", "uint32", "uint64", "float32", "float64"]


class Block:
    """One structured grid of points.

    Parameters
    ----------
    points : array of shape (H, W), (H, W, 2), (H, W, 3) or (H, W, C > 3)
        Heights; planar points; x, y, z; x, y, z and C - 3 attributes. A curve is (N, 1, C). Integers of 8 to 64 bits
        or float32/float64, of either byte order; not copied when already in native order and C-contiguous.
    closed : (bool, bool)
        ``(rows, columns)``: ``rows`` says that axis 0 wraps, so that row H - 1 is followed by row 0.
    mask : bool array of shape (H, W), optional
        True where a point is valid; the others are holes, whose values mean nothing. Points with a coordinate that is
        NaN or infinite are holes as well. None: only those.
    attributes : mapping of str to arrays of shape (H, W) or (H, W, K), optional
        What belongs to the points beside their place, each of one of the types above; NaN and infinities are values.

    Raises
    ------
    InputError
        When an array is not of such a shape or type, there are fewer than two points, or none of them is valid.
    """

    def __init__(
        self,
        points: ArrayLike,
        closed: Closed = (False, False),
        *,
        mask: ArrayLike | None = None,
        attributes: Mapping[str, ArrayLike] | None = None,
    ) -> None:
        array = np.asarray(points)
        if array.ndim not in (2, 3) or (array.ndim == 3 and array.shape[2] < 2):
            raise InputError(
                f"expected an array of shape (H, W), (H, W, 2), (H, W, 3) or (H, W, C > 3), got shape {array.shape}"
            )
        if array.shape[0] * array.shape[1] < 2:
            raise InputError(f"expected a grid of at least two points, got {array.shape[0]} x {array.shape[1]}")
        if len(closed) != 2:
            raise InputError(f"expected closed=(rows, columns), got {closed!r}")
        self.points: NDArray[Any] = _native(array, "points")
        self.closed: Closed = (bool(closed[0]), bool(closed[1]))
        self.attributes = {name: self._attribute(name, values) for name, values in (attributes or {}).items()}
        self.mask: NDArray[np.bool_] | None = self._valid(mask)

    def _attribute(self, name: str, values: ArrayLike) -> NDArray[Any]:
        array = np.asarray(values)
        if array.shape[:2] != self.shape or array.ndim > 3 or array.size == 0:
            raise InputError(
                f"expected attribute {name!r} of shape {self.shape} or {self.shape} and components, got {array.shape}"
            )
        return _native(array, f"attribute {name!r}")

    def _valid(self, mask: ArrayLike | None) -> NDArray[np.bool_] | None:
        valid = None
        if mask is not None:
            valid = np.array(mask)
            if valid.shape != self.shape or valid.dtype != np.bool_:
                raise InputError(f"expected a mask of booleans of shape {self.shape}, got {valid.dtype} {valid.shape}")
        if self.points.dtype.kind == "f":
            coordinates = self.points if self.points.ndim == 2 else self.points[..., : min(self.points.shape[2], 3)]
            with np.errstate(over="ignore", invalid="ignore"):
                total = coordinates.sum()  # quicker than to look at each; finite only where all are
            if not np.isfinite(total) and not (finite := np.isfinite(coordinates)).all():
                finite = finite if finite.ndim == 2 else finite.all(axis=2)
                valid = finite if valid is None else valid & finite
        if valid is None or valid.all():
            return None
        if not valid.any():
            raise InputError(f"expected at least one valid point, got {valid.shape[0]} x {valid.shape[1]} holes")
        return valid

    @property
    def shape(self) -> tuple[int, int]:
        """Rows and columns of the grid."""
        return self.points.shape[0], self.points.shape[1]

    @property
    def holes(self) -> int:
        """Points that are not valid."""
        return 0 if self.mask is None else int(self.mask.size - np.count_nonzero(self.mask))

    def __repr__(self) -> str:
        extras = f", {self.holes} holes" if self.holes else ""
        extras += f", attributes {', '.join(self.attributes)}" if self.attributes else ""
        return f"Block({' x '.join(map(str, self.points.shape))} {self.points.dtype}, closed={self.closed}{extras})"


class Surface:
    """A surface of one structured block, or of several.

    Parameters
    ----------
    points, closed, mask, attributes
        Of the only block, see `Block`.
    metadata : mapping of str to plain values
        Anything that MessagePack can hold, kept with the surface: name, unit, ``crs`` (WKT), ``geotransform`` (six
        numbers in GDAL's order), source format, ...
    blocks : iterable of Block
        In place of the first four: blocks of the same type and number of channels, with the same attributes.

    Raises
    ------
    InputError
        When the arrays cannot be a surface, see `Block`, or the blocks differ in kind.
    """

    def __init__(
        self,
        points: ArrayLike | None = None,
        closed: Closed = (False, False),
        *,
        mask: ArrayLike | None = None,
        attributes: Mapping[str, ArrayLike] | None = None,
        metadata: Mapping[str, Any] | None = None,
        blocks: Iterable[Block] | None = None,
    ) -> None:
        if (points is None) == (blocks is None):
            raise InputError("expected either points or blocks")
        if blocks is None:
            assert points is not None  # one of the two is there
            self.blocks: tuple[Block, ...] = (Block(points, closed, mask=mask, attributes=attributes),)
        else:
            self.blocks = tuple(blocks)
            if mask is not None or attributes is not None or tuple(closed) != (False, False):
                raise InputError("expected closed, mask and attributes with each block, got them beside blocks")
        self.metadata: dict[str, Any] = dict(metadata or {})
        if not self.blocks:
            raise InputError("expected at least one block, got none")
        first = _kind(self.blocks[0])
        for number, block in enumerate(self.blocks):
            if _kind(block) != first:
                raise InputError(
                    f"expected all blocks to be {_words(first)}, got block {number} of {_words(_kind(block))}"
                )

    def _only(self) -> Block:
        if len(self.blocks) != 1:
            raise InputError(f"expected a surface of one block, got {len(self.blocks)} blocks")
        return self.blocks[0]

    @property
    def points(self) -> NDArray[Any]:
        """Points of the only block, see `Block`."""
        return self._only().points

    @property
    def closed(self) -> Closed:
        """Which axes of the only block wrap."""
        return self._only().closed

    @property
    def mask(self) -> NDArray[np.bool_] | None:
        """Valid points of the only block; None: all."""
        return self._only().mask

    @property
    def attributes(self) -> dict[str, NDArray[Any]]:
        """Attributes of the only block by name."""
        return self._only().attributes

    @property
    def shape(self) -> tuple[int, int]:
        """Rows and columns of the only block."""
        return self._only().shape

    @property
    def dtype(self) -> np.dtype[Any]:
        """Type of the points."""
        return self.blocks[0].points.dtype

    def __repr__(self) -> str:
        return f"Surface({', '.join(map(repr, self.blocks))})"


def _native(array: NDArray[Any], what: str) -> NDArray[Any]:
    dtype = array.dtype.newbyteorder("=")
    if dtype.name not in _DTYPES:
        raise InputError(f"expected {what} as integers of 8 to 64 bits or float32 or float64, got {array.dtype}")
    return np.ascontiguousarray(array, dtype=dtype)


_Kind = tuple[str, tuple[int, ...], tuple[tuple[str, str, tuple[int, ...]], ...]]


def _kind(block: Block) -> _Kind:
    attributes = tuple((name, array.dtype.name, array.shape[2:]) for name, array in block.attributes.items())
    return block.points.dtype.name, block.points.shape[2:], attributes


def _words(kind: _Kind) -> str:
    points = f"{kind[0]} with {kind[1][0]} channels" if kind[1] else f"{kind[0]} heights"
    return points + "".join(f", {name} ({dtype}{list(shape) if shape else ''})" for name, dtype, shape in kind[2])
