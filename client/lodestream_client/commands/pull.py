"""``lodestream pull``: stream a surface from a server into a file."""

from __future__ import annotations

import argparse
import time
from contextlib import AbstractContextManager, nullcontext
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING

from lodestream.errors import (
    CorruptStreamError,
    FormatError,
    InputError,
    LodestreamError,
    NotFoundError,
    TooLargeError,
    UnsupportedVersionError,
)
from lodestream.planning.byte_ranges import RangeSet
from lodestream.target import Target

from ..requests import addresses
from ..terminal.interrupts import exit_code, interruptible
from ..terminal.output import complain, human_size, note
from .arguments import (
    Subparsers,
    add_command,
    add_json_option,
    add_rate_option,
    add_size_option,
    add_token_option,
    standard_output_once,
    token_of,
)
from .keeping import Kept
from .outcome import Outcome, channel_errors, check_grid, check_out, note_unmet
from .receiving import Metadata, Progress
from .target_options import add_target_options, target_of
from .values import parse_seconds, parse_source
from .watching import Watch, check_picture, check_watched

if TYPE_CHECKING:
    from ..client import Client
    from ..stream.blocking_stream import Stream
    from ..stream.reconnecting import Transport
    from ..viewer.drawing import Drawing

__all__ = ["PullOptions", "register", "run"]

# Seconds without a word after which a connection counts as lost.
_SILENCE = 30.0


def register(subparsers: Subparsers) -> None:
    """Add the sub-command."""
    parser = add_command(
        subparsers,
        "pull",
        run,
        "stream a surface from a server into a file, completely or up to a limit",
        "The suffix of OUT decides its format. Standard output is NPY. If the connection breaks, pull reconnects\n"
        "and continues where it was. After Ctrl-C, or if the server does not come back, OUT is written from the\n"
        "data received so far, which are also kept for --resume. --watch writes OUT after the first few kilobytes\n"
        "and rewrites it as the surface improves.",
    )
    parser.add_argument(
        "url", type=parse_source, metavar="URL", help="URL of the surface, or of a container on any web server"
    )
    parser.add_argument("out", metavar="OUT", help="file to write; - for standard output")
    add_target_options(parser)
    add_rate_option(parser)
    add_size_option(parser)
    parser.add_argument(
        "--watch",
        action="store_true",
        help="write OUT, and draw P.png, with the first data, and replace them as the surface improves, as often as "
        "they can be written while it arrives",
    )
    parser.add_argument(
        "--picture",
        type=Path,
        metavar="P.png",
        help="draw into a picture too, as view --png does",
    )
    parser.add_argument(
        "--until-done",
        action="store_true",
        help="with --watch and --picture: stop as soon as the picture looks done, that is, when less than 1 %% of its "
        "pixels will still change visibly, by an estimate",
    )
    parser.add_argument(
        "--resume",
        action="store_true",
        help="continue an earlier pull: request only the data that are missing in the folder LODESTREAM_CACHE "
        "(default: the user's cache folder), and keep new data there until the whole surface has been written",
    )
    parser.add_argument(
        "--transport",
        choices=("auto", "ws", "http"),
        default="auto",
        help="ws: WebSocket; http: HTTP Range requests; auto: WebSocket, or HTTP if WebSocket is not possible "
        "(default: auto)",
    )
    parser.add_argument(
        "--retry",
        type=parse_seconds,
        default=60.0,
        metavar="S",
        help="reconnect when the connection is lost or silent, and give up after S seconds without data; 0: never "
        "reconnect (default: 60)",
    )
    add_token_option(parser)
    add_json_option(parser)


@dataclass(frozen=True)
class PullOptions:
    """What the command line asks of a pull.

    Attributes
    ----------
    url, out : str
        Source, and file to write; ``-``: standard output.
    target : Target
    token : str or None
    transport : "auto", "ws" or "http"
    retry : float
        Seconds without data after which it gives up.
    limit_rate : float or None
        Bytes per second.
    max_vertices : int or None
    resume, json, watch : bool
    picture : Path or None
        Picture to draw beside OUT.
    until_done : bool
        Stop when the picture looks done.
    """

    url: str
    out: str
    target: Target
    token: str | None
    transport: Transport
    retry: float
    limit_rate: float | None
    max_vertices: int | None
    resume: bool
    json: bool
    watch: bool
    picture: Path | None
    until_done: bool

    @property
    def name(self) -> str:
        """Name of the output, for messages."""
        return "standard output" if self.out == "-" else self.out

    @property
    def whole(self) -> bool:
        """Whether the target is all of the surface, without a limit."""
        return self.target.region is None and self.target.attributes is None and self.target.level is None


def _options(args: argparse.Namespace) -> PullOptions:
    """Return the options; end the program if the command line is wrong."""
    target = target_of(args)
    if args.transport == "ws" and not addresses.is_served(args.url):
        args.parser.error("argument --transport: the URL of a file has no WebSocket")
    standard_output_once(args, "surface")
    if args.watch and args.out == "-":
        args.parser.error("argument --watch: standard output cannot be written again")
    if args.picture is not None and args.picture.suffix.lower() != ".png":
        args.parser.error(f"argument --picture: expected P.png, got {args.picture}")
    if args.picture is not None and args.picture == Path(args.out):
        args.parser.error("argument --picture: expected another name than OUT")
    if args.until_done and not (args.watch and args.picture is not None):
        args.parser.error("argument --until-done: needs --watch and --picture")
    others = target.until_rms, target.until_max, target.max_bytes, target.seconds, target.level, target.region
    if args.until_done and (any(other is not None for other in others) or target.order != "quality"):
        args.parser.error("argument --until-done: not allowed with another limit, a window, or the order of levels")
    return PullOptions(
        args.url,
        args.out,
        target,
        token_of(args),
        args.transport,
        args.retry,
        args.limit_rate,
        args.max_vertices,
        args.resume,
        args.json,
        args.watch,
        args.picture,
        args.until_done,
    )


def run(args: argparse.Namespace) -> int:
    """Stream, write and report, also after an interruption."""
    options = _options(args)
    check_out(options.out)
    if options.watch:
        check_watched(options.out)
    if options.picture is not None:
        check_picture(options.picture)
    from ..client import Client

    with interruptible(), Kept(options.resume) as kept, Client(options.url, token=options.token) as client:
        if addresses.is_named(options.url):
            # Once: all requests are of one container, whatever the name leads to meanwhile.
            options = replace(options, url=client.locate(options.url))
        with _drawing(options) as drawing:
            return _pull(client, options, kept, drawing)


def _drawing(options: PullOptions) -> AbstractContextManager[Drawing | None]:
    """Start the process that draws, if a picture is wanted, while the stream starts."""
    if options.picture is None:
        return nullcontext()
    from ..viewer.drawing import Drawing

    layers = None
    if options.until_done:
        from lodestream.opening import container

        from ..viewer.pictures import layers_of

        with container.open(options.url, token=options.token, max_vertices=options.max_vertices) as opened:
            layers = layers_of(opened)
    return Drawing(options.picture, options.url, window=options.target.region is not None, layers=layers)


def _pull(client: Client, options: PullOptions, kept: Kept, drawing: Drawing | None) -> int:
    try:
        outcome, broke = _written(client, options, kept, drawing)
    except KeyboardInterrupt as interrupt:
        raise type(interrupt)(f"{_words(interrupt)}: {options.name} is not written") from None
    outcome.report(options.json)
    if broke is None or outcome.ended == "complete":
        kept.done(outcome.ended == "complete" and options.whole)
    if broke is None:
        return 0
    complain("; ".join(filter(None, (f"the data received so far are written to {options.name}", kept.words))))
    return exit_code(broke) if isinstance(broke, KeyboardInterrupt) else 1


def _written(
    client: Client, options: PullOptions, kept: Kept, drawing: Drawing | None
) -> tuple[Outcome, KeyboardInterrupt | LodestreamError | None]:
    """Write OUT; return the outcome, and the error or interrupt that ended the stream early."""
    import lodestream.decoding.decoder  # noqa: F401  (what it brings takes a second, which is none of the stream's)

    started = time.monotonic()
    if options.resume:
        kept.use(client.identify(options.url))
    arrived = RangeSet()
    stream, metadata, broke = _receive(client, options, kept, drawing, arrived)
    if broke is not None:
        if not stream.decoder.layers:
            if not isinstance(broke, KeyboardInterrupt | InputError | NotFoundError):
                broke.args = (f"{_words(broke)}: the first layer has not arrived, and {options.name} is not written",)
            raise broke
        complain(_words(broke))
        kept.failed(broke)
    outcome = _outcome(options, stream, metadata, arrived, started)
    outcome.write(options.out)
    header = stream.decoder.header
    if drawing is not None and header is not None:
        drawing.draw(stream.decoder.view(), header.layout, metadata())
    if drawing is not None and drawing.done is not None and broke is None and outcome.ended == "stopped":
        from ..viewer.picture_change import done_text

        received, share = drawing.done
        note(done_text(received, stream.planned or outcome.bytes, share))
    return outcome, broke


def _receive(
    client: Client, options: PullOptions, kept: Kept, drawing: Drawing | None, arrived: RangeSet
) -> tuple[Stream, Metadata, KeyboardInterrupt | LodestreamError | None]:
    """Receive; return the stream at its end, its metadata, and the error or interrupt that ended it early.

    Raises
    ------
    KeyboardInterrupt, LodestreamError
        Before there is a stream, or when what came is of no use, or not to be written.
    """

    def take(offset: int, data: bytes) -> None:
        arrived.add(offset, len(data))
        if not options.resume:  # else the stream writes into the store itself
            kept.write(offset, data)

    broke: KeyboardInterrupt | LodestreamError | None = None
    identity = kept.identity
    with Progress(options.target) as bar:
        stream = client.connect(
            options.url,
            target=options.target,
            transport=options.transport,
            deadline=options.retry,
            silence=min(options.retry, _SILENCE) or _SILENCE,
            limit_rate=options.limit_rate,
            store=kept.store,
            container=identity.container_sha256 if identity is not None else None,
            size=identity.size if identity is not None else None,
            progress=bar.received,
            sink=take,
            max_vertices=options.max_vertices,
        )
        kept.follow(stream)
        if drawing is not None:
            drawing.when_done = stream.stop
        metadata = Metadata(stream, kept, client, arrived)
        watch = Watch(options.out, drawing, options.target, metadata) if options.watch else None
        try:
            with watch or nullcontext(), stream:
                for number, view in enumerate(stream):
                    header = stream.decoder.header
                    if number == 0 and header is not None:
                        check_grid(options.out, header)
                    bar.figures = f"{human_size(view.bytes)}, level {view.level}, RMS error {view.rms:.4g}"
                    if watch is not None and header is not None and not view.complete:
                        watch.write(view, header.layout)
        except (FormatError, CorruptStreamError, TooLargeError, UnsupportedVersionError):
            raise
        except (KeyboardInterrupt, LodestreamError) as error:
            broke = error
            metadata.hurried = True
    return stream, metadata, broke


def _outcome(options: PullOptions, stream: Stream, metadata: Metadata, arrived: RangeSet, started: float) -> Outcome:
    seconds = time.monotonic() - started
    decoder, target = stream.decoder, options.target
    values = metadata()
    view = decoder.view()
    header, ended = decoder.header, stream.ended
    assert header is not None, "there is a view, so there is a header"
    assert ended is not None, "the iteration has ended"
    note_unmet(target, ended, view, header)
    return Outcome(
        view.surface(target.level, values),
        view.bytes,
        arrived.total,
        stream.wire_bytes + metadata.bytes,
        view.level,
        view.rms,
        view.max_error,
        view.bound,
        seconds,
        ended,
        channel_errors(view, header, target),
    )


def _words(error: BaseException) -> str:
    return " ".join(str(error).split()) or "interrupted"
