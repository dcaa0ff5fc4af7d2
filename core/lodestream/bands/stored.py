"""What tasks leave for each other: pieces of a channel's flat arrays, by the tiles that they hold."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..entropy.part_table import flat_span
from .build import Build

__all__ = ["PLAIN", "kind_of", "name_of", "pieces_of", "read_tiles", "stored_tiles", "transformed"]

#: The file that says which channels are transformed with the default predictors, bool, shape (channel,).
PLAIN = "plain"

#: What stands for the number of a band where a level has none: the core is one piece.
CORE = 0


def name_of(kind: str, channel: int, level: int, band: int) -> str:
    """The name of a file."""
    return f"{kind}/{channel}/{level}/{band}"


def kind_of(kind: str, fit: bool) -> str:
    """What the transform of a channel leaves, with fitted predictors or else with the default ones.

    The names differ, so that a late task of the one leaves nothing for the other.
    """
    return kind if fit else f"plain-{kind}"


def transformed(build: Build, kind: str, channel: int) -> str:
    """The kind under which a channel has this when all channels are transformed."""
    return kind_of(kind, not build.scratch.read(PLAIN)[channel])


def pieces_of(build: Build) -> list[tuple[int, int, range]]:
    """All pieces: level, band and tiles of each, parents before children. The core stands under its finest level."""
    bands = build.bands
    pieces = [(bands.core, CORE, bands.core_tiles)]
    return pieces + [(level, band.number, band.tiles) for level in bands.levels for band in bands.of(level)]


def stored_tiles(build: Build, kind: str, channel: int, tiles: range) -> Iterator[tuple[slice, NDArray[Any]]]:
    """What neighbouring tiles of a level, or of levels of the core, have in the flat array of a kind, piece by piece.

    Yields where a piece goes among that of these tiles, and what it has, shape (number,), not to be changed.
    """
    table, bands = build.table, build.bands
    level = build.prepared.layout.level_of(tiles.start)
    wanted = flat_span(table, tiles)
    for at, number, own in pieces_of(build):
        if at != max(level, bands.core) or own.stop <= tiles.start or own.start >= tiles.stop:
            continue
        piece, place = build.scratch.read(name_of(kind, channel, at, number)), flat_span(table, own)
        low, high = max(place.start, wanted.start), min(place.stop, wanted.stop)
        yield slice(low - wanted.start, high - wanted.start), piece[low - place.start : high - place.start]


def read_tiles(build: Build, kind: str, channel: int, tiles: range) -> NDArray[Any]:
    """The same in one array, shape (number,). There is at least one tile."""
    span = flat_span(build.table, tiles)
    found: NDArray[Any] | None = None
    for place, piece in stored_tiles(build, kind, channel, tiles):
        if found is None:
            found = np.empty(span.stop - span.start, piece.dtype)
        found[place] = piece
    assert found is not None  # every tile is in a piece
    return found
