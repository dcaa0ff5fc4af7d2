"""Options of a build that may be larger than memory: its memory, its folders, and its workers."""

from __future__ import annotations

import argparse
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

from ..terminal.output import note
from .values import parse_memory, parse_scheduler

__all__ = [
    "BuildingOptions",
    "add_building_options",
    "add_memory_option",
    "building_options",
    "reading_folder",
]


@dataclass(frozen=True)
class BuildingOptions:
    """Options of a build from the command line.

    Attributes
    ----------
    memory : int or None
        Bytes to work in; None: a quarter of the machine's.
    scratch : Path or None
        The folder in which it can continue; None: a temporary one beside the container.
    dask : str or None
        Address of a Dask scheduler whose workers carry out the tasks.
    """

    memory: int | None
    scratch: Path | None
    dask: str | None


def add_building_options(parser: argparse.ArgumentParser) -> None:
    """Add the options of a build."""
    group = parser.add_argument_group("surfaces larger than memory")
    add_memory_option(group)
    group.add_argument(
        "--scratch",
        type=Path,
        metavar="FOLDER",
        help="folder in which a build by bands can continue, with about 12 bytes a value (up to 30 of several blocks): "
        "after an interruption, even a power failure, its files stay there, and the same command continues from there "
        "(default: a temporary folder beside OUT)",
    )
    group.add_argument(
        "--dask",
        type=parse_scheduler,
        metavar="ADDRESS",
        help="address of a Dask scheduler whose workers build, such as tcp://10.0.0.1:8786; they must see the same "
        "folders",
    )


def add_memory_option(group: argparse._ActionsContainer) -> None:
    """Add the option that bounds the memory."""
    group.add_argument(
        "--memory",
        type=parse_memory,
        metavar="SIZE",
        help="working memory, such as 512MiB: surfaces that need more are processed by bands of rows (default: a "
        "quarter of the machine's memory)",
    )


def building_options(args: argparse.Namespace) -> BuildingOptions:
    """Return the options that `add_building_options` has added."""
    return BuildingOptions(args.memory, args.scratch, args.dask)


@contextmanager
def reading_folder(options: BuildingOptions, out: str, key: str | None) -> Iterator[Path]:
    """Make a folder for the arrays that are read; note if an interrupted build can continue.

    Parameters
    ----------
    options : BuildingOptions
        If they name a scratch folder, it is there, else beside the container.
    out : str
        The container.
    key : str or None
        What decides about what is read, which is kept with it if the build is cut; None: it is gone in any case.

    Raises
    ------
    InputError
        If another process reads the same there.
    """
    from lodestream.encoding.cluster import is_loss
    from lodestream.encoding.folders import kept_folder, temporary_folder
    from lodestream.errors import UnavailableError

    above, name = (None, "") if out == "-" else (Path(out).parent, Path(out).name)
    if options.scratch is not None:
        options.scratch.mkdir(parents=True, exist_ok=True)
        above = options.scratch
    try:
        if options.scratch is None or key is None:
            reading = temporary_folder(above, name)
        else:
            reading = kept_folder(options.scratch, key)
        with reading as folder:
            yield folder
    except BaseException as error:
        cut = isinstance(error, KeyboardInterrupt | OSError | UnavailableError) or is_loss(error)
        if options.scratch is not None and cut:
            note(f"{options.scratch} is kept: the same command continues from there")
        raise
