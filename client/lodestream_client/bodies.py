"""What is uploaded: files opened for sending, counted while they are read."""

from __future__ import annotations

import io
import os
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any, BinaryIO, Literal, TypeAlias, TypeGuard, cast

from lodestream.errors import InputError, OptionError
from lodestream.target import Tolerance

if TYPE_CHECKING:
    from lodestream.surface import Surface

__all__ = ["Body", "Closure", "Source", "opened", "surface_parameters"]

#: What can be uploaded: a file by its name, one that is open, the bytes of one, or a surface in memory.
Source: TypeAlias = "str | os.PathLike[str] | BinaryIO | bytes | Surface"
#: Which axes of a grid wrap, in the words of the command line.
Closure = Literal["auto", "none", "rows", "cols", "both"]

_CLOSURES: Mapping[tuple[bool, bool], Closure] = {
    (False, False): "none",
    (True, False): "rows",
    (False, True): "cols",
    (True, True): "both",
}
_CHUNK = 64 * 1024


class Body:
    """Files to send, open and at their start.

    Parameters
    ----------
    files : sequence of (name, file)
    sent : callable or None
        Called as ``sent(fraction)`` while they are read.
    """

    def __init__(self, files: Sequence[tuple[str, BinaryIO]], sent: Callable[[float], None] | None = None) -> None:
        self.files = files
        self.size = sum(_length(file) for _, file in files)
        self._sent = sent
        self._done = 0

    def count(self, size: int) -> None:
        """Note that `size` more bytes have been read."""
        self._done += size
        if self._sent is not None:
            self._sent(min(self._done / max(self.size, 1), 1.0))

    def parts(self) -> list[tuple[str, tuple[str, BinaryIO, str]]]:
        """Several files as the parts of a form, in httpx's shape."""
        return [
            ("file", (name, cast("BinaryIO", _Counted(file, self)), "application/octet-stream"))
            for name, file in self.files
        ]

    def chunks(self) -> Iterator[bytes]:
        """The one file, piece by piece."""
        file = _Counted(self.files[0][1], self)
        while chunk := file.read(_CHUNK):
            yield chunk


class _Counted:
    def __init__(self, file: BinaryIO, body: Body) -> None:
        self._file = file
        self._body = body

    def read(self, size: int = -1) -> bytes:
        chunk = self._file.read(size)
        self._body.count(len(chunk))
        return chunk

    def __getattr__(self, name: str) -> Any:
        return getattr(self._file, name)


def _length(file: BinaryIO) -> int:
    end = file.seek(0, os.SEEK_END)
    file.seek(0)
    return end


@contextmanager
def opened(sources: Sequence[Source], sent: Callable[[float], None] | None = None) -> Iterator[Body]:
    """Open what is to be uploaded.

    Raises
    ------
    OptionError
        When there is nothing to send.
    InputError
        When a surface in memory is more than one array.
    OSError
        When a file cannot be opened.
    """
    if not sources:
        raise OptionError("expected at least one file to upload, got none")
    with ExitStack() as stack:
        files: list[tuple[str, BinaryIO]] = []
        for source in sources:
            if isinstance(source, bytes):
                files.append(("", io.BytesIO(source)))
            elif isinstance(source, str | os.PathLike):
                path = Path(source)
                files.append((path.name, stack.enter_context(path.open("rb"))))
            elif _is_surface(source):
                files.append(("surface.npy", _as_npy(source)))
            else:
                files.append(("", cast("BinaryIO", source)))
        yield Body(files, sent)


def _is_surface(source: Source) -> TypeGuard[Surface]:
    """Whether this is a surface in memory; known without importing what surfaces are made of."""
    return hasattr(type(source), "attributes")


def _as_npy(surface: Surface) -> BinaryIO:
    import numpy as np

    points = surface.points  # refused where there are several blocks
    if surface.attributes:
        raise InputError("expected points alone, which can be sent from memory, got attributes; write them to a file")
    if surface.mask is not None:
        if points.dtype.kind != "f":
            raise InputError(f"expected NaN for holes, got a mask of {points.dtype} points; write them to a file")
        points = points.copy()
        points[~surface.mask] = np.nan
    file = io.BytesIO()
    np.save(file, points, allow_pickle=False)
    file.seek(0)
    return file


def surface_parameters(
    sources: Sequence[Source],
    precision: Tolerance | float | str | None,
    rms: Tolerance | float | str | None,
    closed: Closure,
    name: str | None,
    options: Mapping[str, str] | None,
    attribute_precision: Mapping[str, Tolerance | float | str] | None = None,
) -> dict[str, str | list[str]]:
    """The query of an upload.

    A surface in memory tells its own closure and name, unless others are given.

    Raises
    ------
    OptionError
        When the precision or the error is not a tolerance, both are given, or an option of the format has the name of
        one of the query's own.
    """
    parameters: dict[str, str | list[str]] = {}
    for source in sources:
        if _is_surface(source):
            closed = _CLOSURES[source.closed] if closed == "auto" else closed
            name = name or source.metadata.get("name")
    if precision is not None and rms is not None:
        raise OptionError("expected either a precision or a root mean square error, got both")
    precisions = [] if precision is None else [_tolerance(precision)]
    precisions += [f"{attribute}={_tolerance(value)}" for attribute, value in (attribute_precision or {}).items()]
    if precisions:
        parameters["precision"] = precisions
    if rms is not None:
        parameters["rms"] = _tolerance(rms)
    if closed != "auto":
        parameters["closed"] = closed
    if name:
        parameters["name"] = name
    for key, value in (options or {}).items():
        if key in ("precision", "rms", "closed", "name", "filename"):
            raise OptionError(f"{key} is not an option of a format")
        parameters[key] = value
    return parameters


def _tolerance(error: Tolerance | float | str) -> str:
    return str(error if isinstance(error, Tolerance) else Tolerance.parse(str(error)))
