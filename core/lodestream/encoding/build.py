"""What every task of a build knows: the prepared surface, its lattices, its pieces. Workers open it from files."""

from __future__ import annotations

import os
import pickle
from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from threading import Lock

import numpy as np

from ..container.model import Header
from ..decoding.values import Values
from ..entropy.tiles import TileTable
from ..quantization.band_steps import Quantiser
from ..scratch import FolderScratch, MemoryScratch, Scratch
from .lattice_coordinates import Lattices, strips
from .pieces import CORE_POINTS, Pieces
from .prepared import Prepared
from .references import dump, load

__all__ = ["Build"]

#: Builds that a process has open at most.
_MOST = 2

_FILE, _HEADER = "build.pickle", "header"


@dataclass(frozen=True)
class _Facts:
    prepared: Prepared
    lattices: Lattices
    points: int
    core_points: int
    lasting: bool


class Build:
    """One stream of a surface, built by pieces in a folder.

    Parameters
    ----------
    scratch : Scratch
        Of this stream alone.
    prepared : Prepared
        What is large in it is memory-mapped where other processes are to open it.
    lattices : Lattices
        A stream for one error, whose lattices have a `fineness`, is made in one piece.
    points : int
        Of a piece, about. It decides about memory, not about bytes.
    core_points : int
        See `Pieces`.
    """

    def __init__(
        self, scratch: Scratch, prepared: Prepared, lattices: Lattices, points: int, core_points: int = CORE_POINTS
    ) -> None:
        self.scratch, self.prepared, self.lattices = scratch, prepared, lattices
        self.points, self._core_points = points, core_points
        #: Of the coordinates, where the stream is made for one error; known when they are transformed.
        self.quantiser: Quantiser | None = None
        #: Of a build in one piece what the last layer shows of each block, until its residual is coded.
        self.last: Mapping[int, Values] | None = None
        self._header: Header | None = None
        self._tables: dict[bool, TileTable] = {}

    @cached_property
    def pieces(self) -> Pieces:
        """The pieces that tasks work on."""
        prepared = self.prepared
        # Coordinates under holes are chosen for what is around them, and the pieces must not decide about bytes.
        with_holes = prepared.arrangement is None and prepared.surface.blocks[0].mask is not None
        return Pieces(prepared.layout, self.points, self._core_points, strips(prepared) if with_holes else None)

    def table(self, channel: int) -> TileTable:
        """Return the table of all tiles of a channel, the same object each time.

        Points of interfaces are coordinates. Only tables of a few layouts are cached, and a process may work on many.
        """
        kind = channel < self.prepared.geometric
        return self._tables.get(kind) or self._tables.setdefault(kind, TileTable.of(self.prepared.layout, kind))

    def quantiser_of(self, channel: int) -> Quantiser | None:
        """Return the quantiser of a channel, if it has one."""
        return self.quantiser if channel < self.prepared.geometric else None

    def first_large(self, channel: int, level: int) -> int:
        """Return the first tile of a channel that is a large unit if those of a level are.

        The number of tiles if none is.
        """
        return self.prepared.layout.tiles_from(0 if self.quantiser_of(channel) else level)

    @cached_property
    def is_whole(self) -> bool:
        """Whether all of the surface is one piece, in memory.

        Then no task runs twice, and arrays are freed after their last use.
        """
        layout = self.prepared.layout
        in_one = self.pieces.core == layout.levels and self.points >= layout.points(layout.levels)
        return in_one and isinstance(self.scratch, MemoryScratch)

    @property
    def channels(self) -> int:
        """Number of channels of the surface, attributes included."""
        return len(self.lattices.channels)

    @property
    def folder(self) -> str:
        """The folder from which other processes open this build; the scratch is in files."""
        assert isinstance(self.scratch, FolderScratch)
        return str(self.scratch.folder)

    def save(self, flush: bool = False) -> None:
        """Write the files from which other processes open this build; with ``flush``, also those on other machines."""
        assert isinstance(self.scratch, FolderScratch)
        facts = _Facts(self.prepared, self.lattices, self.points, self._core_points, self.scratch.lasting)
        dump(facts, Path(self.folder) / _FILE, flush)

    def save_header(self, header: Header) -> None:
        """Write the header, with the size of chunks, for the tasks that measure and code the residual."""
        self._header = header
        self.scratch.write(_HEADER, np.frombuffer(pickle.dumps(header, pickle.HIGHEST_PROTOCOL), np.uint8))

    def stored_header(self) -> Header:
        """Read the header that `save_header` wrote.

        Raises
        ------
        FileNotFoundError
            If it has written nothing yet.
        """
        if self._header is None:
            self._header = pickle.loads(self.scratch.read(_HEADER).data)
        assert self._header is not None
        return self._header

    @staticmethod
    def open(folder: str) -> Build:
        """Open the build that was saved in a folder; the same object for the same folder and file.

        Those whose folders are gone are forgotten.

        Raises
        ------
        FileNotFoundError
            If there is none, or a file is gone that the surface is in.
        UnavailableError
            If another version of this program has saved it, or one with another numpy.
        """
        # File systems of networks look anew when a file is opened; what they say of one otherwise may be old.
        with (Path(folder) / _FILE).open("rb") as file:
            state = os.fstat(file.fileno())
        return _opened(folder, (state.st_ino, state.st_size, state.st_mtime_ns))

    def close(self) -> None:
        """Drop the build from this process's cache.

        Mapped files keep their room on the disk even after they are deleted.
        """
        with _LOCK:
            _OPENED.pop(self.folder, None)


#: The builds that this process works on, by folder, with the state of their files.
_OPENED: dict[str, tuple[tuple[int, ...], Build]] = {}
_LOCK = Lock()


def _opened(folder: str, state: tuple[int, ...]) -> Build:
    with _LOCK:
        known = _OPENED.get(folder)
        if known is None or known[0] != state:
            for other in [other for other in _OPENED if other == folder or not Path(other).exists()]:
                del _OPENED[other]
            while len(_OPENED) >= _MOST:
                del _OPENED[next(iter(_OPENED))]
            facts: _Facts = load(Path(folder) / _FILE)
            scratch = FolderScratch(folder, make=False, lasting=facts.lasting)
            build = Build(scratch, facts.prepared, facts.lattices, facts.points, facts.core_points)
            known = _OPENED[folder] = state, build
        return known[1]
