"""Zarr stores, versions 2 and 3 of the format: one variable as heights, by the rules of the reader of NetCDF."""

from __future__ import annotations

import json
import os
import stat
import warnings
from collections.abc import Iterable, Iterator, Mapping
from contextlib import ExitStack, contextmanager
from dataclasses import replace
from math import prod
from pathlib import Path
from typing import Any

from ...errors import FormatError, InputError, TooLargeError, UnavailableError
from ...sources import read_source
from ...surface import Surface
from ..member import Member
from ..notes import listing, warn
from ..source import Source, number, reworded
from .members import members_of
from .reader import check_group, group_of, of_group, parents_of, with_parents

__all__ = ["folder_size", "is_store", "members", "read"]

#: What a folder has that is a group or an array.
_HEADS = ("zarr.json", ".zgroup", ".zarray")

#: So many chunks may all be missing; of more there should be a byte each.
_HARMLESS_CHUNKS = 1 << 16

#: Groups that are looked through, each of which is a folder.
_MOST_GROUPS = 2_000

#: Codecs and filters of both versions that turn bytes into numbers and do nothing else: pickle runs what a file says.
_CODECS = frozenset(
    (
        *("bytes", "transpose", "sharding_indexed", "lodestream", "vlen-utf8", "vlen-bytes"),
        *("blosc", "bz2", "gzip", "lz4", "lzma", "pcodec", "zlib", "zstd", "zfpy"),
        *("astype", "bitround", "delta", "fixedscaleoffset", "packbits", "quantize", "shuffle"),
        *("adler32", "crc32", "crc32c", "fletcher32", "jenkins_lookup3"),
    )
)


def is_store(folder: Path) -> bool:
    """Return whether a folder is a store, or a group or an array in one."""
    return any((folder / name).is_file() for name in _HEADS)


def folder_size(folder: Path) -> int:
    """Return bytes of all files in a folder, but for those that vanish meanwhile."""
    paths = (os.path.join(above, name) for above, _, names in os.walk(folder) for name in names)
    return sum(os.lstat(path).st_size for path in paths if os.path.lexists(path))


def read(source: Source) -> Surface:
    """Read one variable of a group, its coordinates, and those that options make attributes; or the only array.

    An array with names of dimensions in a group is the variable of that group, so that its fill value, packing and
    coordinates count. Any other array is of shape (row, column) or (row, column, channel), and has its unit at most.
    What is large for the room is read by windows of whole chunks. Chunks that are not there have the fill value.

    Raises
    ------
    UnavailableError
        If zarr or xarray is not installed.
    FormatError
        If the store is not whole, or a file of it lies elsewhere.
    """
    source = _in_group(source)
    notes: list[str] = []
    with _opened(source, notes) as (array, dataset, groups):
        if dataset is None:
            surface = _of_array(source, array)
        else:
            _check_chunks(source, ((it.shape, it.encoding.get("chunks") or ()) for it in dataset.variables.values()))
            surface, more = of_group(source, dataset, groups, "zarr")
            notes += more
    for text in notes:  # said here, for the libraries' own warnings are not shown while the store is open
        warn(text)
    return surface


def members(source: Source, along: str) -> list[Member]:
    """List the surfaces of a store along a dimension, or its variables; see `lodestream.formats.series.members`.

    Raises
    ------
    FormatError
        If it is a single array.
    """
    source = _in_group(source)
    with _opened(source, []) as (_, dataset, _):
        if dataset is None:
            raise FormatError(f"expected a group of variables for each {along}, got a single array")
        return members_of(source, dataset, along)


def _in_group(source: Source) -> Source:
    """Return the group in place of one of its variables, which becomes an option."""
    folder = Path(os.path.realpath(source.path))
    if _is_variable(folder):
        source = replace(source, path=folder.parent, options={"variable": folder.name, **source.options})
    return replace(source, size=folder_size(source.path))


def _of_array(source: Source, array: Any) -> Surface:
    if source.options:
        raise FormatError(f"expected a group of variables for {', '.join(source.options)}=, got a single array")
    source.check_array(tuple(array.shape), array.dtype)
    _check_chunks(source, [(array.shape, array.chunks)])
    unit = array.attrs.get("units")
    said = {"unit": unit} if isinstance(unit, str) and unit.strip() else {}
    return Surface(read_source(array, source.room), metadata=source.metadata("zarr") | said)


def _check_chunks(source: Source, arrays: Iterable[tuple[tuple[int, ...], tuple[int, ...]]]) -> None:
    """Refuse chunks, of arrays of some shape, that a store is too small for: too large ones, and too many.

    Each is in memory as a whole. Each is looked for too, which takes half a millisecond and two kilobytes.
    """
    for shape, chunk in arrays:
        source.check_expansion(8 * prod(chunk))
        count = prod(-(-length // side) for length, side in zip(shape, chunk, strict=False))
        most = max(_HARMLESS_CHUNKS, source.size)
        if count > most:
            raise TooLargeError(
                f"expected at most {number(most)} chunks of a Zarr store of {number(source.size)} bytes, got an array "
                f"of {number(count)}"
            )


@contextmanager
def _opened(source: Source, notes: list[str]) -> Iterator[tuple[Any, Any, list[str]]]:
    """The array that a store is, or a group as a Dataset with values as they are stored; and all groups of the store.

    Of a group, variables with codecs that are not known are left out, and named in the notes.
    """
    try:
        import cf_xarray  # noqa: F401
        import xarray
        import zarr
    except ImportError:
        raise UnavailableError(
            "expected zarr and xarray with cf-xarray and pyproj for Zarr stores, which are not all installed: "
            "pip install 'lodestream[zarr]'"
        ) from None
    store = _store(zarr, source.path)
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            # What a store says of its members in one place could be other than what their folders say.
            node = (
                zarr.open(store, mode="r")
                if _is_array(source.path)
                else zarr.open_group(store, mode="r", use_consolidated=False)
            )
            if isinstance(node, zarr.Array):
                if unknown := _unknown(node.metadata.to_dict()):
                    raise FormatError(f"expected an array in codecs that are known, got {unknown[:60]!r}")
                yield node, None, []
                return
            groups, name = _groups(node), group_of(source)
            check_group(name, groups)
            left_out = _left_out(node[name] if name else node, bool(groups))
            if left_out:
                notes.append(f"left out variables: {listing(left_out.values())}")
            with ExitStack() as stack:

                def opened(group: str) -> Any:
                    unknown = left_out if group == name else _left_out(node[group] if group else node, True)
                    dataset = xarray.open_dataset(
                        store,
                        engine="zarr",
                        group=group or None,
                        consolidated=False,
                        decode_cf=False,
                        create_default_indexes=False,
                        cache=False,
                        chunks=None,
                        drop_variables=list(unknown),
                    )
                    # A folder lists its members in any order; the same store is to give the same surface.
                    return stack.enter_context(dataset)[sorted(dataset.variables, key=str)]

                yield None, with_parents(opened(name), map(opened, parents_of(name))), groups
    except UnavailableError:
        raise
    except InputError as error:
        raise reworded(error, "; ".join([str(error), *notes])) from None
    except MemoryError:
        raise TooLargeError("expected a Zarr store that fits into memory, got one that promises more") from None
    except Exception as error:  # none of these libraries says what it may raise
        reason = " ".join(str(error).replace(os.fspath(store.root), "the store").split()) or type(error).__name__
        raise FormatError(f"expected a whole Zarr store, got one that is not readable: {reason[:120]}") from None


def _groups(group: Any) -> list[str]:
    """Return paths of all groups with arrays inside a group, such as "forecast/surface".

    Raises
    ------
    TooLargeError
        If there are more groups than a store that is read may have.
    """
    found, rest, count = [], [("", group)], 0
    while rest:
        path, outer = rest.pop()
        for name, inner in outer.groups():
            count += 1
            if count > _MOST_GROUPS:
                raise TooLargeError(f"expected at most {number(_MOST_GROUPS)} groups in a Zarr store, got more")
            rest.append((f"{path}/{name}".strip("/"), inner))
        if path and any(array.ndim for _, array in outer.arrays()):
            found.append(path)
    return sorted(found)


def _left_out(group: Any, others: bool) -> dict[str, str]:
    """Return the arrays of a group that are no variables for us, each with the reason in words.

    Parameters
    ----------
    group : Group of zarr
    others : bool
        Whether there is something else to read if there is no variable.

    Raises
    ------
    FormatError
        If there is no other.
    """
    found: dict[str, str] = {}
    for name, array in group.arrays():
        described = array.metadata.to_dict()
        if codec := _unknown(described):
            found[name] = f"{name} (codec {codec[:40]!r}, which is not known)"
        elif array.ndim and not (described.get("dimension_names") or array.attrs.get("_ARRAY_DIMENSIONS")):
            found[name] = f"{name} (dimensions without names)"
        else:
            others = True
    if found and not others:
        raise FormatError(
            f"expected variables over named dimensions in a Zarr store, got {listing(found.values())}; the folder of "
            "an array is read alone"
        )
    return found


def _is_array(folder: Path) -> bool:
    return (folder / ".zarray").is_file() or _said(folder / "zarr.json").get("node_type") == "array"


def _is_variable(folder: Path) -> bool:
    """Return whether a folder is an array with names of dimensions, in the folder of a group."""
    if (folder / ".zarray").is_file():
        return (folder.parent / ".zgroup").is_file() and bool(_said(folder / ".zattrs").get("_ARRAY_DIMENSIONS"))
    said = _said(folder / "zarr.json")
    named = said.get("node_type") == "array" and any(said.get("dimension_names") or ())
    return named and _said(folder.parent / "zarr.json").get("node_type") == "group"


def _said(path: Path) -> Mapping[str, Any]:
    """Return the object in a JSON file of a store; empty: there is none. zarr itself refuses what is damaged."""
    try:
        said = json.loads(path.read_bytes()) if path.is_file() else {}
    except (OSError, ValueError, RecursionError):
        return {}
    return said if isinstance(said, dict) else {}


def _store(zarr: Any, folder: Path) -> Any:
    """Return the store of a folder, to be read only: files of it that are links to others, or no files, are refused."""
    root = os.path.realpath(folder)

    def check(key: str) -> None:
        path = os.path.realpath(os.path.join(root, key))
        if path != root and not path.startswith(os.path.join(root, "")):
            raise FormatError(f"expected a Zarr store whose files lie in its folder, got {key[:60]!r}, which leads out")
        try:
            mode = os.stat(path).st_mode
        except OSError:
            return  # zarr knows what a file that is not there means
        if not stat.S_ISREG(mode) and not stat.S_ISDIR(mode):
            raise FormatError(f"expected a Zarr store of regular files, got {key[:60]!r}, which is none")

    class Store(zarr.storage.LocalStore):  # type: ignore[misc, unused-ignore]
        def get_sync(self, key: str, **options: Any) -> Any:
            check(key)
            return super().get_sync(key, **options)

        async def get(self, key: str, prototype: Any = None, byte_range: Any = None) -> Any:
            check(key)
            return await super().get(key, prototype, byte_range)

        async def get_partial_values(self, prototype: Any, key_ranges: Iterable[tuple[str, Any]]) -> Any:
            wanted = list(key_ranges)
            for key, _ in wanted:
                check(key)
            return await super().get_partial_values(prototype, wanted)

    return Store(root, read_only=True)


def _unknown(described: Mapping[str, Any]) -> str:
    """Return the first codec of an array that is none of `_CODECS`; empty: there is none."""
    coded = described.get("codecs", ())
    if described.get("zarr_format") == 2:
        coded = [described.get("compressor"), *(described.get("filters") or ())]
    for codec in coded:
        if codec is None:
            continue
        said = codec if isinstance(codec, Mapping) else codec.get_config() if hasattr(codec, "get_config") else {}
        name = str(said.get("name", said.get("id", "")))
        if name.removeprefix("numcodecs.") not in _CODECS:
            return name or "one without a name"
        inner = said.get("configuration")
        if isinstance(inner, Mapping):
            for part in ("codecs", "index_codecs"):  # of shards
                if found := _unknown({"codecs": inner.get(part, ())}):
                    return found
    return ""
