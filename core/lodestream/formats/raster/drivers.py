"""The rasters that GDAL reads: one row for each driver, with its checks.

Any bytes are heights of SRTM, and the digits of an ESRI ASCII grid are counted by nobody else; what a longer check or
another meaning of the values takes is in a module of its own (`tiff_guard`, `png`).
"""

from __future__ import annotations

import re
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field

import numpy as np

from ...errors import FormatError, OptionError
from ...surface import Surface
from ..notes import warn
from ..source import Source, number
from . import gdal, png, tiff_guard

__all__ = ["DRIVERS", "Driver"]


@dataclass(frozen=True, slots=True, kw_only=True)
class Driver:
    """One row of the table of rasters.

    Attributes
    ----------
    name : str
        Name of the format.
    gdal : str
        GDAL's name of the only driver that may open the file.
    title : str
        What people call the format, for messages.
    suffixes : tuple of str
        See `lodestream.formats.table.Format`, as for `sniff`, `options` and `named`.
    sniff : callable
    check : callable
        Refuses a file before GDAL sees it: takes a `Source`, raises an `InputError`.
    file_name : callable
        Returns what GDAL shall think that the file is called; by default "data" with the usual suffix.
    finish : callable
        Takes the surface that GDAL has read and the `Source`, returns the surface that the file stands for.
    open_options : mapping of str to str
        Of GDAL's driver.
    options : mapping of str to str
    named : callable or None
    """

    name: str
    gdal: str
    title: str
    suffixes: tuple[str, ...]
    sniff: Callable[[bytes, str], bool]
    check: Callable[[Source], None] = lambda source: None
    file_name: Callable[[Source], str] | None = None
    finish: Callable[[Surface, Source], Surface] = lambda surface, source: surface
    open_options: Mapping[str, str] = field(default_factory=dict)
    options: Mapping[str, str] = field(default_factory=dict)
    named: Callable[[str], Mapping[str, str]] | None = None

    def read(self, source: Source) -> Surface:
        """Read one band as heights and the others as attributes.

        Raises
        ------
        FormatError, TooLargeError, OptionError
            From the check, or if GDAL cannot read the file.
        """
        self.check(source)
        file_name = self.file_name(source) if self.file_name else f"data{self.suffixes[0]}"
        surface = gdal.read(source, self.gdal, self.name, self.title, file_name, **self.open_options)
        return self.finish(surface, source)


#: Magic numbers of TIFF: both byte orders, classic and BigTIFF.
_TIFF = (b"II*\0", b"MM\0*", b"II+\0", b"MM\0+")

_ASCII_HEADER = re.compile(
    rb"\s*(ncols|nrows|[xy]ll(?:corner|center|centre)|cellsize|dx|dy|nodata_value|nodata)[ \t]+(\S+)[ \t]*(?=[\r\n])",
    re.IGNORECASE,
)
_LONGEST_ASCII_HEADER = 4096
_CHUNK = 1 << 22


def _check_ascii(source: Source) -> None:
    """Check the size in the header, and count the numbers after it: GDAL ignores surplus numbers."""
    with source.path.open("rb") as file:
        head = file.read(_LONGEST_ASCII_HEADER)
        header: dict[bytes, bytes] = {}
        end = 0
        while match := _ASCII_HEADER.match(head, end):
            header[match[1].lower()] = match[2]
            end = match.end()
        try:
            columns, rows = (int(header[key]) for key in (b"ncols", b"nrows"))
        except (KeyError, ValueError):
            raise FormatError(
                "expected an ESRI ASCII grid with whole numbers for ncols and nrows, got others"
            ) from None
        source.check_array((rows, columns), np.dtype(np.float64))
        count, inside = 0, False
        file.seek(end)
        while chunk := file.read(_CHUNK):
            word = np.frombuffer(chunk, np.uint8) > ord(" ")
            count += int(np.count_nonzero(word[1:] & ~word[:-1])) + int(word[0] and not inside)
            inside = bool(word[-1])
    if count != rows * columns:
        raise FormatError(f"expected {number(rows * columns)} numbers ({rows} x {columns}), got {number(count)}")


#: Record A of a USGS DEM, in columns of six characters: pattern (regular), planimetric system, units of the ground.
_PATTERN, _SYSTEM, _UNITS = slice(150, 156), slice(156, 162), slice(528, 534)


def _is_usgs_dem(head: bytes, suffix: str) -> bool:
    """Return whether the first record, of 1024 characters, has the numbers of a DEM in their columns."""
    return (
        len(head) >= 1024
        and head[_PATTERN] in (b"     1", b"     4")
        and head[_SYSTEM] in (b"     0", b"     1", b"     2", b"     3", b" -9999")
        and head[_UNITS].strip().isdigit()
    )


_TILE = re.compile(r"[NS][0-8][0-9][EW](?:0[0-9][0-9]|1[0-7][0-9]|180)", re.IGNORECASE)
_NOWHERE = "N00E000"

#: Rows and columns of one degree at 3 arc seconds, at 1, and at 1 by 2.
_SRTM_SHAPES = ((1201, 1201), (3601, 3601), (3601, 1801))


def _tile_of(name: str) -> Mapping[str, str]:
    """Return the SRTM tile with which a file's name begins."""
    match = _TILE.match(name)
    return {"tile": match[0].upper()} if match else {}


def _check_srtm(source: Source) -> None:
    if source.size not in {2 * rows * columns for rows, columns in _SRTM_SHAPES}:
        known = ", ".join(f"{number(2 * rows * columns)} ({rows} x {columns})" for rows, columns in _SRTM_SHAPES)
        raise FormatError(f"expected an SRTM tile of {known} bytes, got {number(source.size)}")
    if not _TILE.fullmatch(str(source.options.get("tile", _NOWHERE))):
        raise OptionError(f"expected tile= a corner such as N37W122, got {str(source.options['tile'])!r}")


def _located(surface: Surface, source: Source) -> Surface:
    """Drop the position if neither a name nor an option gives it."""
    if "tile" not in source.options:
        del surface.metadata["geotransform"], surface.metadata["crs"]
        warn("the name of an SRTM tile gives its position, but this one does not: use an option such as tile=N37W122")
    return surface


_ROWS = (
    Driver(
        name="geotiff",
        gdal="GTiff",
        title="GeoTIFF",
        suffixes=(".tif", ".tiff"),
        sniff=lambda head, suffix: head.startswith(_TIFF),
        check=lambda source: tiff_guard.check(source.path),
        options={"band": "number of the band of heights, from 1 (default: 1); the others become attributes"},
    ),
    Driver(
        name="png",
        gdal="PNG",
        title="PNG",
        suffixes=(".png",),
        sniff=png.sniff,
        check=png.check,
        finish=png.heights,
        options=png.READ_OPTIONS,
        named=png.named,
    ),
    Driver(
        name="esri-ascii",
        gdal="AAIGrid",
        title="ESRI ASCII grid",
        suffixes=(".asc",),
        sniff=lambda head, suffix: _ASCII_HEADER.match(head) is not None,
        check=_check_ascii,
        open_options={"DATATYPE": "Float64"},  # whatever the digits say
    ),
    Driver(name="usgs-dem", gdal="USGSDEM", title="USGS DEM", suffixes=(".dem",), sniff=_is_usgs_dem),
    Driver(
        name="srtm-hgt",
        gdal="SRTMHGT",
        title="SRTM tile",
        suffixes=(".hgt",),
        sniff=lambda head, suffix: suffix == ".hgt",  # only the suffix tells: any bytes are heights
        check=_check_srtm,
        file_name=lambda source: f"{str(source.options.get('tile', _NOWHERE)).upper()}.hgt",
        finish=_located,
        options={"tile": "south-west corner in degrees, such as N37W122 (default: what the file's name begins with)"},
        named=_tile_of,
    ),
)

#: By the name of the format.
DRIVERS: Mapping[str, Driver] = {row.name: row for row in _ROWS}
