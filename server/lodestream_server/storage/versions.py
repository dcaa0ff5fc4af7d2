"""Containers of another format version than this server reads; they are built again from their uploads."""

from __future__ import annotations

from pathlib import Path

from lodestream.errors import CorruptStreamError, UnsupportedVersionError

__all__ = ["other_version"]


def other_version(path: Path) -> str | None:
    """Return a message that names both versions, if a container has another version than this server reads; else None.

    Only the first bytes are read. The result is also None if they are damaged, or if the file is not a container, does
    not exist or cannot be read.
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
