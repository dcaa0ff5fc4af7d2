"""Read NPZ: an archive of arrays, one of which is the surface, while others give its places."""

from __future__ import annotations

import zlib
from collections.abc import Collection, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from math import prod
from typing import Any
from zipfile import ZIP_DEFLATED, ZIP_STORED, BadZipFile, ZipFile, ZipInfo

import numpy as np
from numpy.typing import NDArray

from ..errors import Choice, ChoiceError, FormatError, InputError, OptionError, TooLargeError
from ..surface import Surface
from .notes import listing, warn
from .npy import NpyHeader, read_header, read_values
from .npz_writer import COORDINATES, HEIGHTS, MASK, POINTS, WORDS
from .placed import Coordinate, place
from .source import MOST_CHOICES, Source, number, refuse_array

__all__ = ["READ_OPTIONS", "read", "sniff"]

READ_OPTIONS = {
    "array": "name of the array that is the surface",
    "x": "name of the array of x, a vector or of the shape of the surface (default: x, lon, longitude or easting)",
    "y": "name of the array of y (default: y, lat, latitude or northing)",
}

_DEGREES = ("lon", "longitude")
_BOUNDS = (("dx", "xmin", "xmax"), ("dy", "ymin", "ymax"))

#: How far spacing times count may be from the extent, relative to it.
_CLOSE = 1e-6

#: Bytes of a text that is kept, four a character.
_LONGEST = 1 << 16

_MAX_MEMBERS = 1000
_ENCRYPTED = 1


def sniff(head: bytes, suffix: str) -> bool:
    """Return whether a file begins like a ZIP archive, full or empty."""
    return head.startswith((b"PK\x03\x04", b"PK\x05\x06"))


def read(source: Source) -> Surface:
    """Read the array that is a surface, with the coordinates beside it.

    Those are vectors or arrays under the usual names, or under those that options give; or the numbers dx, dy, xmin,
    xmax, ymin, ymax, where row 0 lies at ymin. All single numbers are kept in the metadata as ``scalars``, ``crs`` and
    ``unit`` by their names. A bool array ``mask`` of the same rows and columns is False in holes. Beside an array
    ``heights`` or ``points``, as `write` names it, other arrays of these rows and columns are attributes.

    Raises
    ------
    FormatError
        If no array is a surface, or coordinates stand beside points that have their own.
    """
    with _refusals(), ZipFile(source.path) as archive:
        members = _members(archive)
        contents = _Contents(source, archive, members, {name: _header(archive, it) for name, it in members.items()})
        name = _choose(contents)
        header = contents.headers[name]
        source.check_array(header.shape, header.dtype)
        axes = [contents.coordinate(letter, header.shape[:2], name) for letter in "xy"]
        values = contents.values(name)
        metadata = source.metadata("npz")
        scalars = contents.scalars()
        if scalars:
            metadata["scalars"] = scalars
        words = contents.words()
        metadata |= words
        mask = contents.mask(header.shape[:2])
        taken = {name, *scalars, *words, *[MASK] * (mask is not None)}
        if axes[0] is not None and axes[1] is not None:
            taken |= {str(contents.coordinate_name(letter, header.shape[:2], name)) for letter in "xy"}
        attributes = contents.attributes(name, taken)
        taken |= {*attributes}
        if left_out := [other for other in contents.headers if other not in taken]:
            warn(f"left out arrays of the archive: {listing(left_out)}")
    if axes[0] is not None and axes[1] is not None:
        if values.ndim != 2:
            raise FormatError(
                f"this archive has x and y beside {name}, which must then be heights of shape (H, W), and has the "
                f"shape {values.shape}: choose another array with array=, or save the points without x and y"
            )
        return place(
            values, axes[0], axes[1], closed=source.closed, mask=mask, attributes=attributes, metadata=metadata
        )
    transform = _bounds(metadata.get("scalars", {}), header.shape)
    if transform is not None:
        metadata["geotransform"] = transform
    return Surface(values, mask=mask, attributes=attributes, metadata=metadata)


@dataclass(frozen=True)
class _Contents:
    """The archive's members by the names of their arrays."""

    source: Source
    archive: ZipFile
    members: Mapping[str, ZipInfo]
    headers: Mapping[str, NpyHeader]

    @property
    def listing(self) -> str:
        """All arrays, in words."""
        words = [f"{name} ({header.words})" for name, header in self.headers.items()]
        return ", ".join(words[:10] + ["..."] * (len(words) > 10)) or "nothing"

    def values(self, name: str) -> NDArray[Any]:
        """Return an array, whose header has been checked."""
        header = self.headers[name]
        self.source.check_expansion(header.nbytes)
        with self.archive.open(self.members[name]) as file:
            read_header(file)
            values = read_values(file, header)
            if file.read(1):  # reading to the end is also what makes zipfile compare the CRC
                raise FormatError(
                    f"this archive is damaged: {name} goes on behind the {number(header.nbytes)} bytes of its values"
                )
        return values

    def coordinate(self, letter: str, shape: tuple[int, ...], heights: str) -> Coordinate | None:
        """Return the array of x or y; None if there is none."""
        name = self.coordinate_name(letter, shape, heights)
        if name is None:
            return None
        degrees = letter == "x" and name.lower() in _DEGREES
        return Coordinate(self.values(name), _along(letter, shape)[self.headers[name].shape], degrees)

    def coordinate_name(self, letter: str, shape: tuple[int, ...], heights: str) -> str | None:
        """Return the name of the array of x or y: that of the option, or a usual name with a fitting shape."""
        shapes = _along(letter, shape)
        if letter in self.source.options:
            name = str(self.source.options[letter])
            if name not in self.headers:
                raise OptionError(f"this archive has no array {name!r} for {letter}=, only {self.listing}")
            header = self.headers[name]
            if header.shape not in shapes or header.dtype.kind not in "iuf":
                raise FormatError(
                    f"this archive has {header.words} in {name}, which is no {letter} of {heights}: save numbers of "
                    f"its shape, {shape}, or a vector of {shape[1 - 'xy'.index(letter)]}"
                )
        else:
            fitting = (
                name
                for name, header in self.headers.items()
                if name.lower() in COORDINATES[letter] and header.shape in shapes and header.dtype.kind in "iuf"
            )
            name = next(fitting, heights)
            if name == heights:
                return None
        return name

    def scalars(self) -> dict[str, Any]:
        """Return the single numbers."""
        return {
            name: np.asarray(self.values(name)).reshape(-1)[0].item()
            for name, header in self.headers.items()
            if header.dtype.kind in "iuf" and header.dtype.itemsize <= 8 and set(header.shape) <= {1}
        }

    def mask(self, shape: tuple[int, ...]) -> NDArray[np.bool_] | None:
        """Return the mask of valid points; None if there is none of this shape."""
        header = self.headers.get(MASK)
        if header is None or header.dtype.kind != "b" or header.shape != shape:
            return None
        return np.asarray(self.values(MASK))

    def attributes(self, surface: str, taken: Collection[str]) -> dict[str, NDArray[Any]]:
        """Return the other arrays (H, W) or (H, W, K) beside a surface under the name that our writer uses."""
        if surface not in (HEIGHTS, POINTS):
            return {}
        shape = self.headers[surface].shape[:2]
        headers = {
            name: header
            for name, header in self.headers.items()
            if name not in taken and header.shape[:2] == shape and refuse_array(header.shape, header.dtype) is None
        }
        channels = sum(prod(header.shape[2:]) for header in headers.values())
        if channels:
            self.source.check_array((*shape, max(channels, 2)), np.dtype(np.float64))  # of all together
            self.source.check_expansion(sum(header.nbytes for header in headers.values()))
        return {name: self.values(name) for name in headers}

    def words(self) -> dict[str, str]:
        """Return the texts of the names in `WORDS`."""
        texts = {}
        for name in WORDS:
            header = self.headers.get(name)
            if header is not None and header.dtype.kind == "U" and header.shape == () and header.nbytes <= _LONGEST:
                texts[name] = str(self.values(name))
        return texts


def _along(letter: str, shape: tuple[int, ...]) -> dict[tuple[int, ...], int | None]:
    """Return the shapes that x or y may have, and the axis of each: None for both."""
    axis = 1 - "xy".index(letter)
    return {shape: None, (shape[axis],): axis}


@contextmanager
def _refusals() -> Iterator[None]:
    try:
        yield
    except InputError:
        raise
    except (BadZipFile, zlib.error, EOFError, NotImplementedError, ValueError, OSError) as error:
        raise FormatError(
            f"this NPZ archive cannot be unpacked, since it is damaged or cut short ({error}): copy it or save it again"
        ) from None


def _members(archive: ZipFile) -> dict[str, ZipInfo]:
    infos = archive.infolist()
    if len(infos) > _MAX_MEMBERS:
        raise TooLargeError(f"expected at most {_MAX_MEMBERS} arrays in an archive, got {number(len(infos))} members")
    members = {}
    for info in infos:
        if not info.filename.endswith(".npy"):
            raise FormatError(
                f"this is a ZIP archive that holds {info.filename!r}, not an archive of NumPy, which holds .npy files "
                "only: unpack it, and give the file with the surface"
            )
        if info.flag_bits & _ENCRYPTED or info.compress_type not in (ZIP_STORED, ZIP_DEFLATED):
            raise FormatError(
                f"this archive has {info.filename!r} encrypted, or packed otherwise than stored or deflated: save it "
                "with numpy.savez or numpy.savez_compressed"
            )
        members[info.filename.removesuffix(".npy")] = info
    return members


def _header(archive: ZipFile, member: ZipInfo) -> NpyHeader:
    with archive.open(member) as file:
        header = read_header(file)
        promised = file.tell() + header.nbytes
    if promised != member.file_size and not header.dtype.hasobject:
        kind = TooLargeError if promised > member.file_size else FormatError
        words = "is cut short" if promised > member.file_size else "goes on behind its array"
        raise kind(
            f"this archive is damaged: {member.filename!r} {words}, with {number(member.file_size)} bytes where its "
            f"header says {header.words}, {number(promised)} bytes"
        )
    return header


def _choose(contents: _Contents) -> str:
    if "array" in contents.source.options:
        name = str(contents.source.options["array"])
        if name not in contents.headers:
            raise OptionError(f"this archive has no array {name!r}: choose with array= one of {contents.listing}")
        return name
    beside = {*COORDINATES["x"], *COORDINATES["y"]}
    beside |= {str(contents.source.options[letter]) for letter in "xy" if letter in contents.source.options}
    surfaces = [name for name, header in contents.headers.items() if refuse_array(header.shape, header.dtype) is None]
    others = [name for name in surfaces if name.lower() not in beside and name not in beside]
    ours = [name for name in others if name in (HEIGHTS, POINTS)]
    if len(ours) == 1:
        return ours[0]
    if len(others) == 1 or len(surfaces) == 1:
        return (others or surfaces)[0]
    if surfaces:
        names = " or ".join(surfaces)
        raise ChoiceError(
            f"this archive has {len(surfaces)} arrays that are surfaces: choose one with array= {names}",
            [Choice({"array": name}, contents.headers[name].shape[:2]) for name in surfaces[:MOST_CHOICES]],
        )
    if len(contents.headers) == 1:
        ((name, header),) = contents.headers.items()
        raise FormatError(f"{name}: {refuse_array(header.shape, header.dtype)}")
    raise FormatError(
        "this archive has no array of the shape (H, W), (H, W, 2), (H, W, 3) or more channels, of integers, float32 or "
        f"float64: it holds {contents.listing}"
    )


def _bounds(scalars: Mapping[str, Any], shape: tuple[int, ...]) -> list[float] | None:
    """Return the geotransform on which spacings and an extent, of cells or of points, agree; None if they do not."""
    if len(shape) != 2:
        return None
    transform: list[float] = []
    for axis, names in enumerate(_BOUNDS):
        count = shape[1 - axis]
        try:
            spacing, first, last = (float(scalars[name]) for name in names)
        except KeyError:
            return None
        fitting = [n for n in (count, count - 1) if n and abs(abs(last - first) - n * spacing) <= _CLOSE * n * spacing]
        if not fitting:
            return None
        step = spacing if last > first else -spacing
        origin = first if fitting[0] == count else first - step / 2
        transform += [origin, step, 0.0] if axis == 0 else [origin, 0.0, step]
    return transform
