"""Options that decide what to decode, where to stop, and in which order."""

from __future__ import annotations

import argparse
from collections.abc import Sequence

from lodestream.errors import OptionError
from lodestream.target import Limits, Target, Tolerance

from .values import parse_level, parse_limit, parse_names, parse_positive_seconds, parse_region, parse_size

__all__ = ["add_target_options", "target_of"]


def add_target_options(parser: argparse.ArgumentParser) -> None:
    """Add the options that decide what to decode, where to stop, and in which order."""
    group = parser.add_argument_group(
        "target",
        "What to decode and where to stop. The first limit that is met ends it. E is a number in the surface's unit, "
        "or 0.1% of its extent. NAME=E is the error of an attribute, a coordinate (z) or a component "
        "(wind_0), a number in its own unit; it may be repeated, and all of them have to be met; it cannot be "
        "combined with --roi, since containers tell errors of windows for all channels together.",
    )
    group.add_argument("--level", type=parse_level, metavar="K", help="levels 0 to K only; OUT is the grid of level K")
    for option, error in (("--until-rms", "root mean square"), ("--until-max", "maximum")):
        group.add_argument(
            option,
            action="append",
            default=[],
            type=parse_limit,
            metavar="[NAME=]E",
            help=f"stop when the {error} error is at most E",
        )
    group.add_argument(
        "--max-bytes", type=parse_size, metavar="N", help="stop at the last layer that ends within N bytes"
    )
    group.add_argument("--seconds", type=parse_positive_seconds, metavar="S", help="stop after S seconds")
    group.add_argument(
        "--roi",
        type=parse_region,
        metavar="R0:R1,C0:C1",
        help="this window only: rows R0 to R1 - 1 and columns C0 to C1 - 1 of the full grid, across the seam of a "
        "closed axis too; OUT is the window, or with --level K the points of level K in it; E is the error in it",
    )
    group.add_argument(
        "--attributes",
        type=parse_names,
        metavar="NAMES",
        help="these attributes only: names separated by commas, or none (default: all)",
    )
    group.add_argument(
        "--order",
        choices=("quality", "level"),
        default="quality",
        help="quality: the data that reduce the error most come first; level: level by level (default: quality)",
    )


def _limits(given: Sequence[tuple[str | None, Tolerance]]) -> Limits | None:
    """Return the limits of an option that may be repeated: an error of the whole surface, or errors of channels."""
    limits = dict(given)
    if len(limits) < len(given):
        raise OptionError("expected each error once, got one given twice")
    whole = limits.pop(None, None)
    if whole is not None and limits:
        raise OptionError("expected either an error of the whole surface or errors of channels, got both")
    return whole or {name: limit for name, limit in limits.items() if name is not None}


def target_of(args: argparse.Namespace) -> Target:
    """Return the target of the command line; end the program if its limits exclude each other."""
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
