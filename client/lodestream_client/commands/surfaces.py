"""``lodestream list`` and ``lodestream rm``: the surfaces and names of a server."""

from __future__ import annotations

import argparse
from collections.abc import Callable, Mapping, Sequence
from typing import TYPE_CHECKING, Any

from lodestream.series import place_of

from ..requests.states import STATES
from ..terminal.output import human_size, note, print_json, say_columns
from .arguments import Subparsers, add_command, add_json_option, add_token_option, token_of
from .values import parse_served, parse_server

if TYPE_CHECKING:
    from ..requests.api import Description

__all__ = ["register", "run_list", "run_rm"]


def register(subparsers: Subparsers) -> None:
    """Add the sub-commands."""
    parser = add_command(
        subparsers,
        "list",
        run_list,
        "list the surfaces of a server, or its names",
        "One line for each: URL, state, shape, size of the container (of the upload, before there is one), name,\n"
        "series (where there are any: its name, and the number of the step or variable), owner (where the server\n"
        "tells owners; - if it has none), and why it is not ready. Surfaces of a series stand together, by their\n"
        "numbers, unless --sort is given. With --names: one line for each name that stays.",
    )
    parser.add_argument("url", type=parse_server, metavar="URL", help="URL of the server")
    parser.add_argument(
        "--search",
        metavar="TEXT",
        help="only those with this text in their name, series, owner, URL or reason, in upper or lower case; of names "
        "in the name, owner or URL of the surface",
    )
    parser.add_argument(
        "--names",
        action="store_true",
        help="list the names that lead to surfaces instead: URL of the name, URL of the surface (- if the server "
        "cannot read the name), when that was changed, owner (where the server tells owners)",
    )
    parser.add_argument("--state", choices=STATES, help="only those in this state")
    parser.add_argument("--sort", choices=tuple(_KEYS), help="order of the lines (default: the server's)")
    parser.add_argument("--reverse", action="store_true", help="the other way round")
    add_token_option(parser)
    add_json_option(parser)
    parser = add_command(subparsers, "rm", run_rm, "delete a surface from a server, or a name that leads to one")
    parser.add_argument(
        "url",
        type=parse_served,
        metavar="URL",
        help="URL of the surface; or of the name, which leads to none then: no surface is deleted",
    )
    add_token_option(parser)
    add_json_option(parser)


def run_list(args: argparse.Namespace) -> int:
    """Print one line for each surface: address, state, shape, bytes, name, series, owner, and why it is not ready."""
    from ..client import Client

    if args.names:
        return _run_names(args)
    with Client(args.url, token=token_of(args)) as client:
        surfaces = _chosen(client.list(), args)
    if args.json:
        print_json({"surfaces": [{**surface.details, "url": surface.url} for surface in surfaces]})
        return 0

    if surfaces:
        # Where the server tells no owners there is no column of them.
        owned = any(surface.details.get("owner") for surface in surfaces)
        say_columns([_row(surface, owned) for surface in surfaces])
    else:
        note("no such surfaces" if args.search or args.state else "no surfaces")
    return 0


def _run_names(args: argparse.Namespace) -> int:
    from ..client import Client

    if args.state or args.sort or args.reverse:
        args.parser.error("argument --names: not allowed with --state, --sort or --reverse")
    text = (args.search or "").casefold()
    with Client(args.url, token=token_of(args)) as client:
        listed = client.list_names()
    names = [
        name
        for name in listed
        if any(text in str(name.get(key) or "").casefold() for key in ("name", "surface", "owner"))
    ]
    if args.json:
        print_json({"names": names})
    elif names:
        say_columns([tuple(str(name.get(key) or empty) for key, empty in _NAME_COLUMNS) for name in names])
    else:
        note("no such names" if text else "no names")
    return 0


#: What is told of a name, and what stands for nothing.
_NAME_COLUMNS = (("url", ""), ("surface", "-"), ("changed", "-"), ("owner", ""))


def _row(surface: Description, owned: bool) -> tuple[str, ...]:
    details = surface.details
    shape = " x ".join(map(str, details.get("shape") or ())) or ("blocks" if "shape" in details else "-")
    size = human_size(_size(surface)) if _size(surface) is not None else "-"
    owner = str(details.get("owner") or "-") if owned else ""
    reason = str(details.get("reason") or "")
    return surface.url, surface.state, shape, size, _name(surface), _series(surface), owner, reason


def _name(surface: Description) -> str:
    return str(surface.details.get("name") or "")


def _size(surface: Description) -> Any:
    """Return the bytes of the container, or of the upload while there is none; None if the server tells neither."""
    details = surface.details
    return details["bytes"] if details.get("bytes") is not None else details.get("upload_bytes")


#: What the surfaces are sorted by; where two are equal the server's order stays.
_KEYS: Mapping[str, Callable[[Description], Any]] = {
    "name": lambda surface: _name(surface).casefold(),
    "size": lambda surface: _size(surface) or 0,
    "owner": lambda surface: str(surface.details.get("owner") or "").casefold(),
    "state": lambda surface: surface.state,
    "created": lambda surface: str(surface.details.get("created") or ""),
}


def _chosen(surfaces: Sequence[Description], args: argparse.Namespace) -> list[Description]:
    """Return the surfaces that match the options, in the order of the options."""
    text = (args.search or "").casefold()
    chosen = [
        surface
        for surface in surfaces
        if (args.state is None or surface.state == args.state)
        and any(text in word.casefold() for word in _words(surface))
    ]
    if args.sort:
        chosen.sort(key=_KEYS[args.sort])
    else:
        chosen = _together(chosen)
    return chosen[::-1] if args.reverse else chosen


def _together(surfaces: Sequence[Description]) -> list[Description]:
    """Return the surfaces with those of a series together, by index, at the place of the first of them."""
    first: dict[str, int] = {}
    places: list[tuple[int, int]] = []
    for number, surface in enumerate(surfaces):
        place = place_of(surface.details)
        places.append((number, 0) if place is None else (first.setdefault(place.name, number), place.index))
    return [surfaces[number] for number in sorted(range(len(surfaces)), key=places.__getitem__)]


def _series(surface: Description) -> str:
    """Return the series of a surface and its index as text; empty if it is in none."""
    place = place_of(surface.details)
    return "" if place is None else f"{place.name}, {place.along} {place.index}"


def _words(surface: Description) -> list[str]:
    details = surface.details
    return [
        surface.url,
        _name(surface),
        _series(surface),
        *(str(details.get(key) or "") for key in ("owner", "reason")),
    ]


def run_rm(args: argparse.Namespace) -> int:
    """Delete a surface, or a name."""
    from ..client import Client

    with Client(args.url, token=token_of(args)) as client:
        client.delete(args.url)
    if args.json:
        print_json({"removed": args.url})
    else:
        note(f"removed {args.url}")
    return 0
