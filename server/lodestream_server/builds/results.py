"""Check the result of a build: the server trusts only the bytes of the container, after checking them.

A file may have taken over the process that reads it. So the process decides only whether it has built, why not, and who
vouches for the errors of an uploaded container; everything else is read from the container.
"""

from __future__ import annotations

import hashlib
import os
import stat
from pathlib import Path
from typing import TYPE_CHECKING, Any

from lodestream.errors import CorruptStreamError, InputError, StreamError, TooLargeError
from lodestream.operating_system import read_at

from ..store import containers
from . import finished
from .answers import WrongAnswerError, reason_of

if TYPE_CHECKING:
    from collections.abc import Sequence

    from .worker import Built

__all__ = ["check"]

# An index holds a record per segment, a few megabytes for the largest surfaces; masks take a bit a vertex at most.
_MOST_AT_ONCE = 256 << 20


def check(path: Path, built: Built, files: Sequence[Path]) -> dict[str, Any]:
    """Return the description of a new container, read from the container alone.

    Nobody writes to it any more: the process has ended, with all processes that it started.

    Parameters
    ----------
    path : Path
        Where the container must be.
    built : Built
        The answer of the process.
    files : sequence of Path
        The upload.

    Returns
    -------
    dict
        What ``lodestream info --json`` prints.

    Raises
    ------
    WrongAnswerError
        If there is no such file, its hash is wrong, or it is not a container.
    TooLargeError
        If its index would take more memory than all indexes of this server may.
    OSError
        If it cannot be read.
    """
    from lodestream.container import read_index

    # A link could lead to what belongs to somebody else, and a pipe would be waited for. Nobody changes it any more.
    status = path.lstat() if os.path.lexists(path) else None
    if status is None or not stat.S_ISREG(status.st_mode) or status.st_nlink != 1:
        raise WrongAnswerError("expected a container in a file of its own")
    with path.open("rb") as file:
        handle = file.fileno()
        sha256 = hashlib.file_digest(file, "sha256").hexdigest()
        if sha256 != built.sha256:
            raise WrongAnswerError(f"expected a container with the SHA-256 {built.sha256}, got {sha256}")

        def read(offset: int, length: int) -> bytes:
            if length > _MOST_AT_ONCE:
                raise CorruptStreamError(f"expected at most {_MOST_AT_ONCE} bytes at once, got {length}", offset)
            return read_at(handle, length, offset)

        needed, most = sum(containers.index_memory(read, status.st_size)), containers.most_for_indexes() // 2
        if needed > most:
            raise TooLargeError(
                f"expected a container whose index takes at most {most >> 20} MiB of memory, got {needed >> 20} MiB"
            )
        try:
            index = read_index(read, status.st_size)
            errors = built.errors if finished.is_container(files[0]) else None
            info = finished.figures_of(index, {finished.ERRORS: errors}, files)
            return finished.checked(index, info)
        except (InputError, StreamError) as error:
            raise WrongAnswerError(reason_of(str(error))) from None
