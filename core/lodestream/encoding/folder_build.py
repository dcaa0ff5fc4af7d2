"""A container that is built by bands in a folder, and that a later call can continue."""

from __future__ import annotations

import hashlib
import json
import os
from collections.abc import Callable
from concurrent.futures import Executor
from copy import copy
from pathlib import Path
from typing import Any
from uuid import uuid4

import numpy as np
from numpy.typing import NDArray

from .. import __version__
from ..errors import InputError
from ..library import fingerprint
from ..parallel import threads
from ..quality import Quality
from ..scratch import FolderScratch, Room, is_made
from ..surface import Surface
from .build import Build
from .executing import Execution
from .folders import BuildFolders, is_sealed, remove, remove_leftovers, seal
from .lattice_coordinates import exact_lattices
from .memory import BESIDE, OF_BAND, largest_block, masks_memory
from .phases import OutOfRangeError, Phases
from .pieces import CORE_POINTS
from .prepared import Prepared, prepare
from .references import file_state, root_of
from .room import FOR_A_VALUE, check_room
from .streams import shortest

__all__ = ["FolderBuild"]

#: Values of a band at least and at most.
_FEWEST, _MOST = 1 << 17, 1 << 22
#: Arrays of so many bytes that are needed beside the surface are in files.
_IN_A_FILE = 32 << 20


class FolderBuild:
    """A container that is made by bands, or goes on being made.

    Parameters
    ----------
    surface : Surface
        One that `goes_by_bands`.
    quality : Quality
    memory : int
        In bytes.
    executor : Executor or None
        None: threads of this process.
    progress : callable
        Is told the fraction done, 0 to 1.
    copied : bool
        Whether the surface was copied into files for this call, which say nothing about it.
    """

    def __init__(
        self,
        surface: Surface,
        quality: Quality,
        memory: int,
        executor: Executor | None,
        progress: Callable[[float], None],
        copied: bool = False,
    ) -> None:
        self._surface, self._quality, self._progress, self._executor = surface, quality, progress, executor
        n_threads = threads()
        points = sum(block.shape[0] * block.shape[1] for block in surface.blocks)
        channels = max(1, sum(a.size for a in self._arrays()) // points)
        room = max(memory - BESIDE - masks_memory(surface), 0) // (OF_BAND * channels)
        self._threads = 1 if executor is not None else max(1, min(n_threads, room // _FEWEST))
        self._points = min(max(room // self._threads, _FEWEST), _MOST)
        self._core = min(CORE_POINTS, max(self._points // 2, 1 << 12))
        self._room, self._channels, self._values = room, channels, points * channels
        self._copied = copied

    def _arrays(self) -> list[NDArray[Any]]:
        return [array for block in self._surface.blocks for array in (block.points, *block.attributes.values())]

    def _all(self) -> list[NDArray[Any]]:
        return [*self._arrays(), *(block.mask for block in self._surface.blocks if block.mask is not None)]

    def _beside(self) -> int:
        """Estimate the bytes of copies and lattice points, which a surface of several blocks takes in addition."""
        blocks = self._surface.blocks
        if len(blocks) == 1:
            return 0
        points = sum(block.points.nbytes + 4 * block.points.size for block in blocks)
        return points + sum(block.points.nbytes for block in blocks if block.mask is not None)

    def container(self, folders: BuildFolders) -> Path | None:
        """Build the container, and return its file in a folder of the call; None: it must be encoded in one piece.

        Raises
        ------
        InputError
            If a file that the surface is in has changed meanwhile, or another process makes the same container.
        TooLargeError
            If the disk has no room for it.
        UnavailableError
            If a worker has another version of this program or of numpy.
        """
        in_memory = sum(array.nbytes for array in self._all() if root_of(array) is None)
        files = [root_of(array) for array in self._all()]
        paths = sorted({str(Path(str(root.filename)).resolve()) for root in files if root is not None})
        states = [file_state(path) for path in paths]
        scratch = folders.build(self._key)
        check_room(scratch.folder, self._values * FOR_A_VALUE + in_memory + self._beside(), scratch.size())
        remove_leftovers(scratch.folder)
        container = self._container(scratch)
        for path, state in zip(paths, states, strict=True):
            if file_state(path) != state:
                remove(scratch.folder)  # its key has times that do not come again
                raise InputError(f"expected {path} to stay as it is until it is encoded, it was changed meanwhile")
        return container

    def _container(self, scratch: FolderScratch) -> Path | None:
        self._surface = self._in_files(scratch)
        # Not the files of the build that was cut: a late task of it could read them while they are written.
        remove(scratch.folder / "prepared")
        prepared_files = scratch.folder / "prepared" / uuid4().hex
        room = Room(lambda: FolderScratch(prepared_files), 0 if self._executor is not None else _IN_A_FILE)
        prepared = prepare(self._surface, self._quality, room)
        if prepared.arrangement is not None and self._executor is None:
            # No patch is divided.
            self._threads = max(1, min(self._threads, self._room * self._channels // largest_block(self._surface)))
        try:
            best = shortest(
                self._surface,
                prepared,
                lambda bits: self._stream(scratch, prepared, bits, room),
                lambda path: path.stat().st_size,
            )
        except OutOfRangeError:
            return None
        self._progress(1.0)
        return best

    def _in_files(self, scratch: FolderScratch) -> Surface:
        """Return the surface with all arrays in files, which tasks open.

        Arrays in memory would be sent to each of them.
        """
        files = FolderScratch(scratch.folder / "surface")
        written = scratch.lasting and is_sealed(files.folder)
        if not written:
            files = _emptied(files)

        # Copied, not made anew: that would look at all values, and put another mask into memory.
        blocks = [copy(block) for block in self._surface.blocks]
        for block, points in zip(
            blocks, _kept(files, "points", [block.points for block in blocks], written), strict=True
        ):
            block.points, block.attributes = points, dict(block.attributes)
        masked = [block for block in blocks if block.mask is not None]
        masks = [block.mask for block in masked if block.mask is not None]
        for block, mask in zip(masked, _kept(files, "masks", masks, written), strict=True):
            block.mask = mask
        for number, name in enumerate(blocks[0].attributes):
            given = [block.attributes[name] for block in blocks]
            for block, array in zip(blocks, _kept(files, f"attributes/{number}", given, written), strict=True):
                block.attributes[name] = array
        if scratch.lasting and not written:
            seal(files.folder)
        surface = copy(self._surface)
        surface.blocks = tuple(blocks)
        surface.joints = None  # the values say again which points are one
        return surface

    def _stream(self, scratch: FolderScratch, prepared: Prepared, bits: int | None, room: Room) -> Path:
        """Build the container of one stream, and return its file.

        Parts of an earlier build are used where they are intact.
        """
        name = "exact" if bits is None else f"bits-{bits}"
        whole, path = scratch.folder / f"{name}-whole", scratch.folder / f"{name}-whole" / "container"
        if scratch.lasting and is_sealed(whole):
            return path
        remove(whole)
        tasks = FolderScratch(scratch.folder / name, lasting=scratch.lasting)
        continued = any(tasks.folder.iterdir()) and tasks.is_whole()
        if not continued:
            tasks = _emptied(tasks)
        build = Build(tasks, prepared, exact_lattices(prepared, bits, room), self._points, self._core)
        if self._executor is not None:
            build.save(flush=True)
        whole.mkdir()
        try:
            with path.open("wb") as file:
                Phases(build, Execution(build, self._executor, self._threads), self._progress).write(file)
        except FileNotFoundError as error:
            gone = error.filename is None or not os.path.exists(error.filename)
            ours = error.filename is None or Path(error.filename).is_relative_to(tasks.folder)
            if continued and gone and ours:  # what was there of the stream was not all of it
                build.close()
                remove(tasks.folder)
                return self._stream(scratch, prepared, bits, room)
            if self._executor is None:
                raise
            raise InputError(
                f"expected workers that see the files of the build and of the surface, got none of {error.filename}"
            ) from error
        finally:
            build.close()
        if scratch.lasting:
            seal(whole)
        remove(tasks.folder)
        return path

    def _key(self) -> str:
        """Return the key of the files of this build.

        An interrupted build continues only if nothing in its key has changed.
        """
        blocks = self._surface.blocks
        key = {
            "version": [__version__, fingerprint(), np.__version__],
            "quality": repr(self._quality),
            "blocks": [[block.closed, list(block.attributes), block.mask is None] for block in blocks],
            "metadata": hashlib.sha256(repr(self._surface.metadata).encode()).hexdigest(),
            "arrays": [_identity(array, self._copied) for array in self._all()],
            "points": [self._points, self._core],
        }
        return json.dumps(key)


def _emptied(scratch: FolderScratch) -> FolderScratch:
    remove(scratch.folder)
    return FolderScratch(scratch.folder, lasting=scratch.lasting)


def _kept(files: FolderScratch, name: str, arrays: list[NDArray[Any]], written: bool) -> list[NDArray[Any]]:
    """Return arrays of one dtype, any shapes, all in files; those in memory go into one file.

    One file for all, because a process may have only so many open.
    """
    in_memory = [number for number, array in enumerate(arrays) if root_of(array) is None]
    if not in_memory:
        return arrays
    if not written:
        files.write_joined(name, [arrays[number] for number in in_memory])
    whole, stored, start = files.read(name), list(arrays), 0
    for number in in_memory:
        array = arrays[number]
        stored[number] = whole[start : start + array.size].reshape(array.shape)
        start += array.size
    return stored


def _identity(array: NDArray[Any], copied: bool) -> list[Any]:
    """Return the identity of an array: its file and offset there, or the digest of its values."""
    root = root_of(array)
    # What is stored through a map need not change its file's time.
    if copied or root is None or root.mode != "r" or is_made(root):
        digest = hashlib.sha256()
        for rows in array:
            digest.update(np.ascontiguousarray(rows).data)
        return [array.shape, array.dtype.str, root is None, digest.hexdigest()]  # those in memory go into a file
    path = str(Path(str(root.filename)).resolve())
    start = array.__array_interface__["data"][0] - root.__array_interface__["data"][0]
    return [array.shape, array.dtype.str, array.strides, path, root.offset + start, *file_state(path)]
