"""Uploaded containers: they are not built but checked, and kept unchanged.

The upload of such a surface is its container. A stranger wrote it, so all of it is checked and decoded once, in a build
process and under the limits of a build; see `lodestream.decoding.inspection`. If the container is lost, it is checked
and copied again from the upload, and never encoded again.
"""

from __future__ import annotations

import hashlib
import json
import math
import os
from collections.abc import Mapping
from functools import partial
from typing import TYPE_CHECKING, Any, BinaryIO

from lodestream.errors import CorruptStreamError, FormatError, OptionError, TooLargeError

from ..store.durable import NewFile

if TYPE_CHECKING:
    from collections.abc import Callable, Collection, Sequence
    from pathlib import Path

    from lodestream.container import Index
    from lodestream.formats import Format

    from .worker import Job

__all__ = ["CHECKED", "ERRORS", "TOLD", "check_upload", "checked", "figures_of", "is_container", "keep"]

#: What the server says of such a surface under the key `ERRORS`: the errors of its layers and levels were found to be
#: those of its pictures, which only an exact container allows; or they are what whoever uploaded it says.
ERRORS, CHECKED, TOLD = "errors", "checked", "told"

# Every page of the list carries the name.
_LONGEST_NAME = 4096

_BLOCK = 1 << 20


def is_container(path: Path) -> bool:
    """Return whether a file begins like a container, of any version."""
    from lodestream.container.sections import SIGNATURE, is_container

    with path.open("rb") as file:
        return is_container(file.read(len(SIGNATURE)))


def check_upload(files: Sequence[Path], options: Collection[str]) -> Format:
    """Check an upload that includes a container, as far as its first bytes allow.

    Parameters
    ----------
    files : sequence of Path
    options : collection of str
        Names of the given options, except ``name`` and ``filename``.

    Returns
    -------
    Format
        A format that is not in the library's table, because containers are not read but decoded.

    Raises
    ------
    FormatError
        If there are other files beside the container.
    OptionError
        If there is any option.
    TooLargeError
        If it has more sections than a container may have, or longer metadata.
    """
    from lodestream.formats import Format

    if len(files) > 1:
        raise FormatError(f"A container is uploaded alone, and here are {len(files)} files")
    for option in options:
        raise OptionError(f"A container has no option {option[:80]!a}, only name and filename: it is kept as it is")
    _check_sections(files[0])
    return Format(name="lode", suffixes=(".lode",), sniff=lambda head, suffix: False)


def _check_sections(path: Path) -> None:
    """Refuse sections that announce too much; all other damage is found when the container is decoded."""
    from lodestream.container import section_lengths
    from lodestream.container.limits import MOST_SECTIONS
    from lodestream.container.metadata import MAX_BYTES
    from lodestream.container.sections import METADATA

    with path.open("rb") as file:
        size = os.fstat(file.fileno()).st_size
        for number, (kind, length) in enumerate(section_lengths(partial(_read, file), size)):
            if number == MOST_SECTIONS:
                raise TooLargeError(f"The container has more than {MOST_SECTIONS:,} sections")
            if kind == METADATA and length > MAX_BYTES:
                raise TooLargeError(f"The container has {length} bytes of metadata, and at most {MAX_BYTES} are read")


def _read(file: BinaryIO, offset: int, length: int) -> bytes:
    file.seek(offset)
    return file.read(length)


def keep(job: Job, path: Path, progress: Callable[[float], None]) -> tuple[str, str]:
    """Check an uploaded container, and copy it to a path; return its SHA-256 and who vouches for its errors.

    Raises
    ------
    StreamError
        If it is damaged, cut short, followed by more bytes, or of a version that this server does not read; or if its
        metadata are too long or cannot be expressed in JSON.
    TooLargeError
        If it has more vertices than allowed, or cannot be checked within the memory.
    """
    from lodestream.container import describe
    from lodestream.decoding.inspection import inspect

    digest = hashlib.sha256()
    with job.files[0].open("rb") as source:
        inspection = inspect(
            source,
            max_vertices=job.max_vertices,
            memory=job.room,
            progress=progress,
        )
        checked(inspection.index, describe(inspection.index, channels=True))
        source.seek(0)
        with NewFile(path) as target:
            while block := source.read(_BLOCK):
                digest.update(block)
                target.write(block)
    return digest.hexdigest(), CHECKED if inspection.errors_checked else TOLD


def figures_of(index: Index, known: Mapping[str, Any] | None, files: Sequence[Path]) -> dict[str, Any]:
    """Return the description of a surface whose container has this index.

    Parameters
    ----------
    index : Index
    known : mapping or None
        The earlier description; it alone says who vouches for the errors.
    files : sequence of Path
        The upload, as far as it exists. If it is a container and there is no earlier description, nobody vouches for
        the errors.
    """
    from lodestream.container import describe

    info: dict[str, Any] = plain(describe(index, channels=True))
    errors = (known or {}).get(ERRORS)
    if errors in (CHECKED, TOLD):
        info[ERRORS] = errors
    elif any(path.is_file() and is_container(path) for path in files):
        info[ERRORS] = TOLD
    return info


def plain(value: Any) -> Any:
    """Return a value as JSON would return it: numbers that are not finite as null, bytes as hexadecimal digits."""
    if isinstance(value, float):
        return value if math.isfinite(value) else None
    if isinstance(value, bytes):
        return value.hex()
    if isinstance(value, Mapping):
        return {str(key): plain(item) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [plain(item) for item in value]
    return value


def checked(index: Index, info: dict[str, Any]) -> dict[str, Any]:
    """Return the description of a container as plain JSON values.

    Raises
    ------
    CorruptStreamError, TooLargeError
        If JSON cannot express it.
    """
    place = index.metadata
    name = index.metadata_values.get("name", "")
    if not isinstance(name, str) or len(name) > _LONGEST_NAME:
        raise CorruptStreamError(
            f"expected a name of at most {_LONGEST_NAME} characters, got {str(name)[:80]!a}", place.offset
        )
    try:
        description: dict[str, Any] = plain(info)
        json.dumps(description, allow_nan=False).encode()
    except (TypeError, ValueError, RecursionError) as error:
        raise CorruptStreamError(f"expected metadata that JSON can express: {error}"[:300], place.offset) from None
    return description
