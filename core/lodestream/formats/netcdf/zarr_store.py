"""Zarr stores, version 3 of the format: a folder with what a NetCDF of the surface says, written in strips of rows.

Source: the Zarr core specification, version 3.1; attributes as xarray reads and writes them in such stores.
"""

from __future__ import annotations

import base64
import errno
import secrets
import shutil
import struct
import time
import warnings
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from ...errors import FormatError, UnavailableError
from ...surface import Surface
from .attribute_texts import plain_of
from .stored import Variable, contents_of, strips

__all__ = ["SUFFIXES", "sniff", "write_beside"]

SUFFIXES = (".zarr",)

#: Rows and columns of a chunk, each of which is a file.
_CHUNK = 512


def sniff(head: bytes, suffix: str) -> bool:
    """Never: a store is a folder, and no file."""
    return False


def write_beside(surface: Surface, path: Path) -> None:
    """Write the folder, under a temporary name, and put it in place by renaming.

    An empty folder of that name is replaced; one with files is not, whoever has written them.

    Raises
    ------
    UnavailableError
        If zarr is not installed.
    FormatError
        If there is a file of that name, or a folder with files; or if zarr refuses what the surface is called.
    OSError
        If the disk does not take it, or files came into the folder meanwhile.
    """
    if path.exists() and not path.is_dir():
        raise FormatError("expected a place for the folder of a Zarr store, got a file of that name")
    if path.exists() and any(path.iterdir()):
        raise FormatError(
            "expected no folder of that name, or an empty one, for a Zarr store, got one with files: remove it, or "
            "choose another name"
        )
    made = path.with_name(f".{path.name[:50]}.{secrets.token_hex(4)}.tmp")
    try:
        _write(surface, made)
        made.replace(path)  # an empty folder gives way, any other is an error
    finally:
        shutil.rmtree(made, ignore_errors=True)


def _write(surface: Surface, folder: Path) -> None:
    """Write the store into a folder that is not there yet."""
    try:
        import zarr
        from zarr.codecs import BloscCodec
    except ImportError:
        raise UnavailableError(
            "expected zarr for Zarr stores, which is not installed: pip install 'lodestream[zarr]'"
        ) from None
    contents = contents_of(surface, "Zarr")
    codec = BloscCodec(cname="zstd", clevel=3, shuffle="shuffle")
    try:
        with _store(folder) as store:
            group = zarr.open_group(store, mode="w-", zarr_format=3, attributes=_attributes(contents.attributes))
            for name, variable in contents.variables.items():
                _write_variable(group, name, variable, codec)
            with warnings.catch_warnings():
                warnings.simplefilter("ignore")  # that version 3 leaves open how; without it xarray warns
                zarr.consolidate_metadata(store)
    except (ValueError, TypeError, KeyError) as error:
        raise FormatError(f"expected a surface that Zarr can hold, got one that it refuses: {error}") from None
    except OSError as error:
        if error.errno != errno.ENAMETOOLONG:
            raise
        longest = max((len(name) for name in contents.variables), default=0)
        raise FormatError(
            "expected names of attributes that can name a folder, as Zarr stores have one for each, got one of "
            f"{longest:,} characters"
        ) from None


@contextmanager
def _store(folder: Path) -> Iterator[Any]:
    """A store that nobody writes to any more after an error: zarr's threads go on with the other chunks of a strip."""
    import zarr

    ended, busy = False, 0

    class Store(zarr.storage.LocalStore):  # type: ignore[misc, unused-ignore]
        async def set(self, key: str, value: Any) -> None:
            nonlocal busy
            busy += 1  # in one thread, that of zarr's event loop
            try:
                if ended:
                    raise FormatError("expected nothing more for a Zarr store that has failed, got a chunk")
                await super().set(key, value)
            finally:
                busy -= 1

    try:
        yield Store(folder)  # of a path, so that no name is taken for an address
    finally:
        ended = True
        while busy:
            time.sleep(0.001)


def _write_variable(group: Any, name: str, variable: Variable, codec: Any) -> None:
    fill = variable.fill
    made = group.create_array(
        name,
        shape=variable.shape,
        chunks=(*(min(length, _CHUNK) for length in variable.shape[:2]), *[1] * (len(variable.shape) - 2)),
        dtype=variable.dtype,
        fill_value=variable.dtype.type(0) if fill is None else fill,
        dimension_names=variable.dims,
        attributes=_attributes(variable.attributes) | ({} if fill is None else {"_FillValue": _as_json(fill)}),
        compressors=codec,
    )
    if not variable.shape:
        made[...] = variable.rows(slice(None))
        return
    for rows, values in strips(variable, _CHUNK if len(variable.shape) > 1 else variable.shape[0]):
        made[rows] = values


def _attributes(attributes: Mapping[str, Any]) -> dict[str, Any]:
    """Return attributes as JSON has them."""
    return {key: plain_of(value) for key, value in attributes.items()}


def _as_json(fill: Any) -> int | str:
    """``_FillValue`` as xarray has it in a store: integers as they are, floats as the bytes of a double."""
    if fill.dtype.kind == "f":
        return base64.standard_b64encode(struct.pack("<d", float(fill))).decode()
    return int(fill)
