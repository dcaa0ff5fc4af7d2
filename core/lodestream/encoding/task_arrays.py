"""Arrays that tasks pass to each other: file names, and pieces of a channel's flat arrays by their tiles."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..decoding.measurer import Figures
from ..entropy.part_table import Part, flat_span
from ..entropy.tiles import Tiles
from ..transform.predictors import default_predictors
from .build import Build
from .coding import Units

__all__ = [
    "CORE",
    "PLAIN",
    "forget_known",
    "keep_known",
    "kind_of",
    "known_tiles",
    "name_of",
    "name_of_fit",
    "pieces_of",
    "read_figures",
    "read_tiles",
    "rules_of",
    "stored_tiles",
    "transformed",
    "write_figures",
    "write_residual",
]

#: The file that says which channels are transformed with the default predictors, bool, shape (channel,).
PLAIN = "plain"

#: What a reader knows of a channel in the end, see `Tiles`; kept of a build in one piece.
_KNOWN = ("known", "sign", "early")

#: What stands for the number of a band where a level has none: the core is one piece.
CORE = 0


def name_of(kind: str, channel: int, level: int, band: int) -> str:
    """Return the name of the file of a kind for a channel, level and band."""
    return f"{kind}/{channel}/{level}/{band}"


def name_of_fit(kind: str, channel: int, fit: int, *place: int) -> str:
    """Return the beginning of the names of a channel's transform, see `kind_of`; level, piece and so on follow."""
    return "/".join([kind_of(kind, bool(fit)), *map(str, (channel, *place))])


def kind_of(kind: str, fit: bool) -> str:
    """Return the kind of arrays that the transform of a channel leaves, with fitted or with default predictors.

    The names differ, so that a late task of the one leaves nothing for the other.
    """
    return kind if fit else f"plain-{kind}"


def transformed(build: Build, kind: str, channel: int) -> str:
    """Return the kind of arrays that a channel has when all channels are transformed."""
    return kind_of(kind, not build.scratch.read(PLAIN)[channel])


def pieces_of(build: Build) -> list[tuple[int, int, range]]:
    """Return level, band and tiles of all pieces, parents before children.

    The core has the number of its finest level.
    """
    pieces = build.pieces
    core = (pieces.core, CORE, pieces.core_tiles)
    return [core, *((level, piece.number, piece.tiles) for level in pieces.levels for piece in pieces.of(level))]


def stored_tiles(build: Build, kind: str, channel: int, tiles: range) -> Iterator[tuple[slice, NDArray[Any]]]:
    """Yield the parts of the flat array of a kind that belong to neighbouring tiles of a level, or of the core.

    Yields the place of a part among these tiles, and its values, shape (number,), which must not be changed.
    """
    table, core = build.table(channel), build.pieces.core
    level = build.prepared.layout.level_of(tiles.start)
    wanted = flat_span(table, tiles)
    for at, number, piece_tiles in pieces_of(build):
        if at != max(level, core) or piece_tiles.stop <= tiles.start or piece_tiles.start >= tiles.stop:
            continue
        piece, place = build.scratch.read(name_of(kind, channel, at, number)), flat_span(table, piece_tiles)
        low, high = max(place.start, wanted.start), min(place.stop, wanted.stop)
        yield slice(low - wanted.start, high - wanted.start), piece[low - place.start : high - place.start]


def read_tiles(build: Build, kind: str, channel: int, tiles: range) -> NDArray[Any]:
    """Return the parts that `stored_tiles` yields in one array, shape (number,). There is at least one tile."""
    span = flat_span(build.table(channel), tiles)
    flat: NDArray[Any] | None = None
    for place, piece in stored_tiles(build, kind, channel, tiles):
        if flat is None:
            flat = np.empty(span.stop - span.start, piece.dtype)
        flat[place] = piece
    assert flat is not None  # every tile is in a piece
    return flat


def keep_known(build: Build, channel: int, units: Units) -> None:
    """Keep the final coefficients of a coded channel in one piece, and the coefficients of its small units.

    These are the coder's arrays: measuring then takes nothing more for them.
    """
    scratch, core, tiles = build.scratch, build.pieces.core, units.coder.tiles[0]
    arrays: tuple[NDArray[Any], ...] = tiles.known, tiles.sign, tiles.early
    for kind, array in zip(_KNOWN, arrays, strict=True):
        scratch.write(name_of(kind, channel, core, CORE), array)
    small = flat_span(build.table(channel), range(build.first_large(channel, int(scratch.read("large")))))
    name = name_of(transformed(build, "coefficients", channel), channel, core, CORE)
    scratch.write(name, units.channel.true[small])


def forget_known(build: Build) -> None:
    """Drop the final coefficients of all channels, once a build in one piece needs no more of its states."""
    for kind in _KNOWN:
        build.scratch.remove(kind)


def known_tiles(build: Build, part: Part, channel: int) -> Tiles:
    """Return the final coefficients of a channel in some tiles, which have been coded; they must not be changed."""
    tiles = Tiles(part.table, build.quantiser_of(channel))
    if build.is_whole:
        assert part.table is build.table(channel)
        piece = channel, build.pieces.core, CORE
        tiles.known, tiles.sign, tiles.early = (build.scratch.read(name_of(kind, *piece)) for kind in _KNOWN)
        return tiles
    coefficients = transformed(build, "coefficients", channel)
    for run, span in part.spans:
        known, sign, early = tiles.known[span], tiles.sign[span], tiles.early[span]
        for place, true in stored_tiles(build, coefficients, channel, run):
            np.abs(true, out=known[place])
            np.sign(true, out=sign[place], casting="unsafe")
        for place, passes in stored_tiles(build, "early", channel, run):
            early[place] = passes
    return tiles


def rules_of(build: Build, channel: int, fit: int, level: int, rules: Sequence[int]) -> NDArray[np.int8]:
    """Return the predictors of a level for some rules alone, axes or `INTERFACES`; int8, shape (level, rule, 2)."""
    predictors = default_predictors(build.prepared.layout)
    for rule in rules:
        predictors[level - 1, rule] = build.scratch.read(name_of_fit("rules", channel, fit, level, rule))
    return predictors


def write_figures(build: Build, turn: int, number: int, figures: Figures) -> None:
    """Write what a run tells of the errors of the states of a turn."""
    build.scratch.write(f"squares/{turn}/{number}", figures.squares)
    build.scratch.write(f"equal/{turn}/{number}", figures.equal)
    build.scratch.write(f"counts/{turn}/{number}", figures.counts)


def read_figures(build: Build, turn: int, number: int) -> Figures:
    """Read what `write_figures` wrote."""
    return Figures(*(build.scratch.read(f"{kind}/{turn}/{number}") for kind in ("squares", "equal", "counts")))


def write_residual(
    build: Build, number: int, chunks: Sequence[bytes], kept: Sequence[bytes], exact: Sequence[bool]
) -> None:
    """Write the chunks of residual of a run, and those of holes that are kept."""
    scratch = build.scratch
    for kind, coded in (("chunks", chunks), ("kept-chunks", kept)):
        scratch.write(f"{kind}/{number}", np.frombuffer(b"".join(coded), np.uint8))
        scratch.write(f"{kind}-lengths/{number}", np.array([len(chunk) for chunk in coded], np.int64))
    scratch.write(f"exact/{number}", np.array(exact))
