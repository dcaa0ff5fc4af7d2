"""The code of a build process: reads an untrusted file and encodes it.

The server survives whatever happens here, and does not trust the result (`results`).
"""

from __future__ import annotations

import errno
import hashlib
import importlib
import logging
import os
import re
import time
import warnings
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from lodestream.container.capacity import memory_limit
from lodestream.container.metadata import with_notes
from lodestream.errors import (
    Choice,
    ChoiceError,
    FormatWarning,
    LodestreamError,
    StreamError,
    SwitchedOffError,
    TooLargeError,
    UnavailableError,
    UnsupportedVersionError,
)
from lodestream.operating_system import open_own

from ..store.durable import NewFile
from . import finished, thumbnails
from .stored_quality import without_quality

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator

    from lodestream import Surface

__all__ = [
    "ALLOWED_BY",
    "CLOSED",
    "NO_ROOM",
    "UNNAMED",
    "Built",
    "Job",
    "Parsed",
    "Refused",
    "build",
    "may_pass",
    "moved",
    "preload",
    "raise_passing",
    "read_progress",
    "reporter",
]

_log = logging.getLogger(__name__)

#: The libraries that read NetCDF, of which a process would take a second to import them. dask is not needed, but xarray
#: imports it if it is there. pyproj opens its database when it is imported: in a process that is forked then, which
#: closes all files, it would read another file in place of it.
_NETCDF = ("scipy.io", "xarray", "cf_xarray", "h5netcdf", "dask.array")

#: The values of ``closed``; `auto` leaves what the file says.
CLOSED = ("auto", "none", "rows", "cols", "both")

#: What a file without a name is called in messages, which must not tell where it lies on the server.
UNNAMED = "upload"

#: What is said to whoever brings a file of a format that is switched off.
ALLOWED_BY = "on this server; its setting LODESTREAM_FORMATS lists those that are read"

#: Errors of the system where a disk, or somebody's part of it, is full.
NO_ROOM = (errno.ENOSPC, errno.EDQUOT)

# Errors of the system that say nothing of what is in a file; not every system has each of them.
_LOCAL_NAMES = """
    EACCES EAGAIN EBADMSG EDQUOT EHOSTDOWN EIO EMFILE ENFILE ENODEV ENOENT ENOMEM ENOSPC ENXIO EPERM EREMOTEIO
    EROFS ESTALE ETIMEDOUT EUCLEAN
"""
_LOCAL = {getattr(errno, name) for name in _LOCAL_NAMES.split() if hasattr(errno, name)}

_SHORT_OF_MEMORY = re.compile(
    r"memory alloc|(?:cannot|can't|unable to|failed to) allocate|(?:out of|not enough|insufficient|no) memory|"
    r"no space (?:for|to)|bad_alloc|filter returned failure",
    re.IGNORECASE,
)

# The class of rasterio for what GDAL says where it gets no memory.
_NO_MEMORY_OF_GDAL = "CPLE_OutOfMemoryError"

_PROGRESS = "progress"
_CONTAINER, _SCRATCH, _READ, _MADE = "container", "scratch", "read", "made"
_BLOCK = 1 << 20
#: The part of the memory that an array of a file may take in memory.
_PART = 16
_REPORT_SECONDS = 0.1
_LONGEST_PROGRESS = 20


@dataclass(frozen=True)
class Job:
    """One build.

    Attributes
    ----------
    files : tuple of Path
    filename : str or None
        Original name of the first file.
    name : str or None
        Name for the surface.
    closed : str
        One of `CLOSED`.
    options : mapping of str to str
        Options of the format, and the quality among them, see `stored_quality`.
    max_vertices : int
    folder : Path
        Folder to write to; empty at the start.
    bands : Path or None
        Folder in which a build by bands continues what another one had made; None: it does not.
    allowed : tuple of str or None
        Names of the formats that may be read; None: all.
    shared : bool
        Whether a surface that does not fit into memory is left to others once it is parsed.
    memory : int or None
        Bytes that the build may take; None: what this process may have. The limit of the process is larger by what it
        has begun with, which is not the same after each start of a server.
    """

    files: tuple[Path, ...]
    filename: str | None
    name: str | None
    closed: str
    options: dict[str, str]
    max_vertices: int
    folder: Path
    bands: Path | None = None
    allowed: tuple[str, ...] | None = None
    shared: bool = False
    memory: int | None = None

    @property
    def container(self) -> Path:
        """Path of the container to write."""
        return self.folder / _CONTAINER

    @property
    def scratch(self) -> Path:
        """Folder for what does not fit into memory."""
        return self.folder / _SCRATCH

    @property
    def parsed(self) -> Path:
        """Folder of the arrays of a file, as far as they do not fit into memory."""
        return self.scratch / _READ

    @property
    def room(self) -> int:
        """Bytes to work in: half of what the build may take."""
        limit = memory_limit()
        return (limit if self.memory is None else min(limit, self.memory)) // 2


@dataclass(frozen=True)
class Built:
    """A container was built; it is on disk, in the folder of its job.

    Attributes
    ----------
    sha256 : str
    errors : str or None
        For an uploaded container, who vouches for its errors (`finished.ERRORS`).
    thumbnail : str or None
        Pixels of its thumbnail (`thumbnails.draw`).
    """

    sha256: str
    errors: str | None = None
    thumbnail: str | None = None


@dataclass(frozen=True)
class Parsed:
    """The upload was parsed and left for others to build: its surface is on disk, see `Job.parsed`.

    Attributes
    ----------
    vertices : int
    """

    vertices: int


@dataclass(frozen=True)
class Refused:
    """The upload was not built.

    Attributes
    ----------
    reason : str
        One line.
    final : bool
        True if the reader rejected the file, so that a retry would end the same; False if the reason may pass.
    choices : tuple of Choice
        Options by which one of its surfaces is built.
    """

    reason: str
    final: bool = True
    choices: tuple[Choice, ...] = ()


def preload() -> None:
    """Import the modules of builds and levels, so that forked processes have them at once.

    Libraries that read NetCDF are among it, if they are installed, since a process would take a second to import them.
    Libraries that read other formats are not: a process imports those when it comes to such a file.

    Raises
    ------
    UnavailableError
        When the compiled kernels cannot be loaded.
    """
    import numpy.ma  # noqa: F401  # numpy itself imports it when it first looks for the different values of an array

    import lodestream.decoding.decoder
    import lodestream.decoding.inspection
    import lodestream.encoding.encode
    import lodestream.encoding.request
    import lodestream.encoding.stored_surface
    import lodestream.formats
    import lodestream.interop.thumbnails
    import lodestream.mesh.recognise
    import lodestream.planning.planner  # noqa: F401
    from lodestream.library import library

    from . import levels  # noqa: F401

    with suppress(ImportError):  # without pyproj there are no tiles
        import pyproj  # noqa: F401

    for name in _NETCDF:
        with suppress(ImportError):  # the extra is not installed
            importlib.import_module(name)
    library()


def build(job: Job) -> Built | Parsed | Refused:
    """Read and encode an upload, or only read it if it is large and others build it."""
    # Errors come back as values: not every exception survives the way between processes.
    try:
        return _build(job)
    except SwitchedOffError as error:
        return Refused(f"{error} {ALLOWED_BY}", final=False)
    except ChoiceError as error:
        return Refused(str(error), choices=error.choices)
    except LodestreamError as error:
        raise_passing(error)
        return Refused(str(error), final=not may_pass(error))


def raise_passing(error: LodestreamError) -> None:
    """Raise the system error behind an error if it may pass: a full disk, or something in use.

    What was uploaded is not refused then: its build is begun again when there is room, or when the process of a server
    that was killed has let go of the folder that this one continues in.

    Raises
    ------
    OSError
    """
    for cause in _causes(error):
        if isinstance(cause, OSError) and cause.errno in (*NO_ROOM, errno.EAGAIN):
            raise OSError(cause.errno, os.strerror(cause.errno)) from error


def _causes(error: BaseException) -> Iterator[BaseException]:
    """Yield an error and the errors that readers made of it."""
    cause: BaseException | None = error
    while cause is not None:
        yield cause
        cause = cause.__cause__ or cause.__context__


def may_pass(error: LodestreamError) -> bool:
    """Return whether an upload was refused for something that this server lacks or forbids, not for its bytes."""
    if isinstance(error, TooLargeError | UnavailableError | UnsupportedVersionError):
        return True
    for cause in _causes(error):
        # Errors of GDAL have numbers of its own as `errno`: what is damaged has that of EPERM.
        if isinstance(cause, MemoryError) or (isinstance(cause, OSError) and cause.errno in _LOCAL):
            return True
        # HDF5 and the libraries below GDAL say it in words only; a filter fails for want of memory as for damage.
        if type(cause).__name__ == _NO_MEMORY_OF_GDAL or _SHORT_OF_MEMORY.search(str(cause)):
            return True
    return False


def read_progress(folder: Path) -> float:
    """Return the fraction of a build that is done, 0 to 1; safe whatever the build has put into its folder."""
    try:
        handle = open_own(folder / _PROGRESS, write=False)
    except OSError:
        return 0.0
    try:
        fraction = float(os.read(handle, _LONGEST_PROGRESS))
    except (OSError, ValueError):
        return 0.0
    finally:
        os.close(handle)
    return fraction if 0.0 <= fraction <= 1.0 else 0.0


def _build(job: Job) -> Built | Parsed:
    from lodestream import encode
    from lodestream.encoding.encode import goes_by_bands
    from lodestream.encoding.stored_surface import save_surface
    from lodestream.formats import check_allowed
    from lodestream.scratch import FolderScratch

    path = job.container
    if finished.is_container(job.files[0]):
        check_allowed(("lode",), job.allowed)
        try:
            return Built(*finished.keep(job, path, reporter(job.folder)), thumbnails.draw(path))
        except (StreamError, TooLargeError) as error:
            error.args = (f"{job.filename or UNNAMED}: {error}", *error.args[1:])
            raise
    quality, options = without_quality(job.options)
    surface = _read(job, options)
    report = reporter(job.folder)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", FormatWarning)  # it stands in the notes
        if goes_by_bands(surface, quality, job.room):
            if job.shared:
                save_surface(surface, FolderScratch(job.parsed))
                return Parsed(sum(block.shape[0] * block.shape[1] for block in surface.blocks))
            encoded = job.folder / _MADE
            encode(surface, quality=quality, progress=report, out=encoded, memory=job.room, scratch=job.bands)
            return Built(moved(encoded, path), thumbnail=thumbnails.draw(path))
        container = encode(surface, quality=quality, progress=report)
    with NewFile(path) as file:
        file.write(container)
    return Built(hashlib.sha256(container).hexdigest(), thumbnail=thumbnails.draw(path))


def moved(container: Path, path: Path) -> str:
    """Move a container to its place, and put it on disk; return its SHA-256."""
    digest = hashlib.sha256()
    with container.open("rb") as source, NewFile(path) as target:
        while block := source.read(_BLOCK):
            digest.update(block)
            target.write(block)
    container.unlink()
    return digest.hexdigest()


def _read(job: Job, options: dict[str, Any]) -> Surface:
    from lodestream.encoding.losses import at_holes
    from lodestream.formats import read
    from lodestream.scratch import FolderScratch, Room

    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always", FormatWarning)
        surface = read(
            *job.files,
            closed=job.closed,
            max_vertices=job.max_vertices,
            filename=job.filename or UNNAMED,
            allowed=job.allowed,
            room=Room(lambda: FolderScratch(job.parsed), job.room // _PART),
            **options,
        )
    messages = [str(warning.message) for warning in caught if warning.category is FormatWarning]
    notes = dict.fromkeys([*messages, *filter(None, [at_holes(surface)])])
    if job.name is not None:
        surface.metadata["name"] = job.name
    elif job.filename is None:
        # Nobody gave it one: the reader took it from the name that stands in for the file's.
        surface.metadata.pop("name", None)
    surface.metadata = with_notes(surface.metadata, list(notes))  # whoever uploaded it does not see what happens here
    return surface


def reporter(folder: Path) -> Callable[[float], None]:
    """Return a progress callback that stores the fraction for `read_progress`."""
    last = float("-inf")

    def report(fraction: float) -> None:
        nonlocal last
        now = time.monotonic()
        if now - last >= _REPORT_SECONDS:
            last = now
            # Renamed, so that the server never reads half a number; not worth a sync, nor an end if the disk is full.
            new = folder / f"{_PROGRESS}.new"
            with suppress(OSError):
                new.write_text(f"{min(max(fraction, 0.0), 1.0):.4f}")
                new.replace(folder / _PROGRESS)

    return report
