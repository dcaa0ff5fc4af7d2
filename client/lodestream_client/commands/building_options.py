"""Options of a build that may be larger than memory: how much of it to take, where files go, who works."""

from __future__ import annotations

import argparse
import tempfile
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
    "work_folder",
]


@dataclass(frozen=True)
class BuildingOptions:
    """What the command line says of a build.

    Attributes
    ----------
    memory : int or None
        Bytes to work in; None: a quarter of the machine's.
    scratch : Path or None
        The folder for its files; None: one beside the container.
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
        help="folder for the files of a build by bands, about 12 bytes a value (up to 30 of several blocks), "
        "empty or of an interrupted build; "
        "after an interruption it stays, and the same command continues from there (default: OUT.lode.build, which is "
        "removed after an interruption too)",
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
    """The options that `add_building_options` adds."""
    return BuildingOptions(args.memory, args.scratch, args.dask)


@contextmanager
def work_folder(options: BuildingOptions, out: str) -> Iterator[Path]:
    """A folder for the files of a build, of this process alone.

    What was made there is gone afterwards, but for that of a named folder whose build was cut; what a killed process
    has left beside the container is found again.

    Raises
    ------
    InputError
        If the folder holds anything else, or another build is at work there.
    """
    from lodestream.bands.cluster import is_loss
    from lodestream.bands.folders import build_folder
    from lodestream.errors import UnavailableError

    if options.scratch is None and out == "-":
        with tempfile.TemporaryDirectory(prefix="lodestream-", ignore_cleanup_errors=True) as folder:
            yield Path(folder)
        return
    named = options.scratch is not None
    with build_folder(options.scratch or Path(f"{out}.build"), ("files", "build"), named) as own:
        try:
            yield own
        except BaseException as error:
            cut = isinstance(error, KeyboardInterrupt | OSError | UnavailableError) or is_loss(error)
            if named and cut:
                note(f"{options.scratch} is kept: the same command continues from there")
            raise
