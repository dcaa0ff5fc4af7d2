"""NPZ: an archive of arrays, of which one is the surface."""

from __future__ import annotations

import zlib
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any
from zipfile import ZIP_DEFLATED, ZIP_STORED, BadZipFile, ZipFile, ZipInfo

import numpy as np

from ..errors import FormatError, InputError, OptionError, TooLargeError
from ..surface import Surface
from .npy import Header, read_header, read_values
from .source import Source, number, refuse_array

__all__ = ["read", "sniff"]

_MAX_MEMBERS = 1000
_ENCRYPTED = 1


def sniff(head: bytes, suffix: str) -> bool:
    """Whether a file begins like a ZIP archive, full or empty."""
    return head.startswith((b"PK\x03\x04", b"PK\x05\x06"))


def read(source: Source) -> Surface:
    """Read the only array that can be a surface, or the one that the option ``array`` names.

    Single numbers beside it (spacings, extents) are kept in the metadata as ``scalars``.
    """
    with _refusals(), ZipFile(source.path) as archive:
        members = _members(archive)
        headers = {name: _header(archive, member) for name, member in members.items()}
        name = _choose(source, headers)
        header = headers[name]
        source.check_array(header.shape, header.dtype)
        source.check_expansion(header.nbytes)
        with archive.open(members[name]) as file:
            read_header(file)
            values = read_values(file, header)
            if file.read(1):  # reading to the end is also what makes zipfile compare the CRC
                raise FormatError(f"expected {number(header.nbytes)} bytes of values in {name}, got more")
        metadata = source.metadata("npz")
        scalars = {other: _scalar(archive, members[other]) for other, it in headers.items() if _is_scalar(it)}
        if scalars:
            metadata["scalars"] = scalars
    return Surface(values, metadata=metadata)


@contextmanager
def _refusals() -> Iterator[None]:
    try:
        yield
    except InputError:
        raise
    except (BadZipFile, zlib.error, EOFError, NotImplementedError, ValueError, OSError) as error:
        raise FormatError(f"expected a whole NPZ archive, got one that cannot be unpacked: {error}") from None


def _members(archive: ZipFile) -> dict[str, ZipInfo]:
    infos = archive.infolist()
    if len(infos) > _MAX_MEMBERS:
        raise TooLargeError(f"expected at most {_MAX_MEMBERS} arrays in an archive, got {number(len(infos))} members")
    members = {}
    for info in infos:
        if not info.filename.endswith(".npy"):
            raise FormatError(f"expected an NPZ archive, which holds .npy members only, got a member {info.filename!r}")
        if info.flag_bits & _ENCRYPTED or info.compress_type not in (ZIP_STORED, ZIP_DEFLATED):
            raise FormatError(f"expected members stored or deflated, got {info.filename!r} packed in another way")
        members[info.filename.removesuffix(".npy")] = info
    return members


def _header(archive: ZipFile, member: ZipInfo) -> Header:
    with archive.open(member) as file:
        header = read_header(file)
        promised = file.tell() + header.nbytes
    if promised != member.file_size and not header.dtype.hasobject:
        kind = TooLargeError if promised > member.file_size else FormatError
        raise kind(
            f"expected {number(promised)} bytes in {member.filename!r} ({header.words}), got {number(member.file_size)}"
        )
    return header


def _choose(source: Source, headers: dict[str, Header]) -> str:
    listing = ", ".join(f"{name} ({header.words})" for name, header in headers.items()) or "nothing"
    if "array" in source.options:
        name = str(source.options["array"])
        if name not in headers:
            raise OptionError(f"expected array= one of {listing}, got {name!r}")
        return name
    surfaces = [name for name, header in headers.items() if refuse_array(header.shape, header.dtype) is None]
    if len(surfaces) == 1:
        return surfaces[0]
    if surfaces:
        raise FormatError(
            f"expected one array that is a surface, got {len(surfaces)}: choose one with array= {' or '.join(surfaces)}"
        )
    raise FormatError(f"expected an array of shape (H, W), (H, W, 2) or (H, W, C >= 3) of numbers, got {listing}")


def _is_scalar(header: Header) -> bool:
    return header.dtype.kind in "iuf" and header.dtype.itemsize <= 8 and set(header.shape) <= {1}


def _scalar(archive: ZipFile, member: ZipInfo) -> Any:
    with archive.open(member) as file:
        return np.asarray(read_values(file, read_header(file))).reshape(-1)[0].item()
