"""Files read where there is room for them, and not again when a build goes on."""

from __future__ import annotations

import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from .. import __version__
from ..container.capacity import default_memory
from ..errors import InputError
from ..formats import read
from ..scratch import FolderScratch, boot_id
from ..surface import Surface
from .memory import WHOLE
from .references import file_state
from .room import CopyRoom
from .stored_surface import load_surface, save_surface

__all__ = ["read_into"]

#: The part of the memory that an array in memory may take.
_PART = 16
_KEY = "files.json"


def read_into(
    folder: Path, paths: Sequence[Path], memory: int | None = None, by_bands: bool = True, **options: Any
) -> Surface:
    """Read a surface whose large arrays go into files of a folder, or find it there as it was read before.

    Parameters
    ----------
    folder : Path
        Is made where anything goes there. What another surface has left there is removed.
    paths : sequence of Path
        Files of one surface.
    memory : int, optional
        Bytes to work in; by default a quarter of the machine's.
    by_bands : bool
        Whether it can be encoded by bands; then the disk needs room for that too.
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
    states = [file_state(path) for path in paths]
    key = json.dumps(
        [
            __version__,
            boot_id(),
            [[str(path.resolve()), *state] for path, state in zip(paths, states, strict=True)],
            sorted((name, repr(value)) for name, value in options.items()),
        ]
    )
    if (folder / _KEY).exists():
        found = _found(folder, key)
        if found is not None:
            return found
        FolderScratch(folder).clear()
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
    if not folder.exists() or surface.joints is not None:
        return surface
    save_surface(surface, FolderScratch(folder))
    (folder / _KEY).write_text(key)
    return load_surface(FolderScratch(folder)) or surface


def _found(folder: Path, key: str) -> Surface | None:
    """The surface that is in the folder; None: it is another one, or a failure of the machine has damaged it."""
    if (folder / _KEY).read_text(errors="replace") != key:
        return None
    try:
        return load_surface(FolderScratch(folder))
    except InputError:
        return None
