"""The end of ``decode`` and ``pull``: a surface in some state, written and reported."""

from __future__ import annotations

import math
import sys
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING

from lodestream.errors import FormatError, InputError
from lodestream.target import Target

from ..terminal.output import human_size, note, print_json, require_folder, require_parent, working

if TYPE_CHECKING:
    from lodestream.container import Header
    from lodestream.decoding.decoder import View
    from lodestream.surface import Surface

__all__ = ["Outcome", "channel_errors", "check_grid", "check_out", "note_unmet", "write_surface"]


def check_out(out: str) -> None:
    """Check early that OUT can be written.

    Raises
    ------
    InputError
        If the folder does not exist, no format has this suffix, or there is a folder of this name, unless it is empty
        and the format is a folder.
    """
    if out == "-":
        return
    path = Path(out)
    require_parent(path)

    from lodestream.formats import for_writing

    if for_writing(path).folder is None:
        require_folder(path)
    elif path.is_dir() and any(path.iterdir()):
        raise InputError(f"cannot write {path}: it is a folder with files; remove it, or choose another name")


def check_grid(out: str, header: Header) -> None:
    """Check before the data arrive that the format of OUT can hold the surface.

    Raises
    ------
    FormatError
        If there are several blocks and the format holds only one.
    """
    from lodestream.formats import check_blocks, for_writing, formats

    # Standard output gets NPY.
    format_ = next(it for it in formats() if it.name == "npy") if out == "-" else for_writing(out)
    try:
        check_blocks(format_, len(header.blocks))
    except FormatError as error:
        raise FormatError(f"{'standard output' if out == '-' else out}: {error}") from None


def write_surface(surface: Surface, out: str) -> None:
    """Write a surface to the file OUT; to standard output (``-``) as NPY."""
    from lodestream import formats

    with working("writing"):
        if out == "-":
            formats.write_stream(surface, "npy", sys.stdout.buffer)
        else:
            formats.write(surface, out)


def note_unmet(target: Target, ended: str, view: View, header: Header) -> None:
    """Report a limit that could not be reached although everything arrived."""
    if ended != "complete":
        return
    from lodestream.planning.limits import ErrorLimits

    what = "window is only known to have at most" if view.bound else "surface has"
    for which, name, error_found in ErrorLimits.of(target, header).unmet(view.rms, view.max_error, view.channels):
        error = {"rms": "RMS", "max": "maximum"}[which] + " error" + ("" if name is None else f" of {name}")
        note(f"the requested {error} cannot be reached: the complete {what} {error_found:.6g}")


def channel_errors(view: View, header: Header, target: Target) -> dict[str, tuple[float, float]]:
    """Return RMS and maximum error by name of each channel that is in the target and has errors in the view."""
    from lodestream.planning.selection import selection_of

    channels = zip(header.channel_names, view.channels, selection_of(target).channels(header), strict=False)
    return {name: errors for name, errors, wanted in channels if wanted}


@dataclass(frozen=True)
class Outcome:
    """A surface in the state in which receiving it ended, with the figures of that state.

    `read` are the bytes of the container that were read or received, each counted once; `wire_bytes` all bytes, with
    those of messages.
    """

    surface: Surface
    bytes: int
    read: int
    wire_bytes: int
    level: int
    rms: float
    max_error: float
    bound: bool
    seconds: float
    ended: str
    channels: Mapping[str, tuple[float, float]] = field(default_factory=dict)

    def write(self, out: str) -> None:
        """Write the surface; to standard output as NPY."""
        write_surface(self.surface, out)

    def report(self, as_json: bool) -> None:
        """Print the figures: with ``--json`` on standard output, otherwise as a note on standard error."""
        if as_json:
            print_json(
                {
                    "bytes": self.bytes,
                    "wire_bytes": self.wire_bytes,
                    "level": self.level,
                    "rms": None if math.isnan(self.rms) else self.rms,
                    "max": None if math.isnan(self.max_error) else self.max_error,
                    "bound": self.bound,
                    **({"channels": dict(self.channels)} if self.channels else {}),
                    "seconds": round(self.seconds, 6),
                    "ended": self.ended,
                }
            )
            return
        within = "at most " if self.bound else ""
        note(
            f"{self.ended}: level {self.level}, "
            f"RMS error {within}{self.rms:.6g}, maximum {within}{self.max_error:.6g}, "
            f"{human_size(self.bytes)} of the surface ({human_size(self.read)} of the container read) "
            f"in {self.seconds:.1f} s"
        )
