"""Limits on the counts of a container, so that its index and description stay small: section 14 of `docs/format.md`.

Writers keep these limits, and readers refuse a file that does not. They stand far above what most surfaces need: the
encoder makes some 20 layers of 30 kB and 60 of 3 MB. Only of surfaces with hundreds of channels it makes fewer than it
otherwise would, as `ERRORS` allows (`most_layers`).
"""

from __future__ import annotations

from collections.abc import Iterable

from ..errors import CorruptStreamError, TooLargeError

__all__ = [
    "BLOCKS",
    "CHANNELS",
    "CODECS",
    "ERRORS",
    "EXTRAS",
    "INTERFACES",
    "LAYERS",
    "MOST_SECTIONS",
    "NAMES",
    "OPTIONAL",
    "PATCHES",
    "check_count",
    "check_errors",
    "check_names",
    "most_layers",
]

#: Layers.
LAYERS = 1024
#: Channels of the points and of the attributes together.
CHANNELS = 4096
#: Errors of single channels that layers and levels carry: channels times layers and levels.
ERRORS = 1 << 16
#: Blocks, and the patches and interfaces that they are coded as.
BLOCKS, PATCHES, INTERFACES = 1 << 14, 1 << 16, 1 << 16
#: Bytes of the names of attributes in UTF-8, counted once for each channel.
NAMES = 1 << 16
#: Bytes of the extras: names, the rules of a plane, joints.
EXTRAS = 1 << 22
#: Codecs that a header lists.
CODECS = 64
#: Optional sections.
OPTIONAL = 256
#: Sections: these, the layers, and header, masks, residual, metadata, pages and root.
MOST_SECTIONS = LAYERS + OPTIONAL + 6


def check_count(count: int, most: int, what: str, offset: int | None = None, advice: str = "") -> None:
    """Refuse more of something than a container may have.

    Parameters
    ----------
    count, most : int
    what : str
        Plural of what is counted.
    offset : int or None
        Where a container tells the count; None: of a surface that is to be encoded.
    advice : str
        What to do, for the end of the message.

    Raises
    ------
    CorruptStreamError
        In a container.
    TooLargeError
        In a surface.
    """
    if count <= most:
        return
    problem = f"expected at most {most:,} {what}, got {count:,}{advice}"
    raise TooLargeError(problem) if offset is None else CorruptStreamError(problem, offset)


def check_names(names: Iterable[tuple[str, int]], offset: int | None = None) -> None:
    """Refuse names of attributes, each with its number of channels, that are too long together; see `check_count`."""
    total = sum(len(name.encode("utf-8", "surrogatepass")) * channels for name, channels in names)
    check_count(total, NAMES, "bytes of names of attributes, each counted for all of its components", offset)


def most_layers(channels: int, levels: int) -> int:
    """Return how many layers a container may have, 0 if none; ``levels`` includes the coarsest one."""
    return max(0, min(LAYERS, ERRORS // channels - levels))


def check_errors(channels: int, layers: int, levels: int, offset: int | None = None) -> None:
    """Refuse more errors of channels in layers and levels than a container may have; see `check_count`."""
    advice = ": encode some of the attributes as another surface" if offset is None else ""
    count = channels * (layers + levels)
    check_count(count, ERRORS, "errors of channels in layers and levels", offset, advice)
