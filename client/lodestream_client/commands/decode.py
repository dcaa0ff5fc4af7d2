"""``lodestream decode``: a container, or a part of it, into a file."""

from __future__ import annotations

import argparse
import time
from dataclasses import dataclass
from typing import TYPE_CHECKING, BinaryIO

from lodestream.errors import (
    CorruptStreamError,
    OptionError,
    StreamError,
    TooLargeError,
    TruncatedStreamError,
    UnsupportedVersionError,
)
from lodestream.target import Target

from ..terminal.interrupts import interruptible
from ..terminal.output import LONG, complain, progress_bar
from .arguments import Subparsers, add_command, add_json_option, add_size_option, standard_output_once
from .building_options import add_memory_option
from .decode_by_rows import by_rows
from .inputs import input_files, named
from .outcome import Outcome, channel_errors, check_grid, check_out, note_unmet
from .target_options import add_target_options, target_of

if TYPE_CHECKING:
    from collections.abc import Callable

    from lodestream.container import Index
    from lodestream.decoding.decoder import Decoder, View

__all__ = ["DecodeOptions", "decode_file", "register", "run"]

_CHUNK = 256 * 1024


def register(subparsers: Subparsers) -> None:
    """Add the sub-command."""
    parser = add_command(
        subparsers,
        "decode",
        run,
        "decode a container into a file, completely or up to a limit",
        "The suffix of OUT decides its format. Standard output is NPY.",
    )
    parser.add_argument("container", metavar="IN.lode", help="container to read; - for standard input")
    parser.add_argument("out", metavar="OUT", help="file to write; - for standard output")
    add_target_options(parser)
    add_size_option(parser)
    parser.add_argument(
        "--partial",
        action="store_true",
        help="accept a truncated or damaged container, and write its last complete layer",
    )
    group = parser.add_argument_group("surfaces larger than memory")
    add_memory_option(group)
    add_json_option(parser)


@dataclass(frozen=True)
class DecodeOptions:
    """What the command line asks of a decoding: `container` and `out` are files, ``-`` standard input and output."""

    container: str
    out: str
    target: Target
    max_vertices: int | None
    partial: bool
    memory: int | None
    json: bool


def _options(args: argparse.Namespace) -> DecodeOptions:
    """Return the options; end the program if the command line is wrong."""
    target = target_of(args)
    standard_output_once(args, "surface")
    return DecodeOptions(args.container, args.out, target, args.max_vertices, args.partial, args.memory, args.json)


@interruptible()
def run(args: argparse.Namespace) -> int:
    """Decode a container, write OUT, and report."""
    options = _options(args)
    decode_file(options).report(options.json)
    return 0


def decode_file(options: DecodeOptions) -> Outcome:
    """Decode a container, by bands where it does not fit into memory, and write OUT.

    Raises
    ------
    LodestreamError, OSError
        From reading, decoding and writing.
    """
    check_out(options.out)
    target, started = options.target, time.monotonic()
    with input_files([options.container]) as files, files.paths[0].open("rb") as file, progress_bar(LONG) as bar:
        task = bar.add_task("decoding", total=1.0, figures="")
        by_bands = by_rows(files.paths[0], options, started, lambda done: bar.update(task, completed=done))
        if by_bands is not None:
            return by_bands
        job = _Job(file, options, started, lambda done: bar.update(task, completed=done))
        try:
            job.decode()
        except StreamError as error:
            if not options.partial or isinstance(error, UnsupportedVersionError) or not job.decoder.layers:
                advice = _advice(options.partial, job, error)
                raise named(error, options.container, advice) from None
            complain(f"{named(error, options.container)}; the last complete layer before that is written")
            job.ended = "truncated"
        except TooLargeError as error:
            raise named(error, options.container) from None
    view = job.view or job.decoder.view()
    assert job.decoder.header is not None, "there is a view, so there is a header"
    note_unmet(target, job.ended, view, job.decoder.header)
    outcome = Outcome(
        view.surface(target.level, job.decoder.metadata or job.metadata),
        view.bytes,
        job.read.total,
        job.read.total,
        view.level,
        view.rms,
        view.max_error,
        view.bound,
        time.monotonic() - started,
        job.ended,
        channel_errors(view, job.decoder.header, target),
    )
    outcome.write(options.out)
    return outcome


def _advice(partial: bool, job: _Job, error: StreamError) -> str:
    """Return advice how to get more from a container that is cut or damaged; empty if there is none."""
    if job.decoder.layers:
        return "--partial writes the last complete layer before that"
    if job.by_level and isinstance(error, TruncatedStreamError):
        also = "" if partial else " with --partial"
        return f"without --level and --order level,{also} the last complete layer is written, if there is one"
    return ""


class _Job:
    """The decoding of one container."""

    def __init__(
        self,
        file: BinaryIO,
        options: DecodeOptions,
        started: float,
        progress: Callable[[float], None],
    ) -> None:
        from lodestream.decoding.decoder import Decoder
        from lodestream.planning.byte_ranges import RangeSet

        target = options.target
        self.decoder: Decoder = Decoder(target, max_vertices=options.max_vertices)
        self.ended = "complete"
        self.view: View | None = None  # where it ended, if more has been fed
        self.read = RangeSet()  # what was read; the header and the index more than once
        self.metadata: dict[str, object] | None = None
        self.by_level = target.level is not None or target.order == "level"
        self._file = file
        self._out = options.out
        self._size = file.seek(0, 2)
        self._target = target
        self._started = started
        self._progress = progress

    def decode(self) -> None:
        """Decode as far as the target asks; `ended` then has the reason of the end."""
        from lodestream.container import read_index
        from lodestream.container.capacity import Capacity

        try:
            index = read_index(self._read, self._size, Capacity(self.decoder.capacity.max_vertices))
        except (CorruptStreamError, TruncatedStreamError):
            # Without its index a container still has its prefix, which is all that quality order needs.
            if self.by_level:
                raise
            self._decode_prefix()
        else:
            self.metadata = dict(index.metadata_values)
            check_grid(self._out, index.header)
            self._decode_planned(index)
            self.decoder.view()  # whether the end is damaged

    def _read(self, offset: int, length: int) -> bytes:
        self._file.seek(offset)
        data = self._file.read(length)
        self.read.add(offset, len(data))
        return data

    def _late(self) -> bool:
        limit = self._target.seconds
        return limit is not None and time.monotonic() - self._started >= limit and bool(self.decoder.layers)

    def _decode_planned(self, index: Index) -> None:
        from lodestream.planning.planner import plan
        from lodestream.planning.window_errors import read_window_errors, wants_window_errors

        wanted = wants_window_errors(self._target, index.header)
        windows = read_window_errors(index, self._read) if wanted else None
        chosen = plan(index, self._target, windows=windows)
        self.ended = chosen.ended
        done = 0
        for place in (*chosen.before, *chosen.ranges, *chosen.after):
            for offset in range(place.offset, place.end, _CHUNK):
                if self._late():
                    self.ended = "seconds"
                    return
                data = self._read(offset, min(_CHUNK, place.end - offset))
                self.decoder.feed_at(offset, data)
                done += len(data)
                self._progress(min(done / max(chosen.bytes, 1), 1.0))

    def _decode_prefix(self) -> None:
        most = self._target.max_bytes
        end = self._size if most is None else min(self._size, most)
        offset = 0
        while offset < end:
            data = self._read(offset, min(_CHUNK, end - offset))
            offset += len(data)
            for view in self.decoder.feed(data):
                self.ended = self._met(view)
                if self.ended != "complete":
                    self.view = view
                    return
            self._progress(offset / end)
            if self._late():
                self.ended = "seconds"
                return
        if most is not None and self._size >= most and not self.decoder.complete:
            if not self.decoder.layers:
                raise OptionError(f"expected at least the bytes of the first layer, got {most}")
            self.ended = "bytes"
            return
        self.decoder.finish()

    def _met(self, view: View) -> str:
        from lodestream.planning.limits import ErrorLimits

        header = self.decoder.header
        assert header is not None, "there is a view, so there is a header"
        if view.complete:
            return "complete"
        limits = ErrorLimits.of(self._target, header)
        return limits.met(view.rms, view.max_error, view.channels) or "complete"
