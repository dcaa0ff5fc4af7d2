"""Structured surfaces in memory: made by readers and by `decode`, taken by `encode` and by writers."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from functools import cached_property
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from .errors import InputError
from .joints import Joints
from .scratch import rows_at_once

if TYPE_CHECKING:
    import pyvista
    import trimesh
    import xarray

__all__ = ["DTYPES", "Block", "Closed", "Surface", "finite_block"]

#: Whether the rows and the columns of a grid wrap: ``(True, False)`` means that axis 0 is a circle.
Closed = tuple[bool, bool]

#: Names of the types that points and attributes have.
DTYPES = ["int8", "int16", "int32", "int64", "uint8", "uint16", "uint32", "uint64", "float32", "float64"]


class Block:
    """One structured grid of points.

    Parameters
    ----------
    points : array of shape (H, W), (H, W, 2), (H, W, 3) or (H, W, C > 3)
        Heights; planar points; x, y, z; x, y, z and C - 3 attributes. A curve is (N, 1, C). Integers of 8 to 64 bits
        or float32/float64, of either byte order; not copied when already in native order and C-contiguous. In a masked
        array, a point with a masked coordinate is a hole.
    closed : (bool, bool)
        ``(rows, columns)``: ``rows`` means that axis 0 wraps around, so that row 0 follows row H - 1.
    mask : bool array of shape (H, W), optional
        True where a point is valid. The other points are holes; their values are not kept. Points with a NaN or
        infinite coordinate are holes too; those in `kept` are restored as they were. None: there are no other holes.
    attributes : mapping of str to arrays of shape (H, W) or (H, W, K), optional
        Further values at the points, of one of the types above. NaN and infinities are values. Masked values of a
        masked array become NaN.

    Raises
    ------
    InputError
        If an array has another shape or type, there are fewer than two points, no point is valid, or an attribute of
        integers is masked at a valid point.

    Examples
    --------
    >>> import lodestream
    >>> block = lodestream.Block([[1.0, 2.0], [3.0, float("nan")]], attributes={"kind": [[1, 2], [2, 1]]})
    >>> block.shape, block.holes
    ((2, 2), 1)
    """

    def __init__(
        self,
        points: ArrayLike,
        closed: Closed = (False, False),
        *,
        mask: ArrayLike | None = None,
        attributes: Mapping[str, ArrayLike] | None = None,
    ) -> None:
        self.points: NDArray[Any]
        self.closed: Closed
        self.points, self.closed = _checked(points, closed)
        hidden = _hidden(points)
        self.mask: NDArray[np.bool_] | None = self._valid(mask, hidden)
        if hidden is not None:
            # A masked coordinate makes a hole; a masked attribute needs a value that says so.
            values = hidden if hidden.ndim == 2 or self.points.dtype.kind == "f" else hidden[..., 3:]
            self.points = self._shown(self.points, values, "channels beyond the third")
        self.attributes = {name: self._attribute(name, values) for name, values in (attributes or {}).items()}

    def _attribute(self, name: str, values: ArrayLike) -> NDArray[Any]:
        """Check an attribute and return it in the form that a block stores."""
        array = np.asarray(values)
        if array.shape[:2] != self.shape or array.ndim > 3 or array.size == 0:
            raise InputError(
                f"expected attribute {name!r} of shape {self.shape} or {self.shape} and components, got {array.shape}"
            )
        shown, hidden = _native(array, f"attribute {name!r}"), _hidden(values)
        return shown if hidden is None else self._shown(shown, hidden, f"attribute {name!r}")

    def _shown(self, values: NDArray[Any], hidden: NDArray[np.bool_], what: str) -> NDArray[Any]:
        """Return values with NaN where they are hidden."""
        if values.dtype.kind == "f":
            return np.where(hidden, values.dtype.type(np.nan), values)
        anywhere: NDArray[np.bool_] = hidden if hidden.ndim == 2 else np.asarray(hidden.any(axis=2))
        if (anywhere if self.mask is None else anywhere & self.mask).any():
            raise InputError(
                f"expected values of {what} at all valid points, got masked ones of {values.dtype}, which has no NaN"
            )
        return values

    def _valid(self, mask: ArrayLike | None, hidden: NDArray[np.bool_] | None) -> NDArray[np.bool_] | None:
        """Return the mask of valid points; None if all are."""
        valid: NDArray[np.bool_] | None = None
        if hidden is not None:
            valid = ~(hidden if hidden.ndim == 2 else np.asarray(hidden[..., :3].any(axis=2)))
        if mask is not None:
            # What is memory-mapped may be larger than memory.
            given = np.asarray(mask) if _is_mapped(mask) else np.array(mask)
            if given.shape != self.shape or given.dtype != np.bool_:
                raise InputError(f"expected a mask of booleans of shape {self.shape}, got {given.dtype} {given.shape}")
            valid = given if valid is None else valid & given
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
        """Number of rows and columns of the grid."""
        return self.points.shape[0], self.points.shape[1]

    @cached_property
    def kept(self) -> NDArray[np.bool_] | None:
        """The holes whose values are kept bit for bit, bool array of shape (H, W); None if there are none.

        These are points with an infinite coordinate, and points with NaN in some but not all coordinates.
        """
        if self.mask is None or self.points.dtype.kind != "f":
            return None
        coordinates = self.points[..., np.newaxis] if self.points.ndim == 2 else self.points[..., :3]
        kept: NDArray[np.bool_] | None = None
        for rows in rows_at_once(coordinates.shape):
            holes = ~self.mask[rows]
            under = coordinates[rows][holes]
            missing = np.isnan(under)
            said = np.isinf(under).any(axis=1) | (missing.any(axis=1) & ~missing.all(axis=1))
            if said.any():
                kept = np.zeros(self.shape, np.bool_) if kept is None else kept
                kept[rows][holes] = said
        return kept

    @property
    def holes(self) -> int:
        """Number of points that are not valid."""
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
        Of a surface with one block, see `Block`.
    metadata : mapping of str to plain values
        Values that MessagePack can hold; they are kept with the surface. docs/formats.md lists the keys that readers
        set: name, unit, ``crs`` (WKT), ``geotransform`` (six numbers in GDAL's order), ...
    blocks : iterable of Block
        Instead of the first four: several blocks of the same type and number of channels, with the same attributes.

    Attributes
    ----------
    joints : Joints or None
        For a decoded surface: which points of its blocks are the same vertex, independent of their current values.
        None for a surface made from arrays: points with equal values are the same vertex, see `lodestream.mesh`.

    Raises
    ------
    InputError
        If the arrays are not valid, see `Block`, or the blocks differ in type, channels or attributes.

    Examples
    --------
    >>> import lodestream
    >>> heights = [[1.0, 2.0, 3.0], [3.0, 4.0, 6.0]]
    >>> place = {"geotransform": [500000.0, 30.0, 0.0, 4200000.0, 0.0, -30.0], "unit": "m"}
    >>> surface = lodestream.Surface(heights, metadata=place)
    >>> surface.shape, surface.dtype
    ((2, 3), dtype('float64'))
    >>> surface.to_xarray().z.attrs["units"]
    'm'
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
            got = "neither" if points is None else "both"
            raise InputError(f"expected either points, as an array, or blocks, got {got}")
        if blocks is None:
            assert points is not None  # one of the two is there
            self.blocks: tuple[Block, ...] = (Block(points, closed, mask=mask, attributes=attributes),)
        else:
            self.blocks = tuple(blocks)
            if mask is not None or attributes is not None or tuple(closed) != (False, False):
                raise InputError("expected closed, mask and attributes with each block, got them beside blocks")
        self.metadata: dict[str, Any] = dict(metadata or {})
        self.joints: Joints | None = None
        if not self.blocks:
            raise InputError("expected at least one block, got none")
        first = _kind(self.blocks[0])
        for number, block in enumerate(self.blocks):
            if _kind(block) != first:
                raise InputError(
                    f"expected all blocks to be {_words(first)}, got block {number} of {_words(_kind(block))}"
                )

    def _only(self) -> Block:
        """Return the only block."""
        if len(self.blocks) != 1:
            raise InputError(f"expected a surface of one block, got {len(self.blocks)} blocks")
        return self.blocks[0]

    @property
    def points(self) -> NDArray[Any]:
        """Points of the only block: shape (H, W), or (H, W, C); see `Block`."""
        return self._only().points

    @property
    def closed(self) -> Closed:
        """Which axes of the only block are closed."""
        return self._only().closed

    @property
    def mask(self) -> NDArray[np.bool_] | None:
        """Mask of the valid points of the only block, bool of shape (H, W); None if all are valid."""
        return self._only().mask

    @property
    def attributes(self) -> dict[str, NDArray[Any]]:
        """Attributes of the only block by name, shape (H, W) or (H, W, C) each."""
        return self._only().attributes

    @property
    def shape(self) -> tuple[int, int]:
        """Rows and columns of the only block."""
        return self._only().shape

    @property
    def dtype(self) -> np.dtype[Any]:
        """Type of the points."""
        return self.blocks[0].points.dtype

    def to_xarray(self) -> xarray.Dataset | xarray.DataTree:
        """Convert into xarray (extra ``xarray``): a Dataset, or a DataTree of ``block_0``, ... for several blocks.

        Heights become a variable over y and x, with coordinates from the geotransform; it is named as the metadata's
        ``variable``, or z. x, y, z become z over row and column with coordinates x and y. Attributes are variables.
        Holes are NaN: integers with holes become floats, whose encoding makes them integers again in a file. CRS and
        geotransform are in ``spatial_ref``, as in rioxarray. Closed axes and other metadata are kept in the attribute
        ``lodestream``, for `from_xarray`.

        Raises
        ------
        UnavailableError
            If xarray is not installed.
        FormatError
            If integers with holes need more bits than float64 has.
        """
        from .interop.to_xarray import to_xarray

        return to_xarray(self)

    @staticmethod
    def from_xarray(
        data: xarray.Dataset | xarray.DataArray | xarray.DataTree,
        *,
        attributes: str | Iterable[str] | None = None,
        closed: Closed | None = None,
        nodata: int | float | str | None = None,
        **options: str,
    ) -> Surface:
        """Convert an xarray Dataset or DataArray; a DataTree has one block for each node with variables.

        Parameters
        ----------
        data : Dataset, DataArray or DataTree
            Chunks of Dask are computed.
        attributes : str or iterable of str, optional
            Variables that become attributes, as a list or a text with commas; None: all over the same two dimensions
            (for a file, `read` only names these in a note). Flags (bool) become 0 and 1 of type uint8. Variables that
            are not numbers are left out, with a `FormatWarning`.
        closed : (bool, bool), optional
            Which axes are closed; None: as `to_xarray` left it, or those whose longitudes go around the Earth.
        nodata : int, float or str, optional
            A value that marks holes in addition to those that the Dataset declares, as in `lodestream.read`.
        **options
            The options of NetCDF, with the same meaning (docs/formats.md): ``variable``, ``x``, ``y``, ``time`` and
            ``at``. A Dataset that was opened from a file, decoded or not, becomes the same surface as its file.

        Raises
        ------
        UnavailableError
            If xarray is not installed.
        FormatError, OptionError
            If there is no variable over two dimensions, or several and none is chosen; the message names them.
        """
        from .interop.from_xarray import from_xarray

        return from_xarray(data, attributes=attributes, closed=closed, nodata=nodata, **options)

    def to_pyvista(self) -> pyvista.StructuredGrid | pyvista.MultiBlock:
        """Convert into pyvista (extra ``pyvista``): a StructuredGrid, or a MultiBlock of them for several blocks.

        Heights become z over their coordinates. Holes are hidden points, and cells without a face or with a hole at a
        corner are hidden cells. A closed axis repeats its first points at the end; longitudes and the positions of
        heights continue there and do not jump. Name, unit and CRS are field data. So is ``lodestream``, a JSON text
        with type, closed axes and metadata for `from_pyvista`.

        Raises
        ------
        UnavailableError
            If pyvista is not installed.
        FormatError
            If integers need more bits than float64 has.
        """
        from .interop.pyvista_grids import to_pyvista

        return to_pyvista(self)

    @staticmethod
    def from_pyvista(data: pyvista.DataObject, **remeshing: Any) -> Surface:
        """Convert a structured grid of pyvista, a MultiBlock of them, or a mesh of polygons that is a grid.

        Parameters
        ----------
        data : StructuredGrid, RectilinearGrid, ImageData, MultiBlock or PolyData
            A grid has one point along at least one of its three directions: a volume is not a surface. Hidden points
            and cells are holes. A last row or column that repeats the first makes a closed axis. For polygons see
            `from_trimesh`. Data of cells are left out, with a `FormatWarning`. A grid made by `to_pyvista` becomes
            heights with their position again, if its points, holes and cells are unchanged; they have the original type
            if it can hold them.
        **remeshing
            For polygons that are no grid, see `from_mesh`.

        Raises
        ------
        UnavailableError
            If pyvista is not installed.
        FormatError
            If this is no structured surface.
        """
        from .interop.pyvista_grids import from_pyvista

        return from_pyvista(data, **remeshing)

    def to_trimesh(self) -> trimesh.Trimesh:
        """Convert into trimesh (extra ``trimesh``): the welded mesh, quads cut into two triangles each.

        Blocks are joined where they touch, closed axes are joined by faces, and holes are left open. Colours, normals
        and texture coordinates go to their places in trimesh, other attributes to ``vertex_attributes``, metadata to
        ``metadata``.

        Raises
        ------
        UnavailableError
            If trimesh is not installed.
        FormatError
            If integers need more bits than float64 has, or the surface is a curve.
        """
        from .interop.trimesh_meshes import to_trimesh

        return to_trimesh(self)

    @staticmethod
    def from_trimesh(mesh: trimesh.Trimesh, **remeshing: Any) -> Surface:
        """Convert a mesh of triangles that is a structured surface, found as in an OBJ or a PLY.

        Parameters
        ----------
        mesh : trimesh.Trimesh
            Grids whose cells are two triangles each, in any order; open, closed, with poles or holes, one or several.
        **remeshing
            For a mesh that is no grid, see `from_mesh`.

        Returns
        -------
        Surface
            x, y, z in float64, the type of trimesh: heights and other types are not restored from `to_trimesh`. The
            faces are the same, but the grids are found again from the faces: blocks that touch may become one, a grid
            with many holes several, and rows may become columns. Points without a face are left out, with a
            `FormatWarning`.

        Raises
        ------
        UnavailableError
            If trimesh is not installed.
        FormatError
            If the mesh is not a structured surface; the message names the first faces that prevent it.
        """
        from .interop.trimesh_meshes import from_trimesh

        return from_trimesh(mesh, **remeshing)

    @staticmethod
    def from_mesh(
        vertices: ArrayLike,
        faces: ArrayLike | Sequence[Sequence[int]],
        attributes: Mapping[str, ArrayLike] | None = None,
        **remeshing: Any,
    ) -> Surface:
        """Convert a mesh of triangles and quads: its grids, or blocks that resample it.

        Parameters
        ----------
        vertices : array of shape (V, 2) or (V, 3)
        faces : int array of shape (F, 3) or (F, 4), or sequence of sequences of 3 or 4 int (with remesh of 3 or more)
            0-based vertices of each face, in order around it.
        attributes : mapping of str to arrays of shape (V,) or (V, K), optional
        **remeshing
            ``remesh=True``: a mesh that is no grid is resampled into watertight blocks of (2^k + 1)^2 points (extra
            ``remesh``; docs/remeshing.md). ``blocks``: about how many; 100 by default, fewer for small meshes.
            ``remesh_error``: desired root mean square distance to the mesh, relative to the diagonal of the bounding
            box; 2e-4 by default. ``remesh_normals=True``: the attribute "normal" is interpolated; otherwise it is left
            out.

        Returns
        -------
        Surface
            If the mesh was resampled, the metadata have `remesh`: a map with the measured distances.

        Raises
        ------
        InputError
            If the arrays have other shapes, or faces name vertices that do not exist.
        FormatError
            If the mesh is not a structured surface and `remesh` is not given, or if it is not a surface at all.
        UnavailableError
            If `remesh` is given, and the extra `remesh` is not installed.

        Examples
        --------
        >>> import lodestream
        >>> places = [(0, 0, 0), (1, 0, 0), (0, 1, 0), (1, 1, 0)]
        >>> lodestream.Surface.from_mesh(places, [(0, 1, 3, 2)]).shape
        (2, 2)
        """
        from .interop.meshes import from_mesh

        return from_mesh(vertices, faces, attributes, remeshing)

    def _repr_html_(self) -> str:
        """Return what a notebook shows: a small picture and sizes."""
        from .interop.html import surface_html

        return surface_html(self)

    def __repr__(self) -> str:
        return f"Surface({', '.join(map(repr, self.blocks))})"


def finite_block(
    points: NDArray[Any], closed: Closed, mask: NDArray[np.bool_] | None, attributes: dict[str, NDArray[Any]]
) -> Block:
    """Make a block of points that are known to be finite where they are valid, without examining them.

    Raises
    ------
    InputError
        If the shapes are not those of a `Block`.
    """
    block = Block.__new__(Block)
    block.points, block.closed = _checked(points, closed)
    block.mask = None if mask is None or mask.all() else mask.copy()
    block.attributes = {name: block._attribute(name, values) for name, values in attributes.items()}
    return block


def _checked(points: ArrayLike, closed: Closed) -> tuple[NDArray[Any], Closed]:
    """Return points and closed axes in the form that a block stores, after checking them."""
    array = np.asarray(points)
    if array.ndim not in (2, 3) or (array.ndim == 3 and array.shape[2] < 2):
        raise InputError(
            f"expected an array of shape (H, W), (H, W, 2), (H, W, 3) or (H, W, C > 3), got shape {array.shape}"
        )
    if array.shape[0] * array.shape[1] < 2:
        raise InputError(f"expected a grid of at least two points, got {array.shape[0]} x {array.shape[1]}")
    if len(closed) != 2:
        raise InputError(f"expected closed=(rows, columns), got {closed!r}")
    return _native(array, "points"), (bool(closed[0]), bool(closed[1]))


def _hidden(values: ArrayLike) -> NDArray[np.bool_] | None:
    """Return the mask of a masked array, bool, of its shape; None where nothing is masked."""
    if type(values) is np.ndarray or not isinstance(values, np.ma.MaskedArray):  # a plain array need not load numpy.ma
        return None
    hidden = values.mask
    return np.broadcast_to(hidden, np.shape(values)) if np.any(hidden) else None


def _is_mapped(array: object) -> bool:
    """Return whether an array is memory-mapped, or a view of one that is."""
    while isinstance(array, np.ndarray):
        if isinstance(array, np.memmap):
            return True
        array = array.base
    return False


def _native(array: NDArray[Any], what: str) -> NDArray[Any]:
    """Return an array in this machine's byte order, C-contiguous; raise InputError for other types."""
    dtype = array.dtype.newbyteorder("=")
    if dtype.name not in DTYPES:
        raise InputError(f"expected {what} as integers of 8 to 64 bits or float32 or float64, got {array.dtype}")
    return np.ascontiguousarray(array, dtype=dtype)


_Kind = tuple[str, tuple[int, ...], tuple[tuple[str, str, tuple[int, ...]], ...]]


def _kind(block: Block) -> _Kind:
    """Return the types and channels of a block's arrays."""
    attributes = tuple((name, array.dtype.name, array.shape[2:]) for name, array in block.attributes.items())
    return block.points.dtype.name, block.points.shape[2:], attributes


def _words(kind: _Kind) -> str:
    """Describe the types and channels of a block's arrays."""
    points = f"{kind[0]} with {kind[1][0]} channels" if kind[1] else f"{kind[0]} heights"
    return points + "".join(f", {name} ({dtype}{list(shape) if shape else ''})" for name, dtype, shape in kind[2])
