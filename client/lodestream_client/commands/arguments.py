"""Options that several sub-commands share, and the types of their values."""

from __future__ import annotations

import argparse
import math
import os
import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, TypeVar

from lodestream.errors import OptionError
from lodestream.quality import Quality
from lodestream.target import Limits, Region, Target, Tolerance

from ..requests import addresses

if TYPE_CHECKING:
    from ..requests.memory import Closure

    Subparsers = argparse._SubParsersAction[argparse.ArgumentParser]
else:
    Subparsers = Any

__all__ = [
    "Subparsers",
    "SurfaceOptions",
    "add_command",
    "add_json_option",
    "add_rate_option",
    "add_reading_options",
    "add_size_option",
    "add_surface_options",
    "add_target_options",
    "add_token_option",
    "parse_pair",
    "parse_pictures",
    "parse_port",
    "parse_precision",
    "parse_rate",
    "parse_seconds",
    "parse_server",
    "parse_size",
    "parse_source",
    "parse_surface",
    "parse_tolerance",
    "quality_of",
    "reading_options",
    "standard_input_once",
    "standard_output_once",
    "surface_options",
    "target_of",
    "token_of",
]

T = TypeVar("T")

_AMOUNT = re.compile(r"\s*([0-9]*\.?[0-9]+(?:[eE][+-]?[0-9]+)?)\s*([a-zA-Z]*)(/s)?\s*")
_PREFIXES = {"": 1, "k": 10**3, "m": 10**6, "g": 10**9, "ki": 2**10, "mi": 2**20, "gi": 2**30}


def parse_size(text: str) -> int:
    """Read a number of bytes, such as ``20000``, ``20kB`` or ``1MiB``.

    Raises
    ------
    ArgumentTypeError
        If it is something else.
    """
    number, unit = _amount(text)
    factor = _PREFIXES.get(unit.lower().removesuffix("b"))
    if factor is None:
        raise argparse.ArgumentTypeError(f"expected a number of bytes such as 20000, 20kB or 1MiB, got {text!r}")
    size = round(number * factor)
    if size < 1:
        raise argparse.ArgumentTypeError(f"expected at least one byte, got {text!r}")
    return size


def parse_rate(text: str) -> float:
    """Read a rate such as ``64kbit``, ``1mbit/s`` or ``200kB``; bytes per second.

    Raises
    ------
    ArgumentTypeError
        If it is something else.
    """
    number, unit = _amount(text)
    bits = unit.lower().endswith("bit")
    prefix = unit.lower().removesuffix("bit") if bits else unit.removesuffix("B").lower()
    if not (bits or unit.endswith("B")) or prefix not in _PREFIXES or not number > 0:
        raise argparse.ArgumentTypeError(f"expected a rate such as 64kbit, 1mbit or 200kB (per second), got {text!r}")
    return number * _PREFIXES[prefix] / (8 if bits else 1)


def _amount(text: str) -> tuple[float, str]:
    match = _AMOUNT.fullmatch(text)
    if match is None or not math.isfinite(float(match[1])):
        return 0.0, "?"
    return float(match[1]), match[2]


def parse_pair(text: str) -> tuple[str, str]:
    """Read ``KEY=VALUE``.

    Raises
    ------
    ArgumentTypeError
        If it is something else.
    """
    key, equals, value = text.partition("=")
    if not key or not equals:
        raise argparse.ArgumentTypeError(f"expected KEY=VALUE, got {text!r}")
    return key, value


def parse_seconds(text: str) -> float:
    """Read a number of seconds, 0 or more.

    Raises
    ------
    ArgumentTypeError
        If it is something else.
    """
    try:
        value = float(text)
    except ValueError:
        value = math.nan
    if not 0 <= value < math.inf:
        raise argparse.ArgumentTypeError(f"expected a number of seconds, got {text!r}")
    return value


def _seconds(text: str) -> float:
    try:
        value = float(text)
    except ValueError:
        value = math.nan
    if not 0 < value < math.inf:
        raise argparse.ArgumentTypeError(f"expected a positive number of seconds, got {text!r}")
    return value


def _level(text: str) -> int:
    if not text.isdecimal():
        raise argparse.ArgumentTypeError(f"expected a level of 0 or more, got {text!r}")
    return int(text)


def _count(text: str) -> int:
    if not re.fullmatch("[0-9]{1,18}", text) or int(text) < 1:
        raise argparse.ArgumentTypeError(f"expected a number of 1 or more, got {text!r}")
    return int(text)


def parse_port(text: str) -> int:
    """Read a port of TCP; 0 for any free one."""
    if not text.isascii() or not text.isdigit() or int(text) > 65535:
        raise argparse.ArgumentTypeError(f"expected a port of 0 to 65535, got {text!r}")
    return int(text)


def parse_pictures(text: str) -> tuple[tuple[str, int | None], ...]:
    """Read a list such as ``1kB,20kB,all``: each size as it was written, and in bytes (None: all)."""
    words = [word.strip() for word in text.split(",")]
    return tuple((word, None if word == "all" else parse_size(word)) for word in words)


def _checked(parse: Callable[[str], T]) -> Callable[[str], T]:
    # argparse hides the message of any other exception behind "invalid value".
    def checked(text: str) -> T:
        try:
            return parse(text)
        except OptionError as error:
            raise argparse.ArgumentTypeError(str(error)) from None

    return checked


def _precision(text: str) -> str:
    if "" in Quality.parse([text]).attributes:
        raise OptionError(f"expected P or NAME=P, got {text!r}")
    return text


parse_tolerance = _checked(Tolerance.parse)
parse_precision = _checked(_precision)
parse_server = _checked(addresses.surfaces_url)
parse_surface = _checked(addresses.surface_url)
parse_source = _checked(addresses.source_url)


def add_command(
    subparsers: Subparsers, name: str, run: Callable[[argparse.Namespace], int], summary: str, details: str = ""
) -> argparse.ArgumentParser:
    """Add the sub-command `name` and return its parser."""
    parser = subparsers.add_parser(
        name,
        help=summary,
        description=f"{summary[0].upper()}{summary[1:]}.\n\n{details}".strip(),
        formatter_class=argparse.RawDescriptionHelpFormatter,
        allow_abbrev=False,
    )
    parser.set_defaults(run=run, parser=parser)
    return parser


def add_json_option(parser: argparse.ArgumentParser) -> None:
    """Add ``--json``."""
    parser.add_argument("--json", action="store_true", help="print one JSON object on standard output")


def add_token_option(parser: argparse.ArgumentParser) -> None:
    """Add ``--token``."""
    parser.add_argument(
        "--token", metavar="T", help="token for the server (default: the environment variable LODESTREAM_TOKEN)"
    )


def token_of(args: argparse.Namespace) -> str | None:
    """The token given, or the environment's."""
    token: str | None = args.token or os.environ.get("LODESTREAM_TOKEN")
    return token or None


def standard_input_once(args: argparse.Namespace, names: Sequence[str]) -> tuple[str, ...]:
    """The names of files to read; ends the program if standard input (``-``) is named twice."""
    if names.count("-") > 1:
        args.parser.error("standard input (-) is named twice")
    return tuple(names)


def standard_output_once(args: argparse.Namespace, what: str) -> None:
    """End the program if standard output is to be both OUT, which is `what`, and the JSON object."""
    if args.out == "-" and args.json:
        args.parser.error(f"argument --json: standard output is used for the {what}")


def add_rate_option(parser: argparse.ArgumentParser) -> None:
    """Add ``--limit-rate``."""
    parser.add_argument(
        "--limit-rate",
        type=parse_rate,
        metavar="RATE",
        help="receive at most this much a second, for example 1mbit or 200kB",
    )


def add_size_option(parser: argparse.ArgumentParser, *, decodes: bool = True) -> None:
    """Add ``--max-vertices``; if nothing is decoded, only the container's tables count."""
    what = (
        "refuse a surface that has more than N vertices or needs more than about 128 N bytes of memory, before that "
        "memory is allocated"
        if decodes
        else "refuse a container whose tables need more than about 128 N bytes of memory, before they are read"
    )
    parser.add_argument(
        "--max-vertices",
        type=_count,
        metavar="N",
        help=f"{what} (default: what fits into two fifths of the memory)",
    )


def add_surface_options(parser: argparse.ArgumentParser) -> None:
    """Add the options that decide how a file becomes a surface."""
    group = parser.add_argument_group("surface options")
    group.add_argument(
        "--precision",
        dest="precisions",
        action="append",
        default=[],
        type=parse_precision,
        metavar="[NAME=]P",
        help="maximum error of the complete surface: a number in the surface's unit, or 1e-3d for 1e-3 times its "
        "extent; NAME=P sets it for an attribute, a coordinate (z) or a component (wind_0); may be repeated "
        "(default: lossless)",
    )
    group.add_argument(
        "--rms",
        type=parse_tolerance,
        metavar="R",
        help="encode for one root mean square error: a container as small as possible whose complete surface has an "
        "error of at most R, a number in the surface's unit, or 1e-3d for 1e-3 times its extent; cannot be combined "
        "with a --precision of the points",
    )
    add_reading_options(group)


def add_reading_options(group: argparse._ArgumentGroup) -> None:
    """Add the options that decide how a file is read, whatever becomes of it."""
    group.add_argument(
        "--closed",
        choices=("auto", "none", "rows", "cols", "both"),
        default="auto",
        help="closed axes of the grid; rows: the last row is connected to the first, as on a cylinder (default: auto, "
        "the file decides)",
    )
    group.add_argument("--name", metavar="N", help="name of the surface")
    group.add_argument(
        "--format",
        dest="format_name",
        metavar="F",
        help="format of the file, as its name would say it, such as hgt or geotiff; standard input needs it where the "
        "content does not tell (default: the content decides)",
    )
    group.add_argument(
        "-o",
        dest="options",
        action="append",
        default=[],
        type=parse_pair,
        metavar="KEY=VALUE",
        help="option of the file's format, see lodestream formats; may be repeated",
    )


@dataclass(frozen=True)
class SurfaceOptions:
    """How files become a surface, as the command line says.

    Attributes
    ----------
    quality : Quality
    closed : "auto", "none", "rows", "cols" or "both"
    name : str or None
        Name of the surface.
    format_options : mapping of str to str
        The ``-o`` options.
    format_name : str or None
        The format that the file must have.
    """

    quality: Quality
    closed: Closure
    name: str | None
    format_options: Mapping[str, str]
    format_name: str | None = None


def surface_options(args: argparse.Namespace) -> SurfaceOptions:
    """The options that `add_surface_options` adds.

    Ends the program if they are wrong, for example if a key is given twice.
    """
    return reading_options(args, quality_of(args))


def reading_options(args: argparse.Namespace, quality: Quality) -> SurfaceOptions:
    """The options that `add_reading_options` adds, with a quality; ends the program if a key is given twice."""
    return SurfaceOptions(quality, args.closed, args.name, _format_options(args), args.format_name)


def _format_options(args: argparse.Namespace) -> dict[str, str]:
    options: dict[str, str] = {}
    for key, value in args.options:
        if key in options:
            args.parser.error(f"argument -o: {key} given twice")
        options[key] = value
    return options


def quality_of(args: argparse.Namespace) -> Quality:
    """The quality that ``--precision`` and ``--rms`` ask for.

    Ends the program if a precision is given twice, or one of the points together with ``--rms``.
    """
    try:
        return Quality.parse(args.precisions, None if args.rms is None else str(args.rms))
    except OptionError as error:
        args.parser.error(f"argument --precision: {error}")
        raise  # not reached: the parser has ended the program


def _region(text: str) -> Region:
    found = re.fullmatch(r"(\d+):(\d+),(\d+):(\d+)", text.replace(" ", ""))
    if found is None:
        raise argparse.ArgumentTypeError(f"expected rows and columns such as 0:100,200:300, got {text!r}")
    top, bottom, left, right = map(int, found.groups())
    return (top, bottom), (left, right)


def _names(text: str) -> tuple[str, ...]:
    return () if text == "none" else tuple(name.strip() for name in text.split(",") if name.strip())


def add_target_options(parser: argparse.ArgumentParser) -> None:
    """Add the options that decide what to decode, where to stop, and in which order."""
    group = parser.add_argument_group(
        "target",
        "What to decode and where to stop. The first limit that is met ends it. E is a number in the surface's unit, "
        "or 1e-3d for 1e-3 times its extent. NAME=E is the error of an attribute, a coordinate (z) or a component "
        "(wind_0), a number in its own unit; it may be repeated, and all of them have to be met.",
    )
    group.add_argument("--level", type=_level, metavar="K", help="levels 0 to K only; OUT is the grid of level K")
    for option, error in (("--until-rms", "root mean square"), ("--until-max", "maximum")):
        group.add_argument(
            option,
            action="append",
            default=[],
            type=_checked(_limit),
            metavar="[NAME=]E",
            help=f"stop when the {error} error is at most E",
        )
    group.add_argument(
        "--max-bytes", type=parse_size, metavar="N", help="stop at the last layer that ends within N bytes"
    )
    group.add_argument("--seconds", type=_seconds, metavar="S", help="stop after S seconds")
    group.add_argument(
        "--roi",
        type=_region,
        metavar="R0:R1,C0:C1",
        help="this window only: rows R0 to R1 - 1 and columns C0 to C1 - 1 of the full grid; OUT is the window",
    )
    group.add_argument(
        "--attributes",
        type=_names,
        metavar="NAMES",
        help="these attributes only: names separated by commas, or none (default: all)",
    )
    group.add_argument(
        "--order",
        choices=("quality", "level"),
        default="quality",
        help="quality: the data that reduce the error most come first; level: level by level (default: quality)",
    )


def _limit(text: str) -> tuple[str | None, Tolerance]:
    # A name may hold an equals sign, a number does not.
    name, equals, error = text.rpartition("=")
    if equals and not name:
        raise OptionError(f"expected E or NAME=E, got {text!r}")
    return name if equals else None, Tolerance.parse(error)


def _limits(given: Sequence[tuple[str | None, Tolerance]]) -> Limits | None:
    """What an option that may be repeated says: an error of the whole surface, or errors of channels."""
    found = dict(given)
    if len(found) < len(given):
        raise OptionError("expected each error once, got one given twice")
    whole = found.pop(None, None)
    if whole is not None and found:
        raise OptionError("expected either an error of the whole surface or errors of channels, got both")
    return whole or {name: limit for name, limit in found.items() if name is not None}


def target_of(args: argparse.Namespace) -> Target:
    """The target of the command line; ends the program if its limits exclude each other."""
    try:
        target = Target(
            level=args.level,
            until_rms=_limits(args.until_rms),
            until_max=_limits(args.until_max),
            max_bytes=args.max_bytes,
            seconds=args.seconds,
            order=args.order,
            region=args.roi,
            attributes=args.attributes,
        )
    except OptionError as error:
        args.parser.error(str(error))
    return target
