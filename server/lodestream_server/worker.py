"""What runs in a build process: reading strangers' files and encoding them; the server survives what happens here."""

from __future__ import annotations

import hashlib
import logging
import resource
import time
import warnings
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from lodestream.errors import FormatWarning, LodestreamError

from .durable import NewFile
from .records import plain

if TYPE_CHECKING:
    from collections.abc import Callable

    from lodestream import Surface

__all__ = [
    "ATTRIBUTE",
    "CLOSED",
    "UNNAMED",
    "Built",
    "Job",
    "Refused",
    "build",
    "limit_memory",
    "read_progress",
    "warm",
]

_log = logging.getLogger(__name__)

#: The values of ``closed``; `auto` leaves what the file says.
CLOSED = ("auto", "none", "rows", "cols", "both")

#: What stands before the name of an attribute in the key of its precision.
ATTRIBUTE = "precision="

#: What a file without a name is called in messages, which must not tell where it lies on the server.
UNNAMED = "upload"

_PROGRESS = "progress"
_CONTAINER = "container"
_REPORT_SECONDS = 0.1


@dataclass(frozen=True)
class Job:
    """One build.

    Attributes
    ----------
    files : tuple of Path
    filename : str or None
        Name of the first file, as its owner knows it.
    name : str or None
        What the surface is to be called.
    precision : str or None
        As on the command line: a number, or a number and ``d``.
    rms : str or None
        In the same words; one of the two at most.
    closed : str
        One of `CLOSED`.
    options : mapping of str to str
        Options of the format, and precisions of attributes: their keys begin with `ATTRIBUTE`.
    max_vertices : int
    folder : Path
        Where the build may write; empty at the start.
    """

    files: tuple[Path, ...]
    filename: str | None
    name: str | None
    precision: str | None
    rms: str | None
    closed: str
    options: dict[str, str]
    max_vertices: int
    folder: Path


@dataclass(frozen=True)
class Built:
    """A container was built and is on disk."""

    path: Path
    sha256: str
    info: dict[str, Any]


@dataclass(frozen=True)
class Refused:
    """The upload is not a surface that can be built, for this reason."""

    reason: str


def build(job: Job) -> Built | Refused:
    """Read and encode an upload."""
    # Errors come back as values: not every exception survives the way between processes.
    try:
        return _build(job)
    except LodestreamError as error:
        return Refused(str(error))


def limit_memory(most: int | None) -> None:
    """Let this process have no more than so many bytes; beyond them it gets MemoryError, or ends.

    What is counted is memory that it can write to and shares with nobody: neither code nor files that are mapped for
    reading. None is no limit.
    """
    if most is not None:
        hard = resource.getrlimit(resource.RLIMIT_DATA)[1]
        resource.setrlimit(resource.RLIMIT_DATA, (most if hard < 0 else min(most, hard), hard))


def read_progress(folder: Path) -> float:
    """How much of the build in a folder is done, from 0 to 1."""
    try:
        return float((folder / _PROGRESS).read_text())
    except (OSError, ValueError):
        return 0.0


def warm() -> None:
    """Compile the kernels, or load them from the disk: find the grids of small meshes, and code small surfaces."""
    import numpy as np

    from lodestream import decode, encode
    from lodestream.mesh import Mesh
    from lodestream.mesh.recognise import recognise

    rows, columns = np.mgrid[0:37, 0:41].astype(np.float64)
    xyz = np.stack((rows, columns, np.sin(rows * columns / 99)), axis=-1)
    heights = np.sin(rows / 5) * columns
    number = np.arange(rows.size, dtype=np.int32).reshape(rows.shape)
    a, b, c, d = (part.reshape(-1) for part in (number[:-1, :-1], number[:-1, 1:], number[1:, 1:], number[1:, :-1]))
    none = np.full_like(a, -1)
    quads = np.stack((a, b, c, d), axis=-1)
    halves = np.concatenate((np.stack((a, b, c, none), axis=-1), np.stack((a, c, d, none), axis=-1)))
    for corners in (quads, halves):
        if not np.array_equal(recognise(Mesh(xyz.reshape(-1, 3), corners)).surface().points, xyz):
            raise RuntimeError("expected the grid that the mesh was made of, got another one")
    for points in (heights, xyz):
        if not np.array_equal(decode(encode(points)).points, points):
            raise RuntimeError("expected the surface that was encoded, got another one")
    errors = decode(encode(heights, rms="1e-2d")).points - heights
    if np.sqrt(np.mean(np.square(errors))) > 0.01 * np.ptp(heights):
        raise RuntimeError("expected a surface within the error that it was encoded for, got another one")
    # Of as many points as a stream by neighbours is thought of for.
    many = np.mgrid[0:64, 0:65]
    terraces = np.rint(4 * np.sin(many[0] / 9) * np.cos(many[1] / 7)).astype(np.int16)
    if not np.array_equal(decode(encode(terraces)).points, terraces):
        raise RuntimeError("expected the terraces that were encoded, got others")


def _build(job: Job) -> Built:
    from lodestream import Tolerance, encode
    from lodestream.container import describe, read_index

    surface = _read(job)
    precision, rms = (None if text is None else Tolerance.parse(text) for text in (job.precision, job.rms))
    precisions = {
        key.removeprefix(ATTRIBUTE): Tolerance.parse(value)
        for key, value in job.options.items()
        if key.startswith(ATTRIBUTE)
    }
    container = encode(surface, precision, rms=rms, attribute_precision=precisions, progress=_reporter(job.folder))
    path = job.folder / _CONTAINER
    with NewFile(path) as file:
        file.write(container)
    index = read_index(lambda offset, length: container[offset : offset + length], len(container))
    return Built(path, hashlib.sha256(container).hexdigest(), plain(describe(index)))


def _read(job: Job) -> Surface:
    from lodestream.formats import read

    with warnings.catch_warnings(record=True) as found:
        warnings.simplefilter("always", FormatWarning)
        surface = read(
            *job.files,
            closed=job.closed,
            max_vertices=job.max_vertices,
            filename=job.filename or UNNAMED,
            **{key: value for key, value in job.options.items() if not key.startswith(ATTRIBUTE)},
        )
    notes = list(dict.fromkeys(str(warning.message) for warning in found if warning.category is FormatWarning))
    if notes:
        surface.metadata["notes"] = notes  # whoever uploaded it does not see what happens here
    if job.name is not None:
        surface.metadata["name"] = job.name
    elif job.filename is None:
        # Nobody gave it one: the reader took it from the name that stands in for the file's.
        surface.metadata.pop("name", None)
    return surface


def _reporter(folder: Path) -> Callable[[float], None]:
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
