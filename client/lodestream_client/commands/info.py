"""``lodestream info``: the description of a container, or of a surface on a server."""

from __future__ import annotations

import argparse
from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from lodestream.errors import StreamError, TooLargeError, TruncatedStreamError
from lodestream.text import is_remeshed, remesh_words

from ..requests import addresses
from ..terminal.output import cell, console, human_size, point_words, print_json
from .arguments import Subparsers, add_command, add_json_option, add_size_option, add_token_option, token_of
from .inputs import input_files, named

__all__ = ["InfoOptions", "register", "run"]

# Of a surface that was uploaded as a container.
_ERRORS = {"checked": "checked by the server", "told": "stated by the uploader, not checked"}

_MOST_KINDS = 12  # sizes of blocks that are named
_MOST_CHANNELS = 6  # of which errors are shown; --json has all


def register(subparsers: Subparsers) -> None:
    """Add the sub-command."""
    parser = add_command(
        subparsers,
        "info",
        run,
        "show the size, levels, layers and errors of a container or of a surface on a server",
        "Levels: the bytes of each level with all coarser ones, and the error of the surface at that level.\n"
        "Layers: the bytes of the stream up to the end of each layer, and the error of the surface there.\n"
        "Of a container with several coordinates or attributes, the RMS error of each by itself follows.",
    )
    parser.add_argument(
        "what",
        metavar="FILE|URL",
        help="a container; - for standard input; or the URL of a surface, or of a container on any web server; or its "
        "address in a bucket",
    )
    add_size_option(parser, decodes=False)
    add_token_option(parser)
    add_json_option(parser)


@dataclass(frozen=True)
class InfoOptions:
    """Options from the command line: `what` is a file, ``-``, a URL or an address in a bucket."""

    what: str
    max_vertices: int | None
    token: str | None
    json: bool


def run(args: argparse.Namespace) -> int:
    """Read a description, and print it."""
    options = InfoOptions(args.what, args.max_vertices, token_of(args), args.json)
    details = _of_url(options) if addresses.is_url(options.what) else _of_file(options)
    if options.json:
        print_json(details)
    else:
        _show(options.what, details)
    return 0


def _of_url(options: InfoOptions) -> Mapping[str, Any]:
    from ..client import Client

    url = addresses.source_url(options.what)
    with Client(url, token=options.token) as client:
        if not addresses.is_served(url):
            return client.describe_file(url, max_vertices=options.max_vertices)
        surface = client.get(url)
    return {**surface.details, "url": surface.url}


def _of_file(options: InfoOptions) -> Mapping[str, Any]:
    from lodestream.opening import container
    from lodestream.opening.open_source import is_address

    if is_address(options.what):
        try:
            with container.open(options.what, max_vertices=options.max_vertices) as opened:
                return opened.info
        except (StreamError, TooLargeError) as error:
            raise named(error, options.what) from None
    with input_files([options.what]) as files:
        try:
            return container.open(files.paths[0], max_vertices=options.max_vertices).info
        except (StreamError, TooLargeError) as error:
            cut = isinstance(error, TruncatedStreamError)
            advice = "lodestream decode --partial writes its last complete layer, if it has one" if cut else ""
            raise named(error, options.what, advice) from None


def _show(what: str, details: Mapping[str, Any]) -> None:
    from rich.table import Table

    out = console()
    facts = Table(box=None, show_header=False, title=None, pad_edge=False)
    facts.add_column(style="bold" if out.is_terminal else "")
    facts.add_column()
    for name, value in _facts(details):
        facts.add_row(cell(name), cell(value))
    out.print(cell(what))
    out.print(facts)
    for kind in ("levels", "layers"):
        if details.get(kind):
            out.print()
            last = _last_state(details)
            exact = details.get("bytes") if kind == "layers" and details.get(last) else None
            out.print(_states(kind, details[kind], details.get("channel_names") or [], out.is_terminal, exact, last))
    more = len(details.get("channel_names") or []) - _MOST_CHANNELS
    if more > 0:
        out.print()
        out.print(f"and {more} more channels; --json lists their errors")


def _last_state(details: Mapping[str, Any]) -> str:
    """Return what the whole stream is called, and the key that says whether it restores every value."""
    return "complete" if is_remeshed(details.get("metadata") or {}) else "exact"


def _facts(details: Mapping[str, Any]) -> list[tuple[str, str]]:
    facts: list[tuple[str, str]] = []
    if details.get("state") not in (None, "ready"):
        facts.append(("state", f"{details['state']} {details.get('reason') or ''}".strip()))
    metadata = dict(details.get("metadata") or {})
    if "recognised" in metadata:
        facts.append(("recognised", str(metadata.pop("recognised"))))
    remeshed = remesh_words(metadata)
    if remeshed is not None:
        del metadata["remesh"]
        facts.append(("remeshed", remeshed))
    if details.get("blocks"):
        facts += _grids(details["blocks"])
        facts.append(("points", point_words(details)))
    if details.get("attributes"):
        facts.append(("attributes", ", ".join(map(str, details["attributes"]))))
    if details.get("dtype") is not None:
        facts.append(("type", str(details["dtype"])))
    if details.get("bytes") is not None:
        facts.append(("size", f"{human_size(details['bytes'])} ({details['bytes']} bytes)"))
    last = _last_state(details)
    if details.get(last) is not None:
        lost = (details.get("holes") or 0) - (details.get("non_finite") or 0)
        words = "yes, bit for bit" + (" wherever there is a value" if lost else "")
        if last == "complete":
            words = "the remeshed surface bit for bit, which is not the mesh that it was made of"
        facts.append((last, words if details[last] else "no, within the error that was asked for"))
    if errors := _ERRORS.get(str(details.get("errors"))):
        facts.append(("errors", errors))
    if details.get("values_sha256"):
        facts.append(("values sha256", str(details["values_sha256"])))
    return facts + [(str(name), _short(value)) for name, value in metadata.items()]


def _grids(blocks: list[Mapping[str, Any]]) -> list[tuple[str, str]]:
    if len(blocks) > 1:
        kinds = Counter(map(_block, blocks))
        return [("blocks", f"{f'{len(blocks)}: ' if len(kinds) > 1 else ''}{_counted(kinds)}")]
    closed = [name for name, wraps in zip(("rows", "columns"), blocks[0]["closed"], strict=True) if wraps]
    return [("shape", _size(blocks[0]["shape"])), ("closed", " and ".join(closed) or "no")]


def _block(block: Mapping[str, Any]) -> str:
    closed = [name for name, wraps in zip(("rows", "columns"), block["closed"], strict=True) if wraps]
    return _size(block["shape"]) + (f" ({' and '.join(closed)} closed)" if closed else "")


def _counted(kinds: Counter[str]) -> str:
    counts = kinds.most_common()
    named = ", ".join(f"{count} of {word}" if count > 1 else word for word, count in counts[:_MOST_KINDS])
    return named if len(counts) <= _MOST_KINDS else f"{named}, and others of {len(counts) - _MOST_KINDS} sizes"


def _size(shape: Iterable[int]) -> str:
    return " x ".join(map(str, shape))


def _short(value: object) -> str:
    text = " ".join(str(value).split())
    return text if len(text) <= 80 else text[:77] + "..."


def _states(
    kind: str, states: list[Mapping[str, Any]], channels: Sequence[str], fancy: bool, exact: int | None, last: str
) -> Any:
    """Return a table of levels or layers; `exact`, the bytes of all, is shown in a last row named `last`."""
    from rich import box
    from rich.table import Table

    table = Table(box=box.SIMPLE_HEAD if fancy else None, pad_edge=False)
    # Of several blocks a level has no one grid.
    grids = ["grid"] if kind == "levels" and all(state.get("shape") for state in states) else []
    first = ["level", *grids] if kind == "levels" else ["layer", "level"]
    shown = list(channels[:_MOST_CHANNELS]) if any(state.get("channels") for state in states) else []
    for name in (*first, "bytes", "RMS error", "maximum", *shown):
        table.add_column(cell(name), justify="right")
    for number, state in enumerate(states):
        place = [_size(state["shape"])] if grids else [str(state["level"])] if kind == "layers" else []
        figures = (f"{state['bytes']:,}", _figure(state.get("rms")), _figure(state.get("max")))
        channel_figures = [_figure(rms) for rms, _ in state.get("channels", [])][: len(shown)]
        table.add_row(*map(cell, (number, *place, *figures, *channel_figures)))
    if exact is not None:
        table.add_row(*map(cell, (last, states[-1]["level"], f"{exact:,}", "0", "0", *("0" for _ in shown))))
    return table


def _figure(value: float | None) -> str:
    return "-" if value is None else f"{value:.6g}"
