"""Curvilinear files made to do harm: each refused with its reason, within five seconds of a processor and 512 MiB."""

from __future__ import annotations

import re
import struct
import zlib
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from .refusals import SECONDS, Refusal, refusals
from .test_bad_input import MIB, TOLD
from .test_plot3d import Written

VTS = (
    '<VTKFile type="StructuredGrid" version="1.0" byte_order="LittleEndian" header_type="UInt64"{more}>'
    '<StructuredGrid WholeExtent="{extent}"><Piece Extent="{extent}"><Points>'
    '<DataArray type="Float64" NumberOfComponents="3" format="{form}" offset="0">{text}</DataArray>'
    "</Points></Piece></StructuredGrid>{tail}</VTKFile>"
)
PCD = "VERSION 0.7\nFIELDS x y z\nSIZE 4 4 4\nTYPE F F F\nCOUNT 1 1 1\nWIDTH {0}\nHEIGHT {1}\nPOINTS {2}\nDATA {3}\n"
PLY = "ply\nformat {0} 1.0\nelement vertex {1}\nproperty float x\nproperty float y\nproperty float z\n{2}end_header\n"
LEGACY = "# vtk DataFile Version 3.0\nx\nASCII\nDATASET STRUCTURED_GRID\nDIMENSIONS {0} {1} 1\nPOINTS {2} float\n{3}"
RANGE = "obj_info num_cols {0}\nobj_info num_rows {1}\nelement range_grid {2}\nproperty list {3} int vertex_indices\n"


def two_layouts() -> bytes:
    return Written(((40, 60),), multi=True, iblank=True, precision=4).binary()


def vts(extent: str, form: str = "appended", text: str = "", more: str = "", tail: bytes = b"") -> bytes:
    content = VTS.format(extent=extent, form=form, text=text, more=more, tail="TAIL")
    return content.encode().replace(b"TAIL", b'<AppendedData encoding="raw">_' + tail if tail else b"")


def zlib_bomb() -> bytes:
    """An array of 60 MB of which each block of the header is right and each block of the data makes more."""
    bomb = zlib.compress(bytes(64 << 20), 9)
    head = struct.pack("<4Q", 1, 24 * 2500 * 1000, 0, len(bomb))
    return vts("0 2499 0 999 0 0", more=' compressor="vtkZLibDataCompressor"', tail=head + bomb)


def adf_with_a_link() -> bytes:
    node = b"NoDe" + b"Zone".ljust(32) + b"Zone_t".ljust(32) + b"0" * 28 + b"LK".ljust(32)
    return b"\xc0\xa8\xa3\xa9ADF Database Version A02011>" + bytes(200) + node + b"/etc/passwd"


def hdf5_with_a_link(path: Path) -> bytes:
    h5py = pytest.importorskip("h5py")
    with h5py.File(path, "w") as file:
        file["Base"] = h5py.ExternalLink("/etc/passwd", "/")
        file.attrs["label"] = np.bytes_(b"Root Node of HDF5 File")
    return path.read_bytes()


def lzf_zeros(size: int) -> bytes:
    """LZF of so many zeros: back references of 264 bytes each."""
    whole, rest = divmod(size - 1, 264)
    return b"\0\0" + b"\xe0\xff\0" * whole + b"\0\0" * rest


#: Name of the file, its content, options, the class of the error, and what its message holds.
CASES: dict[str, tuple[str, Callable[[], bytes], dict[str, Any], str, str]] = {
    "PLOT3D that two layouts fit": (
        "a.xyz",
        two_layouts,
        {},
        "FormatError",
        "28,812 bytes that 2 fit, choose by -o di",
    ),
    "PLOT3D of 2^72 points": (
        "a.xyz",
        lambda: struct.pack("<3i", 1 << 20, 1 << 20, 1 << 24) + bytes(99),
        {},
        "FormatError",
        "whose size fits its dimensions, got 111 bytes",
    ),
    "PLOT3D of 4096 vast blocks": (
        "a.xyz",
        lambda: struct.pack("<i", 4096) + struct.pack("<3i", 1 << 20, 1 << 20, 1 << 20) * 4096 + bytes(1 << 20),
        {},
        "FormatError",
        "whose size fits its dimensions",
    ),
    "PLOT3D whose record markers lie": (
        "a.xyz",
        lambda: Written(((4, 3, 1),), False, False, records=True).binary().replace(struct.pack("<i", 288), b"\x7f" * 4),
        {},
        "FormatError",
        "whose size fits its dimensions",
    ),
    "PLOT3D of a million-fold repeat": (
        "a.fmt",
        lambda: b"10000 10000 1\n300000000*1.5\n",
        {},
        "TooLargeError",
        "repeat counts that expand the file at most 64 times",
    ),
    "PLOT3D of repeats on every line": (
        "a.fmt",
        lambda: b"10000 10000 1\n" + b"900000*1.5\n" * 20000,
        {},
        "TooLargeError",
        "repeat counts that expand the file at most 64 times",
    ),
    "PLOT3D of NaN everywhere": (
        "a.fmt",
        lambda: b"500 500 1\n" + b"nan NaN\n" * 375000,
        {},
        "InputError",
        "at least one valid point, got 500 x 500 holes",
    ),
    "PLOT3D of words": ("a.fmt", lambda: b"3 3 1\n" + b"1.5\n" * 9999 + b"hill\n", {}, "FormatError", "line 10001: "),
    "PLOT3D of one line": ("a.fmt", lambda: b"3 3 1 " + b"1.5 " * (1 << 19), {}, "FormatError", "line of at most"),
    "PCD of 2^62 points": (
        "a.pcd",
        lambda: PCD.format(1 << 31, 1 << 31, 1 << 62, "binary").encode(),
        {},
        "TooLargeError",
        "at most 268,435,456 vertices",
    ),
    "PCD that promises more than follows": (
        "a.pcd",
        lambda: PCD.format(9999, 9999, 9999**2, "binary").encode() + bytes(99),
        {},
        "FormatError",
        "cut short: .* and 99 follow",
    ),
    "PCD of lines that are not there": (
        "a.pcd",
        lambda: PCD.format(9999, 9999, 9999**2, "ascii").encode() + b"1 2 3\n",
        {},
        "FormatError",
        "cut short: its header says 99,980,001 points, and 1 lines follow",
    ),
    "PCD of a million-fold archive": (
        "a.pcd",
        lambda: (
            PCD.format(9999, 9999, 9999**2, "binary_compressed").encode()
            + struct.pack("<II", 9, 12 * 9999**2)
            + lzf_zeros(9)
        ),
        {},
        "TooLargeError",
        "expands at most 2048 times",
    ),
    "PCD that bursts when it expands": (
        "a.pcd",
        lambda: (
            PCD.format(100, 100, 10000, "binary_compressed").encode()
            + struct.pack("<II", len(lzf_zeros(1 << 28)), 120000)
            + lzf_zeros(1 << 28)
        ),
        {},
        "FormatError",
        "LZF data that make 120,000 bytes",
    ),
    "PCD of a field of 4 GiB": (
        "a.pcd",
        lambda: PCD.format(3, 3, 9, "binary").replace("COUNT 1 1 1", "COUNT 1 1 4294967296").encode(),
        {},
        "FormatError",
        "COUNT from 1 to 4096",
    ),
    "PLY of 2^31 vertices in text": (
        "a.ply",
        lambda: PLY.format("ascii", 2**31, RANGE.format(9, 9, 81, "uchar")).encode() + b"1 2 3\n",
        {},
        "FormatError",
        "cut short: its header says 2,147,483,648 rows of vertex",
    ),
    "PLY of 2^31 vertices": (
        "a.ply",
        lambda: PLY.format("binary_little_endian", 2**31, RANGE.format(9, 9, 81, "uchar")).encode() + bytes(999),
        {},
        "FormatError",
        "cut short: its header says 2,147,483,648 rows of vertex",
    ),
    "PLY of a range grid of 2^62 places": (
        "a.ply",
        lambda: PLY.format("binary_little_endian", 1, RANGE.format(1 << 29, 1 << 29, 1, "uchar")).encode() + bytes(13),
        {},
        "TooLargeError",
        "a range grid of 536870912 x 536870912",
    ),
    "PLY of lists of 4 GiB": (
        "a.ply",
        lambda: PLY.format("binary_little_endian", 1, RANGE.format(3, 3, 9, "uint")).encode() + b"\xff" * 99,
        {},
        "FormatError",
        "cut short: its header says 9 rows of range_grid, and at row 0 ",
    ),
    "PLY whose header never ends": ("a.ply", lambda: b"ply\n" + b"comment a\n" * 300000, {}, "FormatError", "end_head"),
    "VTS whose array lies about its length": (
        "a.vts",
        lambda: vts("0 2 0 1 0 0", tail=struct.pack("<Q", 1 << 60) + bytes(144)),
        {},
        "FormatError",
        "144 bytes by its extent and type, got a header that says 1,152,921,504,606,846,976",
    ),
    "VTS whose array lies outside": (
        "a.vts",
        lambda: vts("0 2 0 1 0 0", tail=struct.pack("<Q", 144) + bytes(144)).replace(b'"0">', b'"99999999999">'),
        {},
        "FormatError",
        "inside the file, got none there",
    ),
    "VTS that promises more than follows": (
        "a.vts",
        lambda: vts("0 9999 0 9999 0 0", tail=struct.pack("<Q", 24 * 10**8) + bytes(144)),
        {},
        "FormatError",
        "expected array 'of points' of at least 2,400,000,008 bytes",
    ),
    "VTS of 2^90 points": (
        "a.vts",
        lambda: vts("0 999999999 0 999999999 0 999999999", "ascii", "1 2 3"),
        {"plane": "k0"},
        "TooLargeError",
        "promise",
    ),
    "VTS that bursts when it expands": ("a.vts", zlib_bomb, {}, "FormatError", "structured grids that VTK reads"),
    "VTS of a billion laughs": (
        "a.vts",
        lambda: b'<?xml version="1.0"?><!DOCTYPE a [<!ENTITY b "ha"><!ENTITY c "&b;&b;">]>' + vts("0 2 0 1 0 0"),
        {},
        "FormatError",
        "without a DOCTYPE or entities",
    ),
    "VTM of other files": (
        "a.vtm",
        lambda: b"<VTKFile type='vtkMultiBlockDataSet'><a><DataSet file='/etc/passwd'/></a></VTKFile>",
        {},
        "FormatError",
        r"a \.vtm file, which only names other files, and these are never opened",
    ),
    "VTK of 10^12 points": (
        "a.vtk",
        lambda: LEGACY.format(10**6, 10**6, 10**12, "1 2 3\n").encode(),
        {},
        "TooLargeError",
        "holds the 1,000,000,000,000 points that it promises",
    ),
    "VTK of a vast field": (
        "a.vtk",
        lambda: LEGACY.format(
            3, 2, 6, "1 2 3 " * 6 + "\nPOINT_DATA 6\nFIELD f 1\na 1000 999999999 double\n1\n"
        ).encode(),
        {},
        "FormatError",
        "expected structured grids that VTK reads",
    ),
    "VTK of 10^12 attributes": (
        "a.vtk",
        lambda: LEGACY.format(3, 2, 6, "1 2 3 " * 6 + f"\nPOINT_DATA {10**12}\nVECTORS v double\n1 2 3\n").encode(),
        {},
        "FormatError",
        "expected structured grids that VTK reads",
    ),
    "CGNS in ADF with a link": ("a.cgns", adf_with_a_link, {}, "FormatError", "got one with a link to another node or"),
    "CGNS in HDF5 with a link": ("a.cgns", bytes, {}, "FormatError", "expected structured grids that VTK reads"),
    "CGNS of nothing": (
        "a.cgns",
        lambda: b"\xc0\xa8\xa3\xa9ADF Database Version A02011>" + b"\xff" * 9999,
        {},
        "FormatError",
        "expected structured grids that VTK reads",
    ),
    "GLB": ("a.glb", lambda: b"glTF\2\0\0\0" + bytes(99), {}, "FormatError", "goes on behind its end: it says 0 bytes"),
    "STL": (
        "a.stl",
        lambda: bytes(80) + b"\xff" * 99,
        {},
        "FormatError",
        "179 bytes are not the .* of the 4,294,967,295 triangles",
    ),
}


@pytest.fixture(scope="module")
def refused(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Refusal]:
    """How each case was refused."""
    pytest.importorskip("vtkmodules")
    paths = []
    for number, (case, (name, content, options, _, _)) in enumerate(CASES.items()):
        path = tmp_path_factory.mktemp(f"case{number}") / name
        path.write_bytes(hdf5_with_a_link(path) if "HDF5" in case else content())
        paths.append((path, options))
    return dict(zip(CASES, refusals(paths), strict=True))


@pytest.mark.parametrize("case", CASES)
def test_hostile_files_are_refused_in_time_and_space(refused: dict[str, Refusal], case: str) -> None:
    _, _, _, error, message = CASES[case]
    found = refused[case]
    assert re.fullmatch(error, found.error), found
    assert re.search(message, found.message), found
    assert found.memory < 512 * MIB
    assert found.seconds < SECONDS
    assert TOLD.search(found.message)
    assert "\n" not in found.message
