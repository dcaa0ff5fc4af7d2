"""Containers of another version of the format than this server reads: they are built again from what was uploaded."""

from __future__ import annotations

from pathlib import Path

from lodestream.errors import CorruptStreamError, UnsupportedVersionError

__all__ = ["other_version"]


def other_version(path: Path) -> str | None:
    """Which version a container is of, where that is another one than this server reads, and which one that is.

    Only its first bytes are looked at: None of a container of this version, of what is damaged there or is no
    container, and of what is not there or cannot be read.
    """
    from lodestream.container.sections import SIGNATURE, check_signature

    try:
        with path.open("rb") as file:
            check_signature(file.read(len(SIGNATURE)))
    except UnsupportedVersionError as error:
        return str(error)
    except (CorruptStreamError, OSError):
        return None
    return None
