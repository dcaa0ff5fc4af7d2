"""The table of formats: names, suffixes, recognition, readers and writers."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, BinaryIO

from ..surface import Surface
from . import glb, glb_reader, npy, npz, npz_writer, off, stl, text_arrays
from .member import Member
from .meshes import REMESH_OPTIONS
from .netcdf import reader as netcdf
from .netcdf import writer as netcdf_writer
from .netcdf import zarr_reader, zarr_store
from .obj import reader as obj
from .obj import writer as obj_writer
from .pcd import reader as pcd
from .plot3d import reader as plot3d
from .plot3d import writer as plot3d_writer
from .ply import reader as ply
from .ply import writer as ply_writer
from .raster import ascii_writer, cog, geotiff, png
from .raster.drivers import DRIVERS
from .source import Source
from .vtk import cgns, multiblock
from .vtk import legacy as vtk_legacy
from .vtk import writer as vts_writer
from .vtk import xml_files as vtk_xml

__all__ = ["FORMATS", "Format", "formats"]


@dataclass(frozen=True, slots=True, kw_only=True)
class Format:
    """One row of the table of formats.

    Attributes
    ----------
    name : str
        Name in ``?format=`` and in messages.
    suffixes : tuple of str
        File name suffixes, in lower case with their dot; the usual one first.
    sniff : callable
        ``sniff(head, suffix)`` tells whether a file that begins with the bytes `head` has this format. The suffix is
        that of a known format, or empty.
    read : callable or None
        Takes a `Source`, returns a `Surface`; None if the format is only written.
    write : callable or None
        Takes a `Surface` and a binary file that need not be seekable; None if the format is only read, or is a folder.
    blocks : bool
        Whether several blocks can be written.
    options : mapping of str to str
        Options for reading, each with a line of help.
    kinds : tuple of str
        Names of variants of this format that are read by other rules. Each can be switched off by itself.
    more : str
        Description of further files of the same surface; empty if the format takes one file only.
    named : callable or None
        Returns the options that a file's name implies (such as the position of an .hgt); explicit options take
        precedence. Code that identifies surfaces by bytes and options must include these.
    media_type : str
        Media type for HTTP.
    process : bool
        Whether reading starts a separate process, which must be allowed and needs its own memory.
    write_suffixes : tuple of str
        The suffixes under which it is written, if not under all of them.
    write_beside : callable or None
        Takes a `Surface` and the path of its file or folder, for a format of several files: it puts them all in place,
        complete or not at all. `write` makes a ZIP archive of them then, if there is one.
    folder : callable or None
        ``folder(path)`` tells whether a folder has this format; None if it is a file.
    memory : int
        Bytes that writing takes for each point, beside the surface, about; 0 where it takes some rows at a time, of a
        surface that is in files.
    members : callable or None
        Takes a `Source` and what its surfaces lie along, a dimension or ``variable``; returns a list of `Member`. None:
        a file holds one surface.
    by_block : bool
        Whether writing takes one block at a time: then its memory is that for the points of the largest one.
    restored : bool
        Whether writing takes a surface as `restore` gives it, with its repeated rows, columns and angles.
    """

    name: str
    suffixes: tuple[str, ...]
    sniff: Callable[[bytes, str], bool]
    read: Callable[[Source], Surface] | None = None
    write: Callable[[Surface, BinaryIO], None] | None = None
    members: Callable[[Source, str], list[Member]] | None = None
    blocks: bool = False
    options: Mapping[str, str] = field(default_factory=dict)
    kinds: tuple[str, ...] = ()
    more: str = ""
    named: Callable[[str], Mapping[str, str]] | None = None
    media_type: str = "application/octet-stream"
    process: bool = False
    write_suffixes: tuple[str, ...] = ()
    write_beside: Callable[[Surface, Path], None] | None = None
    folder: Callable[[Path], bool] | None = None
    memory: int = 0
    by_block: bool = False
    restored: bool = True

    @property
    def suffixes_out(self) -> tuple[str, ...]:
        """Suffixes of the names under which it is written, the usual one first; none where it is only read."""
        return (self.write_suffixes or self.suffixes) if self.write or self.write_beside else ()

    @property
    def stream_suffix(self) -> str:
        """Suffix of a file into which `write` writes; empty where there is no `write`."""
        return self.suffixes_out[0] + (".zip" if self.write_beside else "") if self.write else ""

    @property
    def names(self) -> tuple[str, ...]:
        """The names of this format and of its variants."""
        return self.name, *self.kinds


def _raster(name: str, **more: Any) -> Format:
    """Return the row of a raster that GDAL reads; `more` has the fields for writing."""
    driver = DRIVERS[name]
    return Format(
        name=name,
        suffixes=driver.suffixes,
        sniff=driver.sniff,
        read=driver.read,
        options=driver.options,
        named=driver.named,
        **more,
    )


#: In the order in which they are tried: the first whose `Format.sniff` agrees reads the file.
FORMATS = (
    Format(name="npy", suffixes=(".npy",), sniff=npy.sniff, read=npy.read, write=npy.write),
    Format(
        name="npz",
        suffixes=(".npz",),
        sniff=npz.sniff,
        read=npz.read,
        write=npz_writer.write,
        options=npz.READ_OPTIONS,
        memory=32,
    ),
    _raster("geotiff", write=geotiff.write, media_type="image/tiff"),
    Format(
        name="cog",
        suffixes=cog.SUFFIXES,
        sniff=cog.sniff,
        write=cog.write,
        media_type="image/tiff; application=geotiff; profile=cloud-optimized",
    ),
    Format(
        name="netcdf",
        suffixes=(".nc", ".nc4", ".cdf"),
        sniff=netcdf.sniff,
        read=netcdf.read,
        members=netcdf.members,
        write=netcdf_writer.write,
        options=netcdf.READ_OPTIONS,
        kinds=netcdf.KINDS,
        media_type="application/x-netcdf",
        restored=False,
    ),
    Format(
        name="zarr",
        suffixes=zarr_store.SUFFIXES,
        sniff=zarr_store.sniff,
        folder=zarr_reader.is_store,
        read=zarr_reader.read,
        members=zarr_reader.members,
        options={key: text for key, text in netcdf.READ_OPTIONS.items() if key != "resolution"},
        write_beside=zarr_store.write_beside,
        restored=False,
    ),
    _raster("png", write=png.write, memory=16, media_type="image/png"),
    _raster("esri-ascii", write=ascii_writer.write, memory=24, media_type="text/plain"),
    _raster("usgs-dem"),
    _raster("srtm-hgt"),
    Format(
        name="ply",
        suffixes=(".ply",),
        sniff=ply.sniff,
        read=ply.read,
        write=ply_writer.write,
        blocks=True,
        memory=120,
        options=REMESH_OPTIONS,
    ),
    Format(name="stl", suffixes=(".stl",), sniff=stl.sniff, read=stl.read, options=REMESH_OPTIONS),
    Format(name="off", suffixes=(".off",), sniff=off.sniff, read=off.read, options=REMESH_OPTIONS),
    Format(
        name="obj",
        suffixes=(".obj",),
        sniff=obj.sniff,
        read=obj.read,
        write=obj_writer.write,
        memory=144,
        blocks=True,
        media_type="model/obj",
        options=REMESH_OPTIONS,
    ),
    Format(name="pcd", suffixes=(".pcd",), sniff=pcd.sniff, read=pcd.read),
    Format(
        name="vtk",
        suffixes=(".vtk",),
        sniff=vtk_legacy.sniff,
        read=vtk_legacy.read,
        options=vtk_legacy.OPTIONS,
        process=True,
    ),
    Format(
        name="vts",
        suffixes=vtk_xml.SUFFIXES,
        sniff=vtk_xml.sniff,
        read=vtk_xml.read,
        write=vts_writer.write,
        memory=48,
        blocks=True,
        options=vtk_xml.OPTIONS,
        more=vtk_xml.MORE,
        process=True,
    ),
    Format(
        name="vtm",
        suffixes=multiblock.SUFFIXES,
        sniff=multiblock.sniff,
        write=multiblock.write,
        memory=48,
        by_block=True,
        write_beside=multiblock.write_beside,
        blocks=True,
        media_type=multiblock.MEDIA_TYPE,
    ),
    Format(
        name="glb",
        suffixes=(".glb",),
        sniff=glb.sniff,
        read=glb_reader.read,
        write=glb.write,
        options=REMESH_OPTIONS,
        blocks=True,
        media_type=glb.MEDIA_TYPE,
        memory=216,
    ),
    Format(name="cgns", suffixes=(".cgns",), sniff=cgns.sniff, read=cgns.read, options=cgns.OPTIONS, process=True),
    Format(
        name="text",
        suffixes=text_arrays.SUFFIXES,
        sniff=text_arrays.sniff,
        read=text_arrays.read,
        options=text_arrays.READ_OPTIONS,
        more=text_arrays.MORE,
    ),
    Format(
        name="plot3d",
        suffixes=plot3d.SUFFIXES,
        sniff=plot3d.sniff,
        read=plot3d.read,
        write=plot3d_writer.write,
        memory=48,
        by_block=True,
        blocks=True,
        write_suffixes=plot3d_writer.SUFFIXES,
        options=plot3d.READ_OPTIONS,
        more=plot3d.MORE,
    ),
)


def formats() -> tuple[Format, ...]:
    """Return all formats that can be read or written."""
    return FORMATS
