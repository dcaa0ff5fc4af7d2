"""Encode a surface: in memory if it fits, otherwise piece by piece, optionally on other machines."""

from __future__ import annotations

import os
import shutil
import sys
import warnings
from collections.abc import Callable, Mapping
from concurrent.futures import Executor
from contextlib import ExitStack
from pathlib import Path
from typing import TYPE_CHECKING, Any, cast, overload

from numpy.typing import ArrayLike

from ..container.capacity import default_memory
from ..errors import FormatError, FormatWarning, InputError, OptionError, TooLargeError
from ..library import require
from ..operating_system import synchronise_folder
from ..quality import Effort, Limit, Quality
from ..scratch import Room
from ..sources import Source, is_source, read_source
from ..surface import Surface
from . import request
from .folder_build import FolderBuild
from .folders import BuildFolders, check_out, replacing
from .losses import at_holes
from .memory import WHOLE, checked_memory, whole_memory
from .room import CopyRoom
from .streams import encoded

if TYPE_CHECKING:
    import xarray

__all__ = ["encode", "goes_by_bands"]

#: The part of the memory that an array in memory may take.
_PART = 16

_Progress = Callable[[float], None]


@overload
def encode(
    surface: Surface | ArrayLike | Source | os.PathLike[str] | xarray.Dataset | xarray.DataArray | xarray.DataTree,
    precision: Limit | None = None,
    *,
    rms: Limit | None = None,
    attribute_precision: Mapping[str, Limit] | None = None,
    effort: Effort | None = None,
    quality: Quality | None = None,
    progress: _Progress | None = None,
    out: None = None,
    memory: int | str | None = None,
    scratch: str | os.PathLike[str] | None = None,
    executor: Executor | None = None,
) -> bytes: ...
@overload
def encode(
    surface: Surface | ArrayLike | Source | os.PathLike[str] | xarray.Dataset | xarray.DataArray | xarray.DataTree,
    precision: Limit | None = None,
    *,
    rms: Limit | None = None,
    attribute_precision: Mapping[str, Limit] | None = None,
    effort: Effort | None = None,
    quality: Quality | None = None,
    progress: _Progress | None = None,
    out: str | os.PathLike[str],
    memory: int | str | None = None,
    scratch: str | os.PathLike[str] | None = None,
    executor: Executor | None = None,
) -> None: ...
def encode(
    surface: Surface | ArrayLike | Source | os.PathLike[str] | xarray.Dataset | xarray.DataArray | xarray.DataTree,
    precision: Limit | None = None,
    *,
    rms: Limit | None = None,
    attribute_precision: Mapping[str, Limit] | None = None,
    effort: Effort | None = None,
    quality: Quality | None = None,
    progress: _Progress | None = None,
    out: str | os.PathLike[str] | None = None,
    memory: int | str | None = None,
    scratch: str | os.PathLike[str] | None = None,
    executor: Executor | None = None,
) -> bytes | None:
    """Encode a surface into a container.

    >>> import numpy as np, lodestream
    >>> heights = np.add.outer(np.arange(9) ** 2, np.arange(9))
    >>> container = lodestream.encode(heights)
    >>> bool((lodestream.decode(container).points == heights).all())
    True

    A surface that does not fit into memory can be given as a memory-mapped array, `np.load("heights.npy",
    mmap_mode="r")`, or as one that `read` keeps in files (`room`). It is encoded by bands of rows into a file, `out`.
    The bytes are the same for any memory, and any executor.

    Parameters
    ----------
    surface : Surface, array, Source, path, or Dataset, DataArray or DataTree of xarray
        An array, shape (row, column) or (row, column, channel), is taken as ``Surface(array)``. Arrays of Zarr, h5py
        and Dask, and any object with ``shape``, ``dtype`` and ``read(window)``, are read window by window, once.
        Objects of xarray are converted as by `Surface.from_xarray`, with coordinates, CRS, unit and name, also window
        by window. A path, str or path-like, is that of a file or a Zarr store, which is read as by `read`.
    precision : float, str, Tolerance or None
        Maximum error of the points: in the surface's unit or, as ``"0.01%"``, relative to the range of the heights or
        the diagonal of the bounding box. None: all values are restored bit for bit. Attributes are restored bit for bit
        unless `attribute_precision` names them.
    rms : float, str, Tolerance or None
        Encode for one root mean square error instead: a container as short as possible whose complete surface has at
        most this error. Quantization steps are chosen for this error alone, and there are few layers before the last.
    attribute_precision : mapping of str to float, str or Tolerance, optional
        Maximum error of attributes, by name; or of single channels: of a coordinate ("x", "y" or "z"), of a component
        of an attribute ("wind_0"), relative to the range of that channel. A coordinate that is named here has this
        precision, whatever `precision` is. If `precision` is None, the other coordinates are restored bit for bit.
    effort : "fast", "default" or "small", optional
        It changes bytes and time, never values. "fast" takes about half the time of "default", and has few layers.
        "small" takes fewer bytes, also in few layers. A window of it takes more bytes, since tiles and chunks have
        four times as many rows and columns, and its errors on the way are bounded by those of the whole surface.
    quality : Quality, optional
        Replaces the four parameters above, which are a shorthand for ``Quality.of(precision, rms,
        attribute_precision, effort)``.
    progress : callable, optional
        Called from time to time with the fraction done, 0 to 1.
    out : str or path-like, optional
        The file to write; it appears when it is complete.
    memory : int or str, optional
        Working memory in bytes, 1 MiB or more, or text such as `"512MiB"`; memory-mapped arrays do not count. A surface
        that needs more is built by bands. A band has at least one row of tiles, so the minimum is 96 MiB, 32 bytes for
        each value of such a row, and 6 bytes for each point of a surface with holes. A surface of several blocks, or
        one that touches itself, is built block by block, and its largest block counts in place of the row of tiles.
        Default: a quarter of the machine's memory. Without `out` and an executor, the surface is encoded in one piece.
    scratch : str or path-like, optional
        A folder in which a build by bands can be continued. Its files take about 12 bytes for each value, up to 30 for
        several blocks. Each build makes a folder of its own there. It is kept if the build fails or is interrupted,
        even by a power failure, and the same call continues from it; after success it is removed. Only one process at a
        time can make the same container there. Default: a temporary folder beside `out`, which is removed at the end.
    executor : concurrent.futures.Executor, optional
        Executes the tasks of a build by bands, in processes or on machines that all see `scratch` and the files of
        memory-mapped arrays, for example `distributed.Client(...).get_executor()`. Default: threads of this process.

    Returns
    -------
    bytes or None
        A container, see `docs/format.md`; None if `out` is given. Values of attributes at holes of the points are not
        kept; if there are any, a `FormatWarning` says so.

    Raises
    ------
    InputError
        If the surface cannot be encoded, or not with this precision, if its metadata are larger than
        `lodestream.container.metadata.MAX_BYTES`, or if `executor` is not an executor.
    InputError
        Also if another process makes the same container in the scratch folder, or if a file of the surface is changed
        during encoding.
    TooLargeError
        If a block has more rows or columns than kernels can count, if `memory` is given and is too little for a surface
        that cannot be built by bands, or if the disk of the scratch folder has too little space.
    OptionError
        If `memory` is not a size or less than 1 MiB, if there is no attribute or channel of a given name, if a
        tolerance is not a number of 0 or more, if there is no such effort, if both a precision and an RMS error are
        given, or a quality and one of these.
    UnavailableError
        If the compiled kernels are missing; the message says how to get them. Also if a worker has another version.
    OSError
        If a file cannot be written. If its folder does not exist, this is raised before encoding begins.
    """
    require("encoding")
    if surface is None:
        raise InputError("expected a surface, such as an array or the path of a file, got None")
    if executor is not None and not isinstance(executor, Executor):
        kind = f"{type(executor).__module__}.{type(executor).__qualname__}"
        hint = ": pass what its get_executor() returns" if hasattr(executor, "get_executor") else ""
        raise InputError(f"expected a concurrent.futures.Executor as executor, got {kind}{hint}")
    chosen = request.chosen_quality(quality, precision, rms, attribute_precision, effort)
    limit = default_memory() if memory is None else checked_memory(memory)
    if out is not None:
        check_out(Path(out))
    with ExitStack() as stack:
        folders = BuildFolders(stack, scratch, out)
        whole = out is None and memory is None and executor is None
        read = None if isinstance(surface, Surface) else _reading(surface)
        if read is not None:
            by_bands = _by_bands(limit, chosen, whole, executor is not None)
            given = None if memory is None else limit
            surface = read(CopyRoom(folders.copies, folders.temporary, limit // _PART, by_bands, given))
        elif not isinstance(surface, Surface):
            surface = Surface(cast("ArrayLike", surface))
        request.check(surface, chosen)
        left_out = at_holes(surface)
        if left_out is not None:
            warnings.warn(left_out, FormatWarning, stacklevel=2)
        report = request.rising(progress or (lambda fraction: None))
        if not whole and goes_by_bands(surface, chosen, limit, executor is not None, memory is not None):
            container = FolderBuild(surface, chosen, limit, executor, report, read is not None).container(folders)
            if container is not None:
                return _given(container, out)
            if memory is not None:
                _check_whole(surface, chosen, limit, "float64 does not hold the squares of its errors")
        return _in_memory(surface, chosen, report, out)


def _reading(source: Any) -> Callable[[Room], Surface] | None:
    """Return the function that reads a source by windows; None if the source is an array in memory."""
    if isinstance(source, str | os.PathLike):
        from ..formats import read as read_file

        return lambda room: read_file(source, room=room)
    xr: Any = sys.modules.get("xarray")  # whoever has an object of it has imported it
    if xr is None or not isinstance(source, xr.Dataset | xr.DataArray | xr.DataTree):
        return (lambda room: Surface(read_source(source, room))) if is_source(source) else None
    from ..interop.from_xarray import from_xarray

    def read(room: Room) -> Surface:
        try:
            return from_xarray(source, room)
        except (FormatError, OptionError) as error:
            raise type(error)(
                f"{error}; lodestream.Surface.from_xarray takes options, and encode the surface that it makes"
            ) from None

    return read


def _by_bands(limit: int, quality: Quality, whole: bool, wanted: bool) -> Callable[[int], bool]:
    """Return a function that tells, by its number of values, whether an array must be encoded by bands."""
    able = not whole and quality.rms is None
    return lambda values: able and (wanted or values * WHOLE > limit)


def _given(container: Path, out: str | os.PathLike[str] | None) -> bytes | None:
    if out is None:
        return container.read_bytes()
    with replacing(Path(out)) as unfinished:
        # A second name, so that a build that can continue has its container until OUT is on disk.
        try:
            os.link(container, unfinished)
        except OSError:  # on another disk, or a process that is confined
            shutil.copyfile(container, unfinished)
        with unfinished.open("rb+") as file:
            os.fsync(file.fileno())
    synchronise_folder(Path(out).resolve().parent)
    return None


def _in_memory(
    surface: Surface, quality: Quality, progress: _Progress, out: str | os.PathLike[str] | None
) -> bytes | None:
    container = encoded(surface, quality, progress)
    if out is None:
        return container
    with replacing(Path(out)) as unfinished:
        unfinished.write_bytes(container)
    return None


def goes_by_bands(surface: Surface, quality: Quality, memory: int, wanted: bool = False, strict: bool = False) -> bool:
    """Return whether a surface is built by bands: that is possible, and is wanted or saves memory that there is not.

    Parameters
    ----------
    surface : Surface
    quality : Quality
    memory : int
        In bytes.
    wanted : bool
        Whatever memory there is.
    strict : bool
        Refuse a surface that takes more and cannot be built by bands.

    Raises
    ------
    TooLargeError
        If it is refused.
    """
    needed = whole_memory(surface, quality.rms is not None)
    reason = _in_one_piece(surface, quality)
    if reason is None:
        return wanted or needed > memory
    if strict:
        _check_whole(surface, quality, memory, reason)
    return False


def _check_whole(surface: Surface, quality: Quality, memory: int, reason: str) -> None:
    """Refuse a surface that takes more memory in one piece and, for a reason, cannot be built by bands."""
    needed = whole_memory(surface, quality.rms is not None)
    if needed > memory:
        raise TooLargeError(
            f"expected a surface that takes at most {memory >> 20:,} MiB to encode, got one that takes about "
            f"{-(-needed >> 20):,} MiB and cannot be built by bands: {reason}"
        )


def _in_one_piece(surface: Surface, quality: Quality) -> str | None:
    """Return the reason why a surface cannot be built by bands; None if it can."""
    if quality.rms is not None:
        return "a stream for one error (rms) is made of all values together"
    return None
