"""Options that decide how files become a surface."""

from __future__ import annotations

import argparse
from collections.abc import Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING

from lodestream.errors import OptionError
from lodestream.quality import EFFORTS, Quality

from .values import parse_pair, parse_precision, parse_tolerance

if TYPE_CHECKING:
    from ..requests.memory import Closure

__all__ = [
    "SurfaceOptions",
    "add_reading_options",
    "add_surface_options",
    "quality_of",
    "reading_options",
    "surface_options",
]


@dataclass(frozen=True)
class SurfaceOptions:
    """Options from the command line that decide how files become a surface.

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
    nodata : str or None
        The value that marks holes.
    crs : str or None
        The code of a CRS, in place of what the file says.
    """

    quality: Quality
    closed: Closure
    name: str | None
    format_options: Mapping[str, str]
    format_name: str | None = None
    nodata: str | None = None
    crs: str | None = None


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
        help="maximum error of the complete surface: a number in the surface's unit, or 0.1%% of its "
        "extent; NAME=P sets it for an attribute, a coordinate (z) or a component (wind_0); may be repeated "
        "(default: lossless)",
    )
    group.add_argument(
        "--rms",
        type=parse_tolerance,
        metavar="R",
        help="encode for one root mean square error: a container as small as possible whose complete surface has an "
        "error of at most R, a number in the surface's unit, or 0.1%% of its extent; cannot be combined "
        "with a --precision of the points",
    )
    group.add_argument(
        "--effort",
        choices=EFFORTS,
        default="default",
        help="fast: half the time; small: fewer bytes, of which a window then takes more; both in few layers "
        "(default: default)",
    )
    add_remeshing_options(group)
    add_reading_options(group)


def add_remeshing_options(group: argparse._ArgumentGroup) -> None:
    """Add the options that decide whether and how a triangle mesh that is no grid is resampled."""
    group.add_argument(
        "--remesh",
        action="store_true",
        help="resample a mesh of triangles that is no grid into watertight blocks; the distance to it is measured both "
        "ways. A mesh that is a grid stays as it is (needs lodestream[remesh])",
    )
    group.add_argument(
        "--blocks",
        type=int,
        metavar="N",
        help="with --remesh: about how many blocks (default: 100, fewer for small meshes)",
    )
    group.add_argument(
        "--remesh-error",
        type=float,
        metavar="E",
        help="with --remesh: root mean square distance to the mesh that is aimed at, in parts of the diagonal of its "
        "bounding box (default: 2e-4)",
    )


def add_reading_options(group: argparse._ArgumentGroup) -> None:
    """Add the options that decide how a file is read, whatever becomes of it."""
    group.add_argument(
        "--closed",
        choices=("auto", "none", "rows", "cols", "both"),
        default="auto",
        help="closed axes of the grid; rows: the last row is connected to the first, as on a cylinder (default: auto, "
        "the file decides)",
    )
    group.add_argument(
        "--nodata",
        metavar="VALUE",
        help="value that marks holes though the file does not say so: a number, such as -9999, or nan; of points with "
        "coordinates those that have it in all, such as the 0 0 0 of a depth camera, or else in z; a note says how "
        "many",
    )
    group.add_argument(
        "--crs",
        metavar="EPSG:N",
        help="CRS of the coordinates, in place of what the file says, which may be nothing: a code such as EPSG:32611, "
        "or EPSG:32611+5773 with a vertical CRS (needs lodestream[maps]); push then encodes here",
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


def surface_options(args: argparse.Namespace) -> SurfaceOptions:
    """Return the options that `add_surface_options` has added.

    Ends the program if they are wrong, for example if a key is given twice.
    """
    return reading_options(args, quality_of(args))


def reading_options(args: argparse.Namespace, quality: Quality) -> SurfaceOptions:
    """Return the options that `add_reading_options` has added, and a quality.

    End the program if a key is given twice.

    Names of attributes add up.
    """
    options: dict[str, str] = {} if args.nodata is None else {"nodata": args.nodata}
    for key, value in args.options:
        if key in options and key != "attributes":
            args.parser.error(f"argument -o: {key} given twice")
        options[key] = f"{options[key]},{value}" if key in options else value
    for key, value in _remeshing(args).items():
        if options.setdefault(key, value) != value:
            args.parser.error(f"argument -o: {key} given twice")
    # Every format has this one, and the query of an upload has it among the options of the format.
    nodata = options.pop("nodata", None)
    return SurfaceOptions(quality, args.closed, args.name, options, args.format_name, nodata, args.crs)


def _remeshing(args: argparse.Namespace) -> dict[str, str]:
    """Return the options of formats that correspond to ``--remesh`` and its options."""
    if not getattr(args, "remesh", False):
        for name in ("blocks", "remesh_error"):
            if getattr(args, name, None) is not None:
                args.parser.error(f"argument --{name.replace('_', '-')}: expected --remesh with it")
        return {}
    given = {"blocks": args.blocks, "remesh_error": args.remesh_error}
    return {"remesh": "yes"} | {key: str(value) for key, value in given.items() if value is not None}


def quality_of(args: argparse.Namespace) -> Quality:
    """Return the quality of ``--precision``, ``--rms`` and ``--effort``.

    Ends the program if a precision is given twice, or one of the points together with ``--rms``.
    """
    try:
        return Quality.parse(args.precisions, None if args.rms is None else str(args.rms), args.effort)
    except OptionError as error:
        args.parser.error(f"argument --precision: {error}")
        raise  # not reached: the parser has ended the program
