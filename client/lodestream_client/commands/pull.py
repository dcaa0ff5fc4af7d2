"""``lodestream pull``: stream a surface from a server into a file."""

from __future__ import annotations

import argparse
import time
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

from lodestream.errors import (
    CorruptStreamError,
    FormatError,
    InputError,
    LodestreamError,
    NotFoundError,
    TooLargeError,
    UnsupportedVersionError,
)
from lodestream.target import Target

from ..requests import addresses
from ..terminal.interrupts import exit_code, interruptible
from ..terminal.output import human_size, note, progress_bar
from .arguments import (
    Subparsers,
    add_command,
    add_json_option,
    add_rate_option,
    add_size_option,
    add_target_options,
    add_token_option,
    parse_seconds,
    parse_source,
    standard_output_once,
    target_of,
    token_of,
)
from .keeping import Kept
from .outcome import Outcome, channel_errors, check_grid, check_out, note_unmet

if TYPE_CHECKING:
    from ..stream.reconnecting import Transport
    from ..sync import Stream

__all__ = ["PullOptions", "register", "run"]

# Seconds without a word after which a connection counts as lost.
_SILENCE = 30.0

# Seconds for what is fetched after an interruption: somebody waits for the end, or the server is gone.
_HURRY = 3.0


def register(subparsers: Subparsers) -> None:
    """Add the sub-command."""
    parser = add_command(
        subparsers,
        "pull",
        run,
        "stream a surface from a server into a file, completely or up to a limit",
        "The suffix of OUT decides its format. Standard output is NPY. If the connection breaks, pull reconnects\n"
        "and continues where it was. After Ctrl-C, or if the server does not come back, OUT is written from the\n"
        "data received so far, which are also kept for --resume.",
    )
    parser.add_argument(
        "url", type=parse_source, metavar="URL", help="URL of the surface, or of a container on any web server"
    )
    parser.add_argument("out", metavar="OUT", help="file to write; - for standard output")
    add_target_options(parser)
    add_rate_option(parser)
    add_size_option(parser)
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
    resume, json : bool
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

    @property
    def name(self) -> str:
        """What is written, in words."""
        return "standard output" if self.out == "-" else self.out

    @property
    def whole(self) -> bool:
        """Whether the target is all of the surface, where no limit is met before."""
        return self.target.region is None and self.target.attributes is None and self.target.level is None


def _options(args: argparse.Namespace) -> PullOptions:
    """The options; ends the program if the command line is wrong."""
    target = target_of(args)
    if args.transport == "ws" and not addresses.is_surface(args.url):
        args.parser.error("argument --transport: the URL of a file has no WebSocket")
    standard_output_once(args, "surface")
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
    )


def run(args: argparse.Namespace) -> int:
    """Stream, write, report; of what came before an interruption too."""
    options = _options(args)
    check_out(options.out)
    with interruptible(), Kept(options.resume) as kept:
        return _pull(options, kept)


def _pull(options: PullOptions, kept: Kept) -> int:
    try:
        outcome, broke = _written(options, kept)
    except KeyboardInterrupt as interrupt:
        raise type(interrupt)(f"{_words(interrupt)}: {options.name} is not written") from None
    outcome.report(options.json)
    if broke is None or outcome.ended == "complete":
        kept.done(outcome.ended == "complete" and options.whole)
    if broke is None:
        return 0
    note("; ".join(filter(None, (f"the data received so far are written to {options.name}", kept.words))))
    return exit_code(broke) if isinstance(broke, KeyboardInterrupt) else 1


def _written(options: PullOptions, kept: Kept) -> tuple[Outcome, KeyboardInterrupt | LodestreamError | None]:
    """What has been written, and what ended the stream before it had all that was asked for."""
    import lodestream.decoding.decoder  # noqa: F401  (what it brings takes a second, which is none of the stream's)

    from .. import sync

    started = time.monotonic()
    if options.resume:
        kept.use(sync.identify(options.url, token=options.token))
    stream, broke = _receive(options, kept)
    if broke is not None:
        if not stream.decoder.layers:
            if not isinstance(broke, KeyboardInterrupt | InputError | NotFoundError):
                broke.args = (f"{_words(broke)}: the first layer has not arrived, and {options.name} is not written",)
            raise broke
        note(_words(broke))
        kept.failed(broke)
    outcome = _outcome(options, kept, stream, started, hurried=broke is not None)
    outcome.write(options.out)
    return outcome, broke


def _receive(options: PullOptions, kept: Kept) -> tuple[Stream, KeyboardInterrupt | LodestreamError | None]:
    """The stream at its end, and what ended it before it had all that was asked for.

    Raises
    ------
    KeyboardInterrupt, LodestreamError
        Before there is a stream, or when what came is of no use, or not to be written.
    """
    from .. import sync

    broke: KeyboardInterrupt | LodestreamError | None = None
    identity = kept.identity
    with _Progress(options.target) as bar:
        stream = sync.connect(
            options.url,
            target=options.target,
            token=options.token,
            transport=options.transport,
            deadline=options.retry,
            silence=min(options.retry, _SILENCE) or _SILENCE,
            limit_rate=options.limit_rate,
            store=kept.store,
            container=identity.container if identity is not None else None,
            size=identity.size if identity is not None else None,
            progress=bar.received,
            sink=None if options.resume else kept.write,
            max_vertices=options.max_vertices,
        )
        kept.follow(stream)
        try:
            with stream:
                for number, view in enumerate(stream):
                    if number == 0 and stream.decoder.header is not None:
                        check_grid(options.out, stream.decoder.header)
                    bar.figures = f"{human_size(view.bytes)}, level {view.level}, RMS error {view.rms:.4g}"
        except (FormatError, CorruptStreamError, TooLargeError, UnsupportedVersionError):
            raise
        except (KeyboardInterrupt, LodestreamError) as error:
            broke = error
    return stream, broke


def _outcome(options: PullOptions, kept: Kept, stream: Stream, started: float, *, hurried: bool) -> Outcome:
    seconds = time.monotonic() - started
    decoder, target = stream.decoder, options.target
    wire_bytes = stream.wire_bytes
    metadata = decoder.metadata
    if metadata is None:
        metadata, more = _metadata(stream, kept, options.token, hurried=hurried)
        wire_bytes += more
    view = decoder.view()
    header, ended = decoder.header, stream.ended
    assert header is not None, "there is a view, so there is a header"
    assert ended is not None, "the iteration has ended"
    note_unmet(target, ended, view, header)
    surface, errors = view.surface(target.level, metadata), (view.rms, view.max_error, view.bound)
    channels = channel_errors(view, header)
    return Outcome(surface, view.bytes, wire_bytes, view.level, *errors, seconds, ended, channels)


def _words(error: BaseException) -> str:
    return " ".join(str(error).split()) or "interrupted"


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


def _metadata(stream: Stream, kept: Kept, token: str | None, *, hurried: bool) -> tuple[dict[str, Any], int]:
    # A stop of our own takes effect at once, so the stream has not brought the metadata, which stand at the end.
    from lodestream.container import ByteRange, read_metadata

    from .. import sync
    from ..requests.calls import TIMEOUT

    place = stream.metadata_place
    if place is None:  # over HTTP layers may come before it is known
        note("written without metadata such as name and position, which have not arrived")
        return {}, 0
    if (data := kept.read(*place)) is not None:
        return read_metadata(data, ByteRange(*place)), 0
    try:
        data = sync.fetch_range(stream.url, *place, token=token, timeout=_HURRY if hurried else TIMEOUT)
    except LodestreamError as error:
        if isinstance(error, NotFoundError) and not hurried:
            raise
        note(f"written without metadata such as name and position, which could not be fetched: {error}")
        return {}, 0
    kept.write(place[0], data)
    return read_metadata(data, ByteRange(*place)), len(data)
