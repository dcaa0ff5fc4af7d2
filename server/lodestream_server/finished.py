"""Containers that are uploaded: there is nothing to build, so they are looked through and kept as they came.

Of such a surface the upload is the container. Whatever may lie in it was written by a stranger, so all of it is checked
and decoded once, in a build's process and under a build's limits; see `lodestream.inspection`. If the container is lost
it is checked and copied again, and never encoded again.
"""

from __future__ import annotations

import hashlib
import json
from itertools import islice
from typing import TYPE_CHECKING, Any

from lodestream.errors import CorruptStreamError, FormatError, OptionError, TooLargeError

from .durable import NewFile
from .records import plain

if TYPE_CHECKING:
    from collections.abc import Callable, Collection, Mapping, Sequence
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

# As many are looked at while a client waits; a container of the encoder has some thirty.
_MOST_SECTIONS = 10_000


def is_container(path: Path) -> bool:
    """Whether a file begins like a container, of whichever version."""
    from lodestream.container.sections import SIGNATURE, is_container

    with path.open("rb") as file:
        return is_container(file.read(len(SIGNATURE)))


def check_upload(files: Sequence[Path], options: Collection[str]) -> Format:
    """Refuse an upload, some file of which is a container, where the first bytes show that it is wrong.

    Parameters
    ----------
    files : sequence of Path
    options : collection of str
        All that was asked for but a name.

    Returns
    -------
    Format
        One that the library's table does not have: nothing is read from a container but itself.

    Raises
    ------
    FormatError
        When there are other files beside it.
    OptionError
        When there is any option.
    TooLargeError
        When its metadata are longer than a container's may be.
    """
    from lodestream.formats import Format

    if len(files) > 1:
        raise FormatError(f"expected a container by itself, got it among {len(files)} files")
    for option in options:
        raise OptionError(
            "expected no option but name and filename with a container, which says all else itself, "
            f"got {option[:80]!a}"
        )
    _check_metadata(files[0])
    return Format("lode", (".lode",), lambda head, suffix: False)


def _check_metadata(path: Path) -> None:
    """Refuse metadata by the length that they announce; what else may be wrong is found when all is looked through."""
    from lodestream.container import section_lengths
    from lodestream.container.sections import METADATA
    from lodestream.metadata import MAX_BYTES

    with path.open("rb") as file:
        for kind, length in islice(section_lengths(file), _MOST_SECTIONS):
            if kind == METADATA and length > MAX_BYTES:
                raise TooLargeError(f"expected at most {MAX_BYTES} bytes of metadata in a container, got {length}")


def keep(job: Job, path: Path, progress: Callable[[float], None]) -> tuple[str, str]:
    """Check the container that was uploaded, and copy it to a path; its SHA-256, and whose word its errors are.

    Raises
    ------
    StreamError
        When it is damaged, cut short, followed by something, or of a version that this server does not read; or its
        metadata are longer than any may be, or nothing that JSON can tell.
    TooLargeError
        When it has more vertices than allowed.
    """
    from lodestream.container import describe
    from lodestream.inspection import inspect

    digest = hashlib.sha256()
    with job.files[0].open("rb") as source:
        found = inspect(source, max_vertices=job.max_vertices, progress=progress)
        checked(found.index, describe(found.index))
        source.seek(0)
        with NewFile(path) as target:
            while block := source.read(_BLOCK):
                digest.update(block)
                target.write(block)
    return digest.hexdigest(), CHECKED if found.errors_checked else TOLD


def figures_of(index: Index, known: Mapping[str, Any] | None, files: Sequence[Path]) -> dict[str, Any]:
    """What is told of a surface whose container has this index.

    Parameters
    ----------
    index : Index
    known : mapping or None
        What was told before: whose word its errors are stands nowhere else.
    files : sequence of Path
        The upload, as far as it is there. Where it is a container, and nothing was told before, nothing is vouched for.
    """
    from lodestream.container import describe

    info: dict[str, Any] = plain(describe(index))
    errors = (known or {}).get(ERRORS)
    if errors in (CHECKED, TOLD):
        info[ERRORS] = errors
    elif any(path.is_file() and is_container(path) for path in files):
        info[ERRORS] = TOLD
    return info


def checked(index: Index, info: dict[str, Any]) -> dict[str, Any]:
    """What is told of a container, in plain values that JSON has; refused where it has no words for them.

    Raises
    ------
    CorruptStreamError, TooLargeError
    """
    place = index.metadata
    name = index.metadata_values.get("name", "")
    if not isinstance(name, str) or len(name) > _LONGEST_NAME:
        raise CorruptStreamError(
            f"expected a name of at most {_LONGEST_NAME} characters, got {str(name)[:80]!a}", place.offset
        )
    try:
        told: dict[str, Any] = plain(info)
        json.dumps(told, allow_nan=False).encode()
    except (TypeError, ValueError, RecursionError) as error:
        raise CorruptStreamError(f"expected metadata that JSON can tell: {error}"[:300], place.offset) from None
    return told
