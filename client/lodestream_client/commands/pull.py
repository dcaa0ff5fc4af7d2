"""``lodestream pull``: stream a surface from a server into a file."""

from __future__ import annotations

import argparse
import time
from typing import TYPE_CHECKING, Any

from lodestream.errors import LodestreamError, NotFoundError

from .arguments import (
    Subparsers,
    add_command,
    add_json_option,
    add_rate_option,
    add_target_options,
    add_token_option,
    parse_surface,
    target_of,
    token_of,
)
from .outcome import Outcome, check_out, note_unmet
from .output import human_size, note, progress_bar

if TYPE_CHECKING:
    from ..sync import Stream

__all__ = ["register", "run"]


def register(subparsers: Subparsers) -> None:
    """Add the sub-command."""
    parser = add_command(
        subparsers,
        "pull",
        run,
        "stream a surface, or as much of it as is wanted, from a server into a file",
        "The suffix of OUT names its format; standard output gets NPY.",
    )
    parser.add_argument("url", type=parse_surface, metavar="URL", help="the surface's address")
    parser.add_argument("out", metavar="OUT", help="file to write; - for standard output")
    add_target_options(parser)
    add_rate_option(parser)
    add_token_option(parser)
    add_json_option(parser)


def run(args: argparse.Namespace) -> int:
    """Stream, write, report."""
    target = target_of(args)
    check_out(args)

    import lodestream.decoder  # noqa: F401  (what it brings takes a second, which is none of the stream's)

    from .. import sync

    started = time.monotonic()
    with sync.connect(args.url, target=target, token=token_of(args), limit_rate=args.limit_rate) as stream:
        _follow(stream)
    seconds = time.monotonic() - started
    decoder = stream.decoder
    wire_bytes = stream.wire_bytes
    metadata = decoder.metadata
    if metadata is None:
        metadata, more = _fetch_metadata(args.url, stream, token_of(args))
        wire_bytes += more
    view = decoder.view()
    header, ended = decoder.header, stream.ended
    assert header is not None, "there is a view, so there is a header"
    assert ended is not None, "the iteration has ended"
    note_unmet(target, ended, view.rms, view.max_error, header.extent)
    surface = view.surface(target.level, metadata)
    outcome = Outcome(surface, view.bytes, wire_bytes, view.level, view.rms, view.max_error, seconds, ended)
    outcome.write(args.out)
    outcome.report(args.json)
    return 0


def _follow(stream: Stream) -> None:
    with progress_bar() as bar:
        task = bar.add_task("pulling", total=None, figures="")
        for view in stream:
            planned = stream.header.planned if stream.header is not None else None
            figures = f"{human_size(view.bytes)}, level {view.level}, RMS error {view.rms:.4g}"
            bar.update(task, total=planned, completed=view.bytes, figures=figures)


def _fetch_metadata(url: str, stream: Stream, token: str | None) -> tuple[dict[str, Any], int]:
    # A stop of our own takes effect at once, so the stream has not brought the metadata, which stand at the end.
    from lodestream.container import read_index

    from .. import sync

    received = 0

    def read(offset: int, length: int) -> bytes:
        nonlocal received
        data = sync.fetch_range(url, offset, length, token=token)
        received += len(data)
        return data

    assert stream.header is not None, "there is a view, so there is a header"
    try:
        index = read_index(read, stream.header.size)
    except NotFoundError:
        raise
    except LodestreamError as error:
        note(f"written without its name and place, which could not be fetched: {error}")
        return {}, received
    return dict(index.metadata_values), received
