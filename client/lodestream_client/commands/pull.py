"""``lodestream pull``: stream a surface from a server into a file."""

from __future__ import annotations

import argparse
import time
from collections.abc import Iterator
from contextlib import contextmanager
from typing import TYPE_CHECKING, Any

from lodestream.errors import CorruptStreamError, LodestreamError, NotFoundError
from lodestream.target import Target

from .. import addresses
from .arguments import (
    Subparsers,
    add_command,
    add_json_option,
    add_rate_option,
    add_target_options,
    add_token_option,
    parse_seconds,
    parse_source,
    target_of,
    token_of,
)
from .outcome import Outcome, check_grid, check_out, note_unmet
from .output import human_size, note, progress_bar

if TYPE_CHECKING:
    from ..cache import Part
    from ..requests import Identity
    from ..sync import Stream

__all__ = ["register", "run"]

# Seconds without a word after which a connection counts as lost.
_SILENCE = 30.0


def register(subparsers: Subparsers) -> None:
    """Add the sub-command."""
    parser = add_command(
        subparsers,
        "pull",
        run,
        "stream a surface, or as much of it as is wanted, from a server into a file",
        "The suffix of OUT names its format; standard output gets NPY. A connection that breaks is replaced, and what\n"
        "has come is not sent again.",
    )
    parser.add_argument(
        "url", type=parse_source, metavar="URL", help="the surface's address, or that of a container on any web server"
    )
    parser.add_argument("out", metavar="OUT", help="file to write; - for standard output")
    add_target_options(parser)
    add_rate_option(parser)
    parser.add_argument(
        "--resume",
        action="store_true",
        help="keep what comes in LODESTREAM_CACHE (default: the user's cache folder) until the whole surface has been "
        "written, and ask only for what is not there",
    )
    parser.add_argument(
        "--transport",
        choices=("auto", "ws", "http"),
        default="auto",
        help="by WebSocket, or in parts of the container by HTTP Range; auto takes the second where the first does not "
        "come through (default: auto)",
    )
    parser.add_argument(
        "--replica",
        dest="replicas",
        action="append",
        default=[],
        type=parse_source,
        metavar="URL",
        help="another address of the same surface, to go on from when a connection fails; may be repeated",
    )
    parser.add_argument(
        "--retry",
        type=parse_seconds,
        default=60.0,
        metavar="S",
        help="give up when no byte has come for S seconds since a connection was lost or fell silent; 0 replaces no "
        "connection (default: 60)",
    )
    add_token_option(parser)
    add_json_option(parser)


def run(args: argparse.Namespace) -> int:
    """Stream, write, report."""
    target = target_of(args)
    if args.transport == "ws" and not all(map(addresses.is_surface, (args.url, *args.replicas))):
        args.parser.error("argument --transport: a file's address has no WebSocket")
    check_out(args)

    import lodestream.decoder  # noqa: F401  (what it brings takes a second, which is none of the stream's)

    started = time.monotonic()
    with _part(args) as (part, identity):
        outcome = _pull(args, target, part, identity, started)
        outcome.write(args.out)
        outcome.report(args.json)
        if part is not None and outcome.ended == "complete":
            part.discarded = True
    return 0


def _pull(
    args: argparse.Namespace, target: Target, part: Part | None, identity: Identity | None, started: float
) -> Outcome:
    from .. import sync

    with _Progress(target) as bar:
        stream = sync.connect(
            [args.url, *args.replicas],
            target=target,
            token=token_of(args),
            transport=args.transport,
            deadline=args.retry,
            silence=min(args.retry, _SILENCE) or _SILENCE,
            limit_rate=args.limit_rate,
            store=part,
            container=identity.container if identity is not None else None,
            size=identity.size if identity is not None else None,
            progress=bar.received,
        )
        with stream:
            for number, view in enumerate(stream):
                if number == 0 and stream.decoder.header is not None:
                    check_grid(args.out, stream.decoder.header)
                bar.figures = f"{human_size(view.bytes)}, level {view.level}, RMS error {view.rms:.4g}"
    seconds = time.monotonic() - started
    decoder = stream.decoder
    wire_bytes = stream.wire_bytes
    metadata = decoder.metadata
    if metadata is None:
        metadata, more = _metadata(stream, part, token_of(args))
        wire_bytes += more
    view = decoder.view()
    header, ended = decoder.header, stream.ended
    assert header is not None, "there is a view, so there is a header"
    assert ended is not None, "the iteration has ended"
    note_unmet(target, ended, view.rms, view.max_error, header.extent)
    surface = view.surface(target.level, metadata)
    return Outcome(surface, view.bytes, wire_bytes, view.level, view.rms, view.max_error, seconds, ended)


@contextmanager
def _part(args: argparse.Namespace) -> Iterator[tuple[Part | None, Identity | None]]:
    """What is kept from before, and room for more; nothing where that is not wanted or not possible."""
    if not args.resume:
        yield None, None
        return
    from .. import sync
    from ..cache import Part, cache_folder, forget_old

    identity = sync.identify(args.url, token=token_of(args))
    if identity.name is None or identity.size is None:
        note("the server does not tell one version of the file from another: nothing is kept")
        yield None, None
        return
    folder = cache_folder()
    forget_old(folder)
    part = Part(folder, identity.name, identity.size)
    if part.ranges.total:
        note(f"{human_size(part.ranges.total)} are here from before")
    try:
        yield part, identity
    except CorruptStreamError:
        # Not to be met again next time.
        part.discarded = True
        raise
    except LodestreamError:
        if part.ranges.total:
            note(f"{human_size(part.ranges.total)} are kept; pull --resume goes on from there")
        raise
    finally:
        part.close()


class _Progress:
    """A bar that is moved with every message, and knows how long is left."""

    def __init__(self, target: Target) -> None:
        self.figures = ""
        self._bar = progress_bar()
        self._seconds = target.seconds

    def __enter__(self) -> _Progress:
        self._shown = self._bar.__enter__()
        self._started = time.monotonic()
        self._task = self._shown.add_task("pulling", total=None, figures="", limit=self._seconds)
        return self

    def __exit__(self, *raised: Any) -> None:
        self._bar.__exit__(*raised)

    def received(self, received: int, planned: int | None) -> None:
        """So much of so much has come."""
        self._shown.update(self._task, total=planned, completed=received, figures=self.figures)


def _metadata(stream: Stream, part: Part | None, token: str | None) -> tuple[dict[str, Any], int]:
    # A stop of our own takes effect at once, so the stream has not brought the metadata, which stand at the end.
    from lodestream.container import ByteRange, read_metadata

    from .. import sync

    place = stream.metadata_place
    assert place is not None, "there is a view, so it is known where things stand"
    if part is not None and part.ranges.covers(*place):
        return read_metadata(part.read(*place), ByteRange(*place)), 0
    try:
        data = sync.fetch_range(stream.url, *place, token=token)
    except NotFoundError:
        raise
    except LodestreamError as error:
        note(f"written without its name and place, which could not be fetched: {error}")
        return {}, 0
    if part is not None:
        for offset, length in list(part.ranges.missing(*place)):
            part.write(offset, data[offset - place[0] : offset - place[0] + length])
    return read_metadata(data, ByteRange(*place)), len(data)
