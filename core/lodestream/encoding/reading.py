"""Read files into a folder, and reuse them when a build continues."""

from __future__ import annotations

import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from .. import __version__
from ..container.capacity import default_memory
from ..errors import InputError
from ..formats import read
from ..scratch import FolderScratch
from ..surface import Surface
from .folders import is_sealed, remove, seal
from .memory import WHOLE
from .references import file_state
from .room import CopyRoom
from .stored_surface import load_surface, save_surface

__all__ = ["read_into", "reading_key"]

#: The part of the memory that an array in memory may take.
_PART = 16


def reading_key(paths: Sequence[Path], **options: Any) -> str:
    """Return the key of the files that `read_into` leaves: the state of the source files, and the options."""
    # The name too, since it may say what is in a file, such as the position of an SRTM tile.
    states = [[str(path.absolute()), str(path.resolve()), *file_state(path)] for path in paths]
    return json.dumps([__version__, states, sorted((name, repr(value)) for name, value in options.items())])


def read_into(
    folder: Path,
    paths: Sequence[Path],
    memory: int | None = None,
    by_bands: bool = True,
    kept: bool = False,
    **options: Any,
) -> Surface:
    """Read a surface whose large arrays go into files of a folder.

    Parameters
    ----------
    folder : Path
        Is made where anything goes there.
    paths : sequence of Path
        Files of one surface.
    memory : int, optional
        Bytes to work in; by default a quarter of the machine's.
    by_bands : bool
        Whether it can be encoded by bands; then the disk needs room for that too.
    kept : bool
        Whether the folder is kept for another call with the same `reading_key`: what such a call has read is found
        there, unless a failure of the machine has damaged it.
    **options
        Of `lodestream.read`.

    Raises
    ------
    InputError
        If a file is written to, or another one gets its name, while it is read.
    TooLargeError
        If the disk has no room for the files, and for those of the build.
    LodestreamError, OSError
        From `lodestream.read`.
    """
    if kept and is_sealed(folder):
        stored = load_surface(FolderScratch(folder))
        if stored is not None:
            return stored
    remove(folder)
    states = [file_state(path) for path in paths]
    limit = default_memory() if memory is None else memory
    first, *more = paths
    room = CopyRoom(
        lambda: FolderScratch(folder),
        lambda: FolderScratch(folder).folder,
        limit // _PART,
        lambda values: by_bands and values * WHOLE > limit,
        memory,
    )
    surface = read(first, *more, room=room, **options)
    for path, state in zip(paths, states, strict=True):
        if file_state(path) != state:
            raise InputError(f"expected {path} to stay as it is until it is read, it was changed meanwhile")
    if not kept or not folder.exists() or surface.joints is not None:
        return surface
    save_surface(surface, FolderScratch(folder))
    seal(folder)
    return load_surface(FolderScratch(folder)) or surface
