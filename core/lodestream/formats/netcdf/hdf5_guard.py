"""What is checked of an HDF5 file before any library follows what stands in it.

HDF5 can point to other files (external links, external and virtual datasets), to itself in a circle, and through
filters to any amount of memory. NetCDF-4 needs nothing of that.
"""

from __future__ import annotations

import zlib
from collections.abc import Iterator
from typing import Any, BinaryIO

from ...errors import FormatError, TooLargeError
from ..source import number

__all__ = ["groups_of"]

_MOST_OBJECTS = 2_000
_HARMLESS_CHUNK = 64 << 20

#: Deflate expands at most so many times.
_EXPANSION = 1032

#: Chunks of a variable where HDF5 has no way to list them but one by one, each found by counting from the first.
_MOST_COUNTED = 4_000

_DEFLATE, _SHUFFLE, _FLETCHER = 1, 2, 3


def groups_of(file: BinaryIO) -> list[str]:
    """Check a file and find its groups with values, such as "forecast/surface".

    Refuse links out of the file and circles inside it, values outside it, and chunks that expand beyond their size.

    Raises
    ------
    FormatError, TooLargeError
    """
    import h5py

    groups: dict[str, None] = {}
    with h5py.File(file, "r") as opened:
        for dataset in _datasets(opened):
            _check_dataset(dataset)
            if dataset.ndim and (group := str(dataset.name).strip("/").rpartition("/")[0]):
                groups[group] = None
    return sorted(groups)


def _datasets(file: Any) -> Iterator[Any]:
    import h5py

    groups, seen = [file["/"]], {_address(file["/"])}
    while groups:
        group = groups.pop()
        for name in group:
            link = group.get(name, getlink=True)
            if not isinstance(link, h5py.HardLink):
                raise FormatError(f"expected a file without links to others, got one named {str(name)[:60]!r}")
            item = group[name]
            address = _address(item)
            if isinstance(item, h5py.Group) and address in seen:
                raise FormatError(f"expected groups without a circle, got one through {str(name)[:60]!r}")
            seen.add(address)
            if len(seen) > _MOST_OBJECTS:
                raise TooLargeError(f"expected at most {number(_MOST_OBJECTS)} variables, got more")
            if isinstance(item, h5py.Group):
                groups.append(item)
            elif isinstance(item, h5py.Dataset):
                yield item


def _address(item: Any) -> int:
    import h5py

    return int(h5py.h5o.get_info(item.id).addr)


def _check_dataset(dataset: Any) -> None:
    name = str(dataset.name)[:60]
    if dataset.external or dataset.is_virtual:
        raise FormatError(f"expected values inside the file, got {name!r} with values in others")
    properties = dataset.id.get_create_plist()
    filters = [properties.get_filter(place)[0] for place in range(properties.get_nfilters())]
    if not set(filters) <= {_DEFLATE, _SHUFFLE, _FLETCHER} or filters.count(_DEFLATE) > 1:
        raise FormatError(f"expected values stored as they are or deflated once, got {name!r} with filters {filters}")
    if dataset.chunks is None:
        return
    size = dataset.dtype.itemsize
    for length in dataset.chunks:
        size *= length
    if size > max(_HARMLESS_CHUNK, dataset.nbytes):
        raise TooLargeError(f"expected chunks no larger than the variable, got {number(size)} bytes in {name!r}")
    if _DEFLATE in filters:
        _check_chunks(dataset, size + 4)


def _large_chunks(dataset: Any) -> list[tuple[int, ...]]:
    """Return the offsets of the chunks that could expand to more than is harmless."""
    found: list[tuple[int, ...]] = []

    def keep(info: Any) -> None:
        if info.size * _EXPANSION > _HARMLESS_CHUNK:
            found.append(info.chunk_offset)

    if hasattr(dataset.id, "chunk_iter"):
        dataset.id.chunk_iter(keep)
        return found
    # HDF5 before 1.12.3 counts from the first chunk on to find each one.
    count = dataset.id.get_num_chunks()
    if count > _MOST_COUNTED:
        raise TooLargeError(
            f"expected at most {number(_MOST_COUNTED)} chunks in a variable, as this version of HDF5 is slow to list "
            f"them, got {number(count)} in {str(dataset.name)[:60]!r}"
        )
    for place in range(count):
        keep(dataset.id.get_chunk_info(place))
    return found


def _check_chunks(dataset: Any, size: int) -> None:
    """Expand the chunks that could be harmful, and no further than they may."""
    for offset in _large_chunks(dataset):
        mask, data = dataset.id.read_direct_chunk(offset)
        if mask:
            continue  # stored as it is
        expander = zlib.decompressobj()
        try:
            expanded = len(expander.decompress(data, size + 1))
        except zlib.error as error:
            raise FormatError(f"expected deflated values in {str(dataset.name)[:60]!r}, got others: {error}") from None
        if expanded > size:
            raise TooLargeError(
                f"expected chunks of {number(size)} bytes in {str(dataset.name)[:60]!r}, got one that expands further"
            )
