"""NetCDF classic, 64-bit offset and 4: one variable as heights, over the coordinates that the file has for it."""

from __future__ import annotations

import os
import re
import warnings
from collections.abc import Iterable, Iterator, Sequence
from contextlib import ExitStack, contextmanager
from typing import Any

from ...errors import Choice, ChoiceError, FormatError, InputError, OptionError, TooLargeError, UnavailableError
from ...surface import Surface
from ..member import Member
from ..notes import listing, warn
from ..source import MOST_CHOICES, Source, check_allowed
from . import hdf5_guard, vmec
from .mark import MARK
from .marked import surface_in
from .members import members_of

__all__ = [
    "KINDS",
    "READ_OPTIONS",
    "check_group",
    "group_of",
    "members",
    "of_group",
    "parents_of",
    "read",
    "sniff",
    "with_parents",
]

#: What is read by other rules than a NetCDF of heights.
KINDS = ("vmec",)

READ_OPTIONS = {
    "group": "group of the file, such as PRODUCT or forecast/surface (default: the file itself)",
    "variable": "name of the variable with the heights (default: the only one)",
    "x": "name of the variable of x (default: by the CF conventions)",
    "y": "name of the variable of y; with x but without variable, the surface is planar",
    "time": "index of a time, from 0, or the beginning of its date, such as 2001-02",
    "at": "indices along other dimensions, such as depth:0 or depth:3,member:1",
    "attributes": "names of variables of the same shape that become attributes, separated by commas",
    "resolution": "VMEC: number of points the short and the long way around, such as 64x256",
}

#: What h5py says where HDF5 has told it nothing, as happens where memory is short.
_UNSAID = re.compile(r"unspecified error|failed to walk error stack", re.IGNORECASE)

_CLASSIC = (b"CDF\x01", b"CDF\x02")
_CDF5 = b"CDF\x05"
_HDF5 = b"\x89HDF\r\n\x1a\n"


def sniff(head: bytes, suffix: str) -> bool:
    """Return whether a file begins like NetCDF, or like HDF5 and is not named .cgns."""
    return head.startswith((*_CLASSIC, _CDF5)) or (head.startswith(_HDF5) and suffix != ".cgns")


def read(source: Source) -> Surface:
    """Read one variable, its coordinates, and those that options make attributes.

    Raises
    ------
    OptionError
        If the option ``resolution`` is given for a file that is not one of VMEC.
    """
    with _opened(source) as (dataset, groups):
        if vmec.is_vmec(dataset) and not {"variable", "x", "y"} & set(source.options):
            check_allowed(("vmec",), source.allowed)
            return vmec.read(source, dataset)
        check_allowed(("netcdf",), source.allowed)
        if "resolution" in source.options:
            raise OptionError("expected resolution= for a VMEC file only, got another NetCDF")
        surface, notes = of_group(source, dataset, groups, "netcdf", deflated=True)
    for text in notes:  # said here, for the libraries' own warnings are not shown while the file is open
        warn(text)
    return surface


def members(source: Source, along: str) -> list[Member]:
    """List the surfaces of a file along a dimension, or its variables; see `lodestream.formats.series.members`."""
    with _opened(source) as (dataset, _):
        return members_of(source, dataset, along)


def of_group(
    source: Source, dataset: Any, groups: Sequence[str], format_name: str, *, deflated: bool = False
) -> tuple[Surface, list[str]]:
    """Make a surface of the opened group of a file or store; groups are named where it is none, or beside it.

    Of what may be deflated, values that the file is too small for are refused.

    Raises
    ------
    FormatError
        If it holds no surface, or several; as `ChoiceError` if there are others, or groups.
    OptionError, TooLargeError
        If an option does not fit, or it is too large.
    """
    chosen = group_of(source)
    inner = [group for group in groups if group != chosen]
    try:
        surface, notes = surface_in(source, dataset, format_name, deflated=deflated)
    except FormatError as error:
        if not inner:
            raise
        choices = [*getattr(error, "choices", ()), *(Choice({"group": group}) for group in inner[:MOST_CHOICES])]
        raise ChoiceError(f"{error}; there are groups: {listing(inner)}, choose with group=", choices) from None
    return surface, [*notes, *([f"left out groups: {listing(inner)}"] if inner else [])]


def group_of(source: Source) -> str:
    """Return the group that options choose, without slashes around it; empty: the file or store itself."""
    return str(source.options.get("group", "")).strip("/")


def check_group(group: str, groups: Sequence[str]) -> None:
    """Refuse a group that is not there.

    Raises
    ------
    OptionError
        With those that are.
    """
    if group and group not in groups:
        raise OptionError(f"expected group= as one of {listing(groups) or 'none'}, got {group[:80]!r}")


def parents_of(group: str) -> list[str]:
    """Return paths of the groups around a group, the nearest first, and empty for the file or store itself."""
    parts = group.split("/") if group else []
    return ["/".join(parts[:count]) for count in range(len(parts) - 1, -1, -1)]


def with_parents(dataset: Any, parents: Iterable[Any]) -> Any:
    """Add to a group what it may refer to in the groups around it: variables over dimensions that it has.

    Their attributes are its own too, but for those that it has otherwise.

    Parameters
    ----------
    dataset : Dataset of xarray
    parents : iterable of Dataset
        The nearest first.
    """
    for parent in parents:
        near = {
            name: variable
            for name, variable in parent.variables.items()
            if name not in dataset.variables
            and variable.ndim < 2
            and all(dataset.sizes.get(dim) == parent.sizes[dim] for dim in variable.dims)
        }
        dataset = dataset.assign_coords(near) if near else dataset
        if parent.attrs:
            dataset = dataset.assign_attrs({key: it for key, it in parent.attrs.items() if key != MARK} | dataset.attrs)
    return dataset


@contextmanager
def _opened(source: Source) -> Iterator[tuple[Any, list[str]]]:
    """The group of a file as an xarray Dataset, with values as they are stored, and all groups of the file.

    Nothing but its header is in memory. HDF5 reads through a file of Python, which others may have open in any way.
    """
    with source.path.open("rb") as file, ExitStack() as stack:
        head = file.read(8)
        if head.startswith(_CDF5):
            raise FormatError("expected NetCDF classic, 64-bit offset or 4, got CDF-5 (64-bit data), which is not read")
        check_libraries()
        import xarray

        hdf5, group = head == _HDF5, group_of(source)
        path = os.path.realpath(source.path)  # absolute, so that no library takes it for an address
        options: dict[str, Any] = {"decode_cf": False, "create_default_indexes": False, "cache": False}
        try:
            with warnings.catch_warnings():
                warnings.simplefilter("ignore")
                groups = hdf5_guard.groups_of(file) if hdf5 else []
                check_group(group, groups)

                def opened(name: str) -> Any:
                    if not hdf5:
                        return stack.enter_context(xarray.open_dataset(path, engine="scipy", **options))
                    said = {"engine": "h5netcdf", "phony_dims": "access", "group": name or None, **options}
                    return stack.enter_context(xarray.open_dataset(file, **said))

                yield with_parents(opened(group), map(opened, parents_of(group))), groups
        except (InputError, UnavailableError):
            raise
        except MemoryError:
            raise TooLargeError("expected a NetCDF that fits into memory, got one that promises more") from None
        except Exception as error:  # none of these libraries says what it may raise
            reason = " ".join(str(error).replace(path, "the file").split())
            if not reason or isinstance(error, SystemError) or _UNSAID.search(reason):
                raise UnavailableError(
                    f"expected the libraries of NetCDF to read the file or to say why not, got {type(error).__name__}: "
                    "they may have had too little memory"
                ) from None
            raise FormatError(f"expected a whole NetCDF, got one that is not readable: {reason[:120]}") from None


def check_libraries() -> None:
    """Import what reads NetCDF.

    Raises
    ------
    UnavailableError
        If something is not installed.
    """
    try:
        import cf_xarray  # noqa: F401 - for a better message than xarray's
        import h5netcdf  # noqa: F401
        import scipy  # noqa: F401
        import xarray  # noqa: F401
    except ImportError:
        raise UnavailableError(
            "expected xarray, cf-xarray, h5netcdf, h5py, pyproj and scipy for NetCDF, which are not all installed: "
            "pip install 'lodestream[formats]'"
        ) from None
