"""Files of VTK and CGNS: grids with what lies on them, read apart from this process, and what is refused."""

from __future__ import annotations

import base64
import json
import os
import signal
import struct
import subprocess
import sys
import tempfile
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray

from lodestream import formats
from lodestream.encoding.references import root_of
from lodestream.errors import FormatError, FormatWarning, InputError, OptionError, TooLargeError, UnavailableError
from lodestream.formats.vtk import grids, xml_files
from lodestream.mesh.cells import unpack_cells
from lodestream.scratch import FolderScratch, Room
from tests.examples import examples

pytest.importorskip("vtkmodules")

from vtkmodules.util.numpy_support import numpy_to_vtk
from vtkmodules.vtkCommonCore import vtkPoints
from vtkmodules.vtkCommonDataModel import vtkRectilinearGrid, vtkStructuredGrid
from vtkmodules.vtkIOLegacy import vtkRectilinearGridWriter, vtkStructuredGridWriter
from vtkmodules.vtkIOXML import vtkXMLStructuredGridWriter

DATA = Path(__file__).parents[4] / "shared" / "data"


def points_of(dims: tuple[int, int, int], dtype: str = "f8") -> NDArray[Any]:
    """Points in VTK's order, (k * j * i, 3), all different."""
    count = int(np.prod(dims))
    return (np.arange(3 * count).reshape(count, 3) / 8).astype(dtype)


def grid_of(dims: tuple[int, int, int], points: NDArray[Any], arrays: dict[str, NDArray[Any]] | None = None) -> Any:
    grid = vtkStructuredGrid()
    grid.SetDimensions(*dims)
    places = vtkPoints()
    places.SetData(numpy_to_vtk(points, deep=True))
    grid.SetPoints(places)
    for name, values in (arrays or {}).items():
        array = numpy_to_vtk(values, deep=True)
        array.SetName(name)
        cells = len(values) != len(points)
        (grid.GetCellData() if cells else grid.GetPointData()).AddArray(array)
    return grid


def write(writer: Any, grid: Any, path: Path, **settings: Any) -> None:
    writer.SetFileName(os.fspath(path))
    writer.SetInputData(grid)
    for name, value in settings.items():
        getattr(writer, name)(*([] if value is None else [value]))
    assert writer.Write() == 1


ENCODINGS: list[dict[str, Any]] = [
    {"SetDataModeToAscii": None},
    *(
        {mode: None, "SetEncodeAppendedData": encoded, compressor: None, "SetHeaderTypeToUInt64": None, order: None}
        for mode, encoded in (("SetDataModeToBinary", 0), ("SetDataModeToAppended", 0), ("SetDataModeToAppended", 1))
        for compressor in ("SetCompressorTypeToNone", "SetCompressorTypeToZLib", "SetCompressorTypeToLZ4")
        for order in ("SetByteOrderToLittleEndian", "SetByteOrderToBigEndian")
    ),
]


@pytest.mark.parametrize("encoding", range(0, len(ENCODINGS), 3))
@pytest.mark.long
def test_xml_in_every_encoding(tmp_path: Path, encoding: int) -> None:
    points = points_of((5, 4, 1), "f4" if encoding % 2 else "f8")
    arrays = {"speed": np.arange(20, dtype=np.int16), "flow": np.arange(60.0).reshape(20, 3)}
    write(vtkXMLStructuredGridWriter(), grid_of((5, 4, 1), points, arrays), tmp_path / "g.vts", **ENCODINGS[encoding])
    surface = formats.read(tmp_path / "g.vts")
    assert surface.dtype == points.dtype
    np.testing.assert_array_equal(surface.points, points.reshape(4, 5, 3))
    np.testing.assert_array_equal(surface.attributes["speed"], np.arange(20).reshape(4, 5))
    np.testing.assert_array_equal(surface.attributes["flow"], np.arange(60).reshape(4, 5, 3))
    assert surface.attributes["speed"].dtype == np.int16
    assert surface.metadata == {"name": "g", "format": "vts"}


@pytest.mark.parametrize("kind", ["SetFileTypeToASCII", "SetFileTypeToBinary"])
@pytest.mark.long
def test_legacy_structured_grid_with_named_roles(tmp_path: Path, kind: str) -> None:
    points = points_of((3, 2, 4))
    grid = grid_of((3, 2, 4), points, {"heat": np.arange(24, dtype=np.float32)})
    data = grid.GetPointData()
    for setter, values in (
        ("SetNormals", points.astype(np.float32)),
        ("SetTCoords", points[:, :2].astype(np.float32)),
        ("SetScalars", np.arange(72, dtype=np.uint8).reshape(24, 3)),
    ):
        array = numpy_to_vtk(values, deep=True)
        array.SetName(setter)
        getattr(data, setter)(array)
    write(vtkStructuredGridWriter(), grid, tmp_path / "g.vtk", **{kind: None})
    surface = formats.read(tmp_path / "g.vtk", plane="j1")
    volume = points.reshape(4, 2, 3, 3)
    np.testing.assert_array_equal(surface.points, volume[:, 1])
    np.testing.assert_array_equal(surface.attributes["normal"], volume[:, 1])
    np.testing.assert_array_equal(surface.attributes["uv"], volume[:, 1, :, :2])
    assert surface.attributes["color"].shape == (4, 3, 3)
    np.testing.assert_array_equal(surface.attributes["heat"], np.arange(24).reshape(4, 2, 3)[:, 1])
    assert surface.metadata == {"name": "g", "format": "vtk", "plane": "j1", "volumes": [[3, 2, 4]]}
    with pytest.warns(FormatWarning, match="took plane i0 of a volume of 3 x 2 x 4 points"):
        assert formats.read(tmp_path / "g.vtk").shape == (4, 2)
    with pytest.raises(OptionError, match="plane= k from -4 to 3"):
        formats.read(tmp_path / "g.vtk", plane="k4")


@pytest.mark.parametrize("plane", ["i1", "j-1", "k2"])
def test_legacy_rectilinear_grid_as_structured(tmp_path: Path, plane: str) -> None:
    grid = vtkRectilinearGrid()
    grid.SetDimensions(3, 2, 4)
    axes = [np.array([0.0, 1, 4]), np.array([5.0, 9]), np.array([-1.0, 0, 2, 7])]
    for letter, axis in zip("XYZ", axes, strict=True):
        getattr(grid, f"Set{letter}Coordinates")(numpy_to_vtk(axis, deep=True))
    write(vtkRectilinearGridWriter(), grid, tmp_path / "g.vtk", SetFileTypeToBinary=None)
    z, y, x = np.meshgrid(*axes[::-1], indexing="ij")
    volume = np.stack([x, y, z], axis=-1)
    expected = {"i1": volume[:, :, 1], "j-1": volume[:, -1], "k2": volume[2]}[plane]
    np.testing.assert_array_equal(formats.read(tmp_path / "g.vtk", plane=plane).points, expected)


def test_several_files_are_blocks(tmp_path: Path) -> None:
    for number, dims in enumerate([(3, 4, 1), (1, 5, 2)]):
        grid = grid_of(dims, points_of(dims) + number)
        write(vtkXMLStructuredGridWriter(), grid, tmp_path / f"{number}.vts")
    surface = formats.read(tmp_path / "0.vts", tmp_path / "1.vts")
    assert [block.shape for block in surface.blocks] == [(4, 3), (2, 5)]
    np.testing.assert_array_equal(surface.blocks[1].points, points_of((1, 5, 2)).reshape(2, 5, 3) + 1)
    (tmp_path / "1.vts").write_text("<VTKFile type='PolyData'></VTKFile>")
    with pytest.raises(FormatError, match=r"1\.vts: this is a VTK file of type PolyData, not StructuredGrid: "):
        formats.read(tmp_path / "0.vts", tmp_path / "1.vts")


@pytest.mark.parametrize("kind", ["ImageData", "RectilinearGrid"])
def test_images_and_rectilinear_grids_are_refused_with_what_to_do(tmp_path: Path, kind: str) -> None:
    pyvista = pytest.importorskip("pyvista")
    suffix = ".vti" if kind == "ImageData" else ".vtr"
    path = tmp_path / f"a{suffix}"
    if kind == "ImageData":
        grid = pyvista.ImageData(dimensions=(4, 3, 1))
    else:
        grid = pyvista.RectilinearGrid(np.array([0.0, 1, 3]), np.array([0.0, 2]))
    grid["heat"] = np.arange(grid.n_points)
    grid.save(path)
    with pytest.raises(FormatError, match=f"of type {kind}, not StructuredGrid: save it as .vts") as caught:
        formats.read(path)
    assert f"pyvista.read('a{suffix}').cast_to_structured_grid().save('a.vts')" in str(caught.value)
    pyvista.read(path).cast_to_structured_grid().save(tmp_path / "a.vts")  # as the advice says
    surface = formats.read(tmp_path / "a.vts")
    assert surface.shape == (grid.dimensions[1], grid.dimensions[0])
    assert list(surface.attributes) == ["heat"]


@given(seed=st.integers(0, 2**32))
@examples(5)
def test_what_is_blanked_is_a_hole(seed: int) -> None:
    random = np.random.default_rng(seed)
    rows, columns = 6, 7
    hidden_points, hidden_cells = random.random((rows, columns)) < 0.1, random.random((rows - 1, columns - 1)) < 0.4
    grid = grid_of((columns, rows, 1), points_of((columns, rows, 1)))
    for data, hidden, bit in ((grid.GetPointData(), hidden_points, 2), (grid.GetCellData(), hidden_cells, 32)):
        array = numpy_to_vtk((hidden.reshape(-1) * bit).astype(np.uint8), deep=True)
        array.SetName("vtkGhostType")
        data.AddArray(array)
    with tempfile.TemporaryDirectory() as folder:
        write(vtkXMLStructuredGridWriter(), grid, Path(folder) / "g.vts")
        surface = formats.read(Path(folder) / "g.vts")
    mask = np.ones((rows, columns), np.bool_) if surface.mask is None else surface.mask
    assert not mask[hidden_points].any()
    drawn = mask[:-1, :-1] & mask[:-1, 1:] & mask[1:, :-1] & mask[1:, 1:]
    left_out = unpack_cells(surface.metadata.get("faces", {}).get("left_out"), (rows - 1, columns - 1))
    if left_out is not None:
        assert drawn[left_out].all()
        drawn &= ~left_out
    corners = hidden_points[:-1, :-1] | hidden_points[:-1, 1:] | hidden_points[1:, :-1] | hidden_points[1:, 1:]
    np.testing.assert_array_equal(drawn, ~hidden_cells & ~corners)


def test_what_belongs_to_cells_is_left_out_with_a_warning(tmp_path: Path) -> None:
    grid = grid_of((4, 3, 1), points_of((4, 3, 1)), {"area": np.arange(6.0)})
    write(vtkXMLStructuredGridWriter(), grid, tmp_path / "g.vts")
    with pytest.warns(FormatWarning, match="left out data that do not belong to points: area"):
        assert formats.read(tmp_path / "g.vts").attributes == {}


HEAD = '<VTKFile type="StructuredGrid" version="1.0" byte_order="LittleEndian" header_type="UInt64">'
PIECE = '<StructuredGrid WholeExtent="0 2 0 1 0 0"><Piece Extent="0 2 0 1 0 0">'
POINTS = '<Points><DataArray type="Float64" NumberOfComponents="3" format="FORMAT">TEXT</DataArray></Points>'
TAIL = "</Piece></StructuredGrid></VTKFile>"
RAW = points_of((3, 2, 1)).tobytes()


def in_base64(said: int, content: bytes = RAW) -> str:
    return base64.b64encode(struct.pack("<Q", said) + content).decode()


def vts(text: str, form: str = "binary") -> bytes:
    return (HEAD + PIECE + POINTS.replace("FORMAT", form).replace("TEXT", text) + TAIL).encode()


def appended(said: int, offset: int = 0, encoding: str = "raw") -> bytes:
    points = POINTS.replace('"FORMAT"', f'"appended" offset="{offset}"').replace("TEXT", "")
    body = HEAD + PIECE + points + TAIL.replace("</VTKFile>", f'<AppendedData encoding="{encoding}">_')
    return body.encode() + struct.pack("<Q", said) + RAW + b"</AppendedData></VTKFile>"


def compressed(count: int, length: int, last: int) -> bytes:
    head = base64.b64encode(struct.pack("<4Q", count, length, last, 20)).decode()
    content = vts(head + base64.b64encode(RAW).decode())
    return content.replace(b"header_type", b'compressor="vtkZLibDataCompressor" header_type')


def test_a_file_by_hand_is_read(tmp_path: Path) -> None:
    ascii_text = " ".join(map(repr, points_of((3, 2, 1)).reshape(-1).tolist()))
    for content in (vts(in_base64(len(RAW))), vts(ascii_text, "ascii"), appended(len(RAW))):
        (tmp_path / "g.vts").write_bytes(content)
        np.testing.assert_array_equal(formats.read(tmp_path / "g.vts").points, points_of((3, 2, 1)).reshape(2, 3, 3))


@pytest.mark.parametrize(
    ("content", "message"),
    [
        (vts(in_base64(1 << 40)), "144 bytes by its extent and type, got a header that says 1,099,511,627,776"),
        (vts("AAAA"), "inside the file, got none there"),
        (vts("1 2 x", "ascii"), "expected structured grids that VTK reads"),
        (vts("", "elsewhere"), "as ascii, binary or appended, got 'elsewhere'"),
        (appended(1 << 60), "144 bytes by its extent and type, got a header that says"),
        (appended(144, offset=1 << 40), "inside the file, got none there"),
        (appended(144)[:400], "expected array .* of at least 152 bytes, got"),
        (compressed(1 << 50, 1 << 20, 0), "144 bytes by its extent and type, got a header that says"),
        (compressed(1 << 40, 0, 144), "array .* of at least .* bytes, got"),
        (vts("").replace(b'"0 2 0 1 0 0"', b'"0 2 0 1 0 -1"', 1), "extent from lower to higher"),
        (vts("").replace(b'"0 2 0 1 0 0"', b'"0 1 0 1 0 0"', 1), "pieces inside the WholeExtent"),
        (vts("").replace(b"Float64", b"String"), "of a type of VTK and 1 to 99999 components, got 'String'"),
        (vts("").replace(b'Components="3"', b'Components="-3"'), "1 to 99999 components, got .* '-3'"),
        (HEAD.encode() + b"</VTKFile>", "a WholeExtent and a Piece, got none"),
        (HEAD.replace("StructuredGrid", "PolyData").encode() + b"</VTKFile>", "of type PolyData, not StructuredGrid"),
        (b"<?xml version='1.0'?>" + HEAD.encode() + b"<a>", "XML file of VTK, got no element|got mismatched|unclosed"),
        (b"<?xml version='1.0'?><!DOCTYPE a [<!ENTITY b 'c'>]>" + HEAD.encode(), "XML without a DOCTYPE"),
        (
            b"<VTKFile type='vtkMultiBlockDataSet'><vtkMultiBlockDataSet><DataSet file='/etc/passwd'/>",
            r"no element found|a \.vtm file, which only names other files, and these are never opened",
        ),
        (
            b"<VTKFile type='vtkMultiBlockDataSet'><vtkMultiBlockDataSet><DataSet index='0' file='a.vts'/>"
            b"</vtkMultiBlockDataSet></VTKFile>",
            r"a \.vtm file, which only names other files, and these are never opened: give its \.vts files together, "
            r"one for each block, as in lodestream.read",
        ),
    ],
)
def test_an_xml_file_that_lies_is_refused(tmp_path: Path, content: bytes, message: str) -> None:
    (tmp_path / "g.vts").write_bytes(content)
    with pytest.raises(FormatError, match=message):
        formats.read(tmp_path / "g.vts")


_GRID = {
    "dims": [3, 2, 1],
    "arrays": [{"role": "points", "name": "", "dtype": "<f8", "shape": [6, 3]}],
    "left_out": [],
    "words": {},
}
_BEGUN = f"print({json.dumps({'grids': [_GRID]})!r}, flush=True)"

_SIGNALS = ["SIGKILL", "SIGTERM", "SIGXCPU", "SIGABRT", "SIGSEGV", "SIGBUS"]
_DEATHS = {
    **{
        name: (f"os.kill(os.getpid(), signal.{name})", signal.strsignal(getattr(signal, name)))
        for name in _SIGNALS
        if sys.platform != "win32"
    },
    "no memory": ("raise MemoryError", "exit code 1"),
    "no word": ("pass", "exit code 0"),
    "half a line": ("sys.stdout.write('{')", "exit code 0"),
    "no points": (_BEGUN, "exit code 0"),
    "half the points": (f"{_BEGUN}; sys.stdout.buffer.write(bytes(70)); sys.stdout.flush(); os.abort()", "Aborted"),
}


@pytest.mark.parametrize(("death", "words"), _DEATHS.values(), ids=_DEATHS)
def test_a_reader_that_ends_has_not_refused_the_file(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, death: str, words: str
) -> None:
    script, path = tmp_path / "reader.py", tmp_path / "a.vts"
    script.write_text(f"import os, signal, sys\n{death}\n")
    path.write_bytes(vts(in_base64(len(RAW))))
    monkeypatch.setattr(grids, "_SCRIPT", script)
    with pytest.raises(UnavailableError, match=rf"ended before it had answered \({words}\); it may take \d+ MiB and"):
        formats.read(path)


def _raw(path: Path, order: str) -> None:
    """A volume with every kind of point data, and data of cells, appended as bytes."""
    dims = (7, 5, 4)
    count = 7 * 5 * 4
    ghosts = np.zeros(count, np.uint8)
    ghosts[::9] = 2
    arrays: dict[str, NDArray[Any]] = {
        "speed": np.arange(count, dtype=np.int16),
        "kind": np.arange(count * 2, dtype=np.uint32).reshape(count, 2),
        "up": points_of(dims, "f4"),
        "place": points_of(dims, "f4")[:, :2].copy(),
        "paint": (points_of(dims) % 256).astype(np.uint8),
        "vtkGhostType": ghosts,
        "area": np.arange(6.0 * 4 * 3),
    }
    grid = grid_of(dims, points_of(dims, "f4"), arrays)
    data = grid.GetPointData()
    data.SetActiveNormals("up")
    data.SetActiveTCoords("place")
    data.SetActiveScalars("paint")
    told: dict[str, Any] = {"SetDataModeToAppended": None, "SetEncodeAppendedData": 0, "SetCompressorTypeToNone": None}
    write(vtkXMLStructuredGridWriter(), grid, path, **told, **{order: None})


@pytest.mark.parametrize("plane", ["i0", "j2,k-1", "k1"])
@pytest.mark.parametrize("order", ["SetByteOrderToLittleEndian", "SetByteOrderToBigEndian"])
@pytest.mark.filterwarnings("ignore::lodestream.FormatWarning")
@pytest.mark.long
def test_what_is_mapped_is_what_vtk_reads(
    tmp_path: Path, plane: str, order: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    _raw(tmp_path / "g.vts", order)
    room = Room(lambda: FolderScratch(tmp_path / "room"), 1)
    with monkeypatch.context() as context:
        context.setattr(grids, "_SCRIPT", None)  # VTK is not asked
        found = formats.read(tmp_path / "g.vts", plane=plane, room=room)
    monkeypatch.setattr(xml_files, "_mapped", lambda *_: None)
    expected = formats.read(tmp_path / "g.vts", plane=plane)
    assert found.metadata == expected.metadata
    for one, other in zip(found.blocks, expected.blocks, strict=True):
        assert one.points.dtype == other.points.dtype
        np.testing.assert_array_equal(one.points, other.points)
        assert one.holes == other.holes
        assert set(one.attributes) == {"speed", "kind", "normal", "uv", "color"}
        assert list(one.attributes) == list(other.attributes)
        for name, values in one.attributes.items():
            assert values.dtype == other.attributes[name].dtype
            np.testing.assert_array_equal(values, other.attributes[name])
            assert root_of(values) is not None


@pytest.mark.parametrize(
    "changed", [(b'"area"', b'"vtkGhostType"'), (b"Float32", b"Int32"), (b'"kind"', b'"speed"'), (b'"kind"', b'""')]
)
def test_what_cannot_be_mapped_is_left_to_vtk(tmp_path: Path, changed: tuple[bytes, bytes]) -> None:
    _raw(tmp_path / "g.vts", "SetByteOrderToLittleEndian")
    content = (tmp_path / "g.vts").read_bytes()
    assert xml_files._checked(tmp_path / "g.vts")[2] is not None
    (tmp_path / "g.vts").write_bytes(content.replace(*changed))
    assert xml_files._checked(tmp_path / "g.vts")[2] is None


def test_what_vtk_reads_is_refused_with_its_memory(tmp_path: Path) -> None:
    dims = (300, 200, 1)
    write(vtkXMLStructuredGridWriter(), grid_of(dims, points_of(dims)), tmp_path / "g.vts")
    expected = r"at most 1 MiB to read by VTK, got one that takes about 5 MiB: only \.vts of one piece, uncompressed"
    with pytest.raises(TooLargeError, match=expected):
        formats.read(tmp_path / "g.vts", room=Room(memory=1 << 20))
    assert formats.read(tmp_path / "g.vts", room=Room(memory=8 << 20)).shape == (200, 300)


def test_an_xml_file_that_promises_too_much_is_refused(tmp_path: Path) -> None:
    content = compressed(1, 3 * 8 * 20001 * 20001, 0).replace(b'"0 2 0 1 0 0"', b'"0 20000 0 20000 0 0"')
    (tmp_path / "g.vts").write_bytes(content)
    with pytest.raises(TooLargeError, match="expands at most 2048 times"):
        formats.read(tmp_path / "g.vts")


LEGACY = (
    "# vtk DataFile Version 3.0\nx\nASCII\nDATASET STRUCTURED_GRID\nDIMENSIONS 3 2 1\nPOINTS 6 float\n" + "0 1 2 " * 6
)


@pytest.mark.parametrize(
    ("text", "error", "message"),
    [
        (
            LEGACY.replace("STRUCTURED_GRID", "POLYDATA"),
            FormatError,
            "has POLYDATA, and may have STRUCTURED_GRID or RECTILINEAR_GRID: save it as",
        ),
        (LEGACY.replace("DATASET", "DATA"), FormatError, "has no DATASET, and may have"),
        (
            LEGACY.replace("POINTS 6", "POINTS 6000000000"),
            TooLargeError,
            "holds the 6,000,000,000 points that it promises",
        ),
        (
            LEGACY.replace("3 2 1", "3 2 5"),
            FormatError,
            "expected structured grids that VTK reads|values of the points",
        ),
        (LEGACY[:-20], FormatError, "expected structured grids that VTK reads"),
        (
            LEGACY + "\nPOINT_DATA 6\nFIELD F 1\na 1000000 100000000 double\n1 2 3\n",
            FormatError,
            "expected structured grids that VTK reads|expected 6 values of a|a grid with points, got none",
        ),
        (
            LEGACY + "\nPOINT_DATA 60000000000\nSCALARS a double\nLOOKUP_TABLE default\n1\n",
            FormatError,
            "expected struc",
        ),
        (LEGACY.replace("0 1 2", "nan nan nan"), InputError, "at least one valid point|that VTK reads"),
    ],
)
@pytest.mark.long
def test_a_legacy_file_that_lies_is_refused(tmp_path: Path, text: str, error: type[InputError], message: str) -> None:
    (tmp_path / "g.vtk").write_text(text)
    with pytest.raises(error, match=message):
        formats.read(tmp_path / "g.vtk", plane="k0")


def write_cgns(path: Path, zones: list[NDArray[Any]]) -> None:
    """Write zones of shape (rows, columns, 3) as CGNS on HDF5 keeps them."""
    h5py = pytest.importorskip("h5py")

    def text(value: str, length: int) -> Any:
        return np.array(value.ljust(length, "\0").encode(), f"S{length}")

    def node(parent: Any, name: str, label: str, data: Any = None) -> Any:
        group = parent.create_group(name, track_order=True)
        codes = {"i4": "I4", "i8": "I8", "f4": "R4", "f8": "R8", "i1": "C1"}
        values = None if data is None else np.asarray(data)
        group.attrs["name"], group.attrs["label"] = text(name, 33), text(label, 33)
        group.attrs["type"] = text("MT" if values is None else codes[values.dtype.str[1:]], 3)
        group.attrs["flags"] = np.array([1], np.int32)
        if values is not None:
            group.create_dataset(" data", data=values)
        return group

    with h5py.File(path, "w", track_order=True) as file:
        file.attrs["name"], file.attrs["label"] = text("HDF5 MotherNode", 33), text("Root Node of HDF5 File", 33)
        file.attrs["type"] = text("MT", 3)
        file.create_dataset(" format", data=np.frombuffer(b"IEEE_LITTLE_32\0", np.int8))
        file.create_dataset(" hdf5version", data=np.frombuffer(b"HDF5 Version 1.8.11".ljust(33, b"\0"), np.int8))
        node(file, "CGNSLibraryVersion", "CGNSLibraryVersion_t", np.array([3.3], np.float32))
        base = node(file, "Base", "CGNSBase_t", np.array([2, 3], np.int32))
        for number, points in enumerate(zones, 1):
            rows, columns = points.shape[:2]
            sizes = np.array([[columns, rows], [columns - 1, rows - 1], [0, 0]], np.int32)
            zone = node(base, f"Zone{number}", "Zone_t", sizes)
            node(zone, "ZoneType", "ZoneType_t", np.frombuffer(b"Structured", np.int8))
            coordinates = node(zone, "GridCoordinates", "GridCoordinates_t")
            for axis, letter in enumerate("XYZ"):
                node(coordinates, f"Coordinate{letter}", "DataArray_t", points[:, :, axis])
            solution = node(zone, "FlowSolution", "FlowSolution_t")
            node(solution, "GridLocation", "GridLocation_t", np.frombuffer(b"Vertex", np.int8))
            node(solution, "Pressure", "DataArray_t", points[:, :, 0] * 2)


def test_zones_of_cgns_on_hdf5_are_blocks(tmp_path: Path) -> None:
    zones = [points_of((4, 3, 1)).reshape(3, 4, 3), points_of((2, 5, 1)).reshape(5, 2, 3) + 1000]
    write_cgns(tmp_path / "g.cgns", zones)
    surface = formats.read(tmp_path / "g.cgns")
    assert len(surface.blocks) == 2
    for block, points in zip(surface.blocks, zones, strict=True):
        np.testing.assert_array_equal(block.points, points)
        np.testing.assert_array_equal(block.attributes["Pressure"], points[:, :, 0] * 2)


def test_cgns_follows_no_link_to_another_file(tmp_path: Path) -> None:
    h5py = pytest.importorskip("h5py")
    write_cgns(tmp_path / "other.cgns", [points_of((4, 3, 1)).reshape(3, 4, 3)])
    write_cgns(tmp_path / "g.cgns", [points_of((4, 3, 1)).reshape(3, 4, 3)])
    with h5py.File(tmp_path / "g.cgns", "r+") as file:
        coordinates = file["Base/Zone1/GridCoordinates"]
        label = coordinates["CoordinateX"].attrs["label"]
        del coordinates["CoordinateX"]
        link = coordinates.create_group("CoordinateX")
        link.attrs["name"], link.attrs["label"] = np.bytes_(b"CoordinateX".ljust(33, b"\0")), label
        link.attrs["type"] = np.array(b"LK\0", "S3")
        target = "/Base/Zone1/GridCoordinates/CoordinateX"
        link.create_dataset(" file", data=np.frombuffer(b"other.cgns\0", np.int8))
        link.create_dataset(" path", data=np.frombuffer(target.encode() + b"\0", np.int8))
        link[" link"] = h5py.ExternalLink(os.fspath(tmp_path / "other.cgns"), target)
    with pytest.raises(FormatError, match=r"what it cannot read \(links to other files are never followed\)"):
        formats.read(tmp_path / "g.cgns")


def test_cgns_on_adf_with_a_link_is_refused(tmp_path: Path) -> None:
    real = DATA / "corner.cgns"
    if not real.exists():
        pytest.skip("the real file corner.cgns is not beside this project")
    content = bytearray(real.read_bytes())
    node = content.rindex(b"NoDe")
    content[node + 96 : node + 98] = b"LK"
    (tmp_path / "g.cgns").write_bytes(content)
    with pytest.raises(FormatError, match="got one with a link to another node or file"):
        formats.read(tmp_path / "g.cgns")
    (tmp_path / "g.cgns").write_bytes(real.read_bytes()[:31000])
    with pytest.raises(FormatError, match="a CGNS file of at least 31,060 bytes by its header, got 31,000"):
        formats.read(tmp_path / "g.cgns")


# Reads a file confined as a server's build is, perhaps by another script, and prints what came of it.
_CONFINED = """
import sys
from pathlib import Path
from lodestream import formats
from lodestream.confinement import Rights, confine, landlock
from lodestream.formats.vtk import grids
path, script = map(Path, sys.argv[1:3])
mine = (path,)
if sys.argv[3] == "without":
    landlock.restrict = lambda *_: False
if script.name != "process.py":
    grids._SCRIPT, grids._LAST_SECONDS = script, 0.1
    mine += (script,)
confine(Rights(read=mine, processes=True))
try:
    print(formats.read(path).points.shape)
except Exception as error:
    print(type(error).__name__, error)
"""


def read_confined(path: Path, script: Path, landlock: str) -> str:
    """What comes of reading a file in a process that may signal no other."""
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join(filter(None, sys.path)), "OPENBLAS_NUM_THREADS": "1"}
    command = [sys.executable, "-c", _CONFINED, os.fspath(path), os.fspath(script), landlock]
    return subprocess.run(command, env=environment, capture_output=True, text=True, check=True).stdout.strip()


@pytest.mark.skipif(sys.platform != "linux", reason="only Linux confines")
@pytest.mark.parametrize("landlock", ["with", "without"])
@pytest.mark.long
def test_who_reads_confined_needs_no_signal(tmp_path: Path, landlock: str) -> None:
    grid = grid_of((4, 3, 1), points_of((4, 3, 1)))
    path = tmp_path / "g.vtk"
    write(vtkStructuredGridWriter(), grid, path)
    assert read_confined(path, grids._SCRIPT, landlock) == "(3, 4, 3)"
    # A reader that a file has taken over may stay as long as it likes: nobody waits for it.
    stays = tmp_path / "stays.py"
    stays.write_text(
        "import ctypes, time\nctypes.CDLL(None).prctl(1, 9)\n"
        'print(\'{"error": "stays"}\', flush=True)\ntime.sleep(36_000)\n'
    )
    assert read_confined(path, stays, landlock).endswith("that VTK reads, got stays")
