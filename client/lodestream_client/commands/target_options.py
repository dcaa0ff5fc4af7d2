"""Options that decide what to decode, where to stop, and in which order."""

from __future__ import annotations

import argparse

from lodestream.errors import OptionError
from lodestream.target import Target

from .values import parse_level, parse_names, parse_positive_seconds, parse_region, parse_size, parse_tolerance

__all__ = ["add_target_options", "target_of"]


def add_target_options(parser: argparse.ArgumentParser) -> None:
    """Add the options that decide what to decode, where to stop, and in which order."""
    group = parser.add_argument_group(
        "target",
        "What to decode and where to stop. The first limit that is met ends it. E is a number in the surface's unit, "
        "or 1e-3d for 1e-3 times its extent.",
    )
    group.add_argument("--level", type=parse_level, metavar="K", help="levels 0 to K only; OUT is the grid of level K")
    group.add_argument(
        "--until-rms", type=parse_tolerance, metavar="E", help="stop when the root mean square error is at most E"
    )
    group.add_argument(
        "--until-max", type=parse_tolerance, metavar="E", help="stop when the maximum error is at most E"
    )
    group.add_argument(
        "--max-bytes", type=parse_size, metavar="N", help="stop at the last layer that ends within N bytes"
    )
    group.add_argument("--seconds", type=parse_positive_seconds, metavar="S", help="stop after S seconds")
    group.add_argument(
        "--roi",
        type=parse_region,
        metavar="R0:R1,C0:C1",
        help="this window only: rows R0 to R1 - 1 and columns C0 to C1 - 1 of the full grid; OUT is the window",
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


def target_of(args: argparse.Namespace) -> Target:
    """The target of the command line; ends the program if its limits exclude each other."""
    try:
        target = Target(
            level=args.level,
            until_rms=args.until_rms,
            until_max=args.until_max,
            max_bytes=args.max_bytes,
            seconds=args.seconds,
            order=args.order,
            region=args.roi,
            attributes=args.attributes,
        )
    except OptionError as error:
        args.parser.error(str(error))
    return target
