"""Files that are not what they say: each is refused in one line, by an error of its own kind, without taking memory."""

from __future__ import annotations

import io
import os
import re
import socket
import struct
import tempfile
import tracemalloc
import warnings
import zipfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from lodestream import formats
from lodestream.decoding.decoder import decode
from lodestream.encoding.encode import encode
from lodestream.errors import ChoiceError, FormatError, InputError, OptionError, TooLargeError
from lodestream.surface import Surface

MIB = 1 << 20


def npy(array: Any, *, version: tuple[int, int] | None = None) -> bytes:
    file = io.BytesIO()
    np.lib.format.write_array(file, np.asarray(array), version=version)
    return file.getvalue()


def npy_header(shape: str, descr: str = "'<f8'", major: int = 1) -> bytes:
    text = f"{{'descr': {descr}, 'fortran_order': False, 'shape': {shape}, }}".encode()
    return b"\x93NUMPY" + bytes((major, 0)) + struct.pack("<H" if major == 1 else "<I", len(text)) + text


def npz(members: dict[str, bytes], compression: int = zipfile.ZIP_DEFLATED) -> bytes:
    file = io.BytesIO()
    with zipfile.ZipFile(file, "w", compression) as archive:
        for name, content in members.items():
            archive.writestr(name, content)
    return file.getvalue()


def lying_npz(promised: int, header: bytes) -> bytes:
    """Make an archive whose directory gives its one member a length that it has not."""
    content = npz({"a.npy": header})
    true = struct.pack("<I", len(header))
    assert content.count(true) >= 2
    return content.replace(true, struct.pack("<I", promised))


def tiff(bands: Any, **profile: Any) -> bytes:
    rasterio = pytest.importorskip("rasterio")
    array = np.asarray(bands)
    profile |= {"count": array.shape[0], "height": array.shape[1], "width": array.shape[2], "dtype": array.dtype}
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", rasterio.errors.NotGeoreferencedWarning)
        with rasterio.MemoryFile() as memory:
            with memory.open(driver="GTiff", **profile) as dataset:
                dataset.write(array)
            return bytes(memory.read())


#: What every refusal has: what is wrong with the file, or what was expected and not found.
TOLD = re.compile("expected.* got|this |cannot read", re.DOTALL)


def refuse(path: Path, error: type[InputError], message: str, **options: Any) -> None:
    """Check that a file is refused by exactly this class, in one line, within little memory."""
    tracemalloc.start()
    try:
        with pytest.raises(error, match=message) as caught:
            formats.read(path, **options)
        peak = tracemalloc.get_traced_memory()[1]
    finally:
        tracemalloc.stop()
    assert caught.type is error
    text = str(caught.value)
    assert text.startswith(str(path))
    assert text.isprintable()
    assert TOLD.search(text)
    assert len(text.removeprefix(str(path))) < 450
    assert peak < 4 * MIB


ONE_OF = ", not a file of a format that is read: npy, .*plot3d$"

REFUSALS: dict[str, tuple[str, Callable[[], bytes], type[InputError], str]] = {
    "empty": ("a.npy", lambda: b"", FormatError, f"this is an empty file{ONE_OF}"),
    "text named .tif": ("a.tif", lambda: b"not an image\n", FormatError, f"'not an image', though .* in .tif{ONE_OF}"),
    "web page": (
        "a.tif",
        lambda: b"\n<!DOCTYPE html>\n<p>404",
        FormatError,
        f"this is a web page, perhaps .* the file, though .*{ONE_OF}",
    ),
    "OBJ named .tif": (
        "a.tif",
        lambda: b"v 0 0 0\nv 1 1 1\nl 1 2\n",
        FormatError,
        f"this is text that begins with.*{ONE_OF}",
    ),
    "bytes": (
        "a.bin",
        lambda: b"\0\1\2\3\4\5\6\7\10",
        FormatError,
        f"the bytes 00 01 02 03.*{ONE_OF}",
    ),
    "JPEG": ("a.png", lambda: b"\xff\xd8\xff\xe0", FormatError, f"the bytes ff d8 ff e0.*{ONE_OF}"),
    "PNG": ("a.png", lambda: b"\x89PNG\r\n\x1a\n", FormatError, "a PNG that begins with its header of 33 bytes, got 8"),
    "PLY": ("a.ply", lambda: b"ply\nformat ascii 1.0\n", FormatError, "a PLY header that ends with end_header within"),
    "binary named .obj": ("a.obj", lambda: b"v 0 0 0\n\0\0", FormatError, f"begins with the bytes.*{ONE_OF}"),
    # NPY
    "truncated NPY": (
        "a.npy",
        lambda: npy(np.zeros((9, 9)))[:-1],
        FormatError,
        "this file is cut short: its header says 9 x 9 float64, 648 bytes, and 647 follow; copy it",
    ),
    "NPY and more": (
        "a.npy",
        lambda: npy(np.zeros((9, 9))) + b"x",
        FormatError,
        "behind its array: .* 648 bytes, and 649",
    ),
    "terabytes": (
        "a.npy",
        lambda: npy_header("(1000000, 1000000)"),
        TooLargeError,
        "at most .* vertices, got an array",
    ),
    "terabytes of channels": ("a.npy", lambda: npy_header("(2, 2, 1000000000000)"), TooLargeError, "at most 64 values"),
    "gigabytes": (
        "a.npy",
        lambda: npy_header("(10000, 10000)"),
        FormatError,
        "cut short: .*800,000,000 bytes, and 0 follow",
    ),
    "negative lengths": (
        "a.npy",
        lambda: npy_header("(-1, -5)"),
        FormatError,
        r"a negative length in its header, \(-1, -5\): save",
    ),
    "no lengths": (
        "a.npy",
        lambda: npy_header("None"),
        FormatError,
        "no header of version 1.0 or 2.0 .*: save it again",
    ),
    "header of code": (
        "a.npy",
        lambda: npy_header("__import__('os').getcwd()"),
        FormatError,
        "no header of version 1.0 or 2.0 .*: save it again",
    ),
    "deep header": (
        "a.npy",
        lambda: npy_header("(" * 5000),
        FormatError,
        "no header of version 1.0 or 2.0 .*: save it again",
    ),
    "long header": ("a.npy", lambda: npy_header("(2, 2)" + " " * 20000, major=2), FormatError, "no header of version"),
    "half a header": (
        "a.npy",
        lambda: npy(np.eye(3))[:20],
        FormatError,
        "no header of version 1.0 or 2.0 that can be read",
    ),
    "NPY of the future": ("a.npy", lambda: b"\x93NUMPY\x09\0" + bytes(90), FormatError, r"read \(version 9.0\): save"),
    "objects": (
        "a.npy",
        lambda: npy(np.full((2, 2), {}, object)),
        FormatError,
        "of Python objects, which are never .*: save it as",
    ),
    "strings": (
        "a.npy",
        lambda: npy([["a", "b"], ["c", "d"]]),
        FormatError,
        r"of strings \(<U1\): save it as integers, float32 or",
    ),
    "byte strings": ("a.npy", lambda: npy([[b"a", b"b"]]), FormatError, r"of byte strings \(\|S1\): save"),
    "complex numbers": ("a.npy", lambda: npy([[1j, 2], [3, 4]]), FormatError, "an array of complex numbers"),
    "booleans": ("a.npy", lambda: npy(np.eye(2, dtype=bool)), FormatError, "an array of booleans"),
    "records": ("a.npy", lambda: npy(np.zeros((2, 2), "f4,i4")), FormatError, "an array of records"),
    "dates": ("a.npy", lambda: npy(np.zeros((2, 2), "M8[s]")), FormatError, "an array of dates"),
    "half floats": (
        "a.npy",
        lambda: npy(np.zeros((2, 2), "f2")),
        FormatError,
        "of float16: save it as .* float32 or float64",
    ),
    "a vector": ("a.npy", lambda: npy(np.zeros(7)), FormatError, r"an array of shape \(7,\), .*: give it rows and"),
    "a volume": (
        "a.npy",
        lambda: npy(np.zeros((2, 2, 2, 2))),
        FormatError,
        r"an array of shape \(2, 2, 2, 2\), .*: save one slice of it",
    ),
    "one channel": (
        "a.npy",
        lambda: npy(np.zeros((2, 2, 1))),
        FormatError,
        r"an array of shape \(2, 2, 1\), .*: drop its last axis",
    ),
    "one point": ("a.npy", lambda: npy([[1.0]]), FormatError, r"of shape \(1, 1\): .* at least two points"),
    "no points": ("a.npy", lambda: npy(np.zeros((0, 5))), FormatError, r"of shape \(0, 5\): .* at least two points"),
    "all NaN": (
        "a.npy",
        lambda: npy(np.full((3, 3), np.nan)),
        InputError,
        "at least one valid point, got 3 x 3 holes",
    ),
    # NPZ
    "empty archive": ("a.npz", lambda: npz({}), FormatError, "no array of the shape .*: it holds nothing"),
    "truncated archive": (
        "a.npz",
        lambda: npz({"a.npy": npy(np.eye(9))})[:-9],
        FormatError,
        "cannot be unpacked, .* damaged or cut short .*: copy it or save it again",
    ),
    "another archive": (
        "a.npz",
        lambda: npz({"a.txt": b"hello"}),
        FormatError,
        "holds 'a.txt', not an archive of NumPy.*: unpack it",
    ),
    "no surface": (
        "a.npz",
        lambda: npz({"a.npy": npy([1.0, 2.0])}),
        FormatError,
        r"a: this is an array of shape \(2,\)",
    ),
    "objects in an archive": (
        "a.npz",
        lambda: npz({"a.npy": npy(np.full(2, {}, object))}),
        FormatError,
        "a: this is an array of Python objects, which are never",
    ),
    "no surface among several": (
        "a.npz",
        lambda: npz({"a.npy": npy([1.0, 2.0]), "b.npy": npy([[True]])}),
        FormatError,
        r"no array of the shape .*: it holds a \(2 float64\), b \(1 x 1 bool\)",
    ),
    "several surfaces": (
        "a.npz",
        lambda: npz({"a.npy": npy(np.eye(2)), "b.npy": npy(np.eye(2))}),
        ChoiceError,
        "has 2 arrays that are surfaces: choose one with array= a or b",
    ),
    "many members": (
        "a.npz",
        lambda: npz({f"{i}.npy": b"" for i in range(1001)}),
        TooLargeError,
        "at most 1000 arrays",
    ),
    "exotic packing": (
        "a.npz",
        lambda: npz({"a.npy": npy(np.eye(3))}, zipfile.ZIP_LZMA),
        FormatError,
        "'a.npy' encrypted, or packed otherwise .* numpy.savez_compressed",
    ),
    "member cut short": (
        "a.npz",
        lambda: npz({"a.npy": npy(np.eye(9))[:-8]}),
        TooLargeError,
        "damaged: 'a.npy' is cut short, with .* bytes where .* 9 x 9 float64, ",
    ),
    "member too long": ("a.npz", lambda: npz({"a.npy": npy(np.eye(9)) + b"x"}), FormatError, "'a.npy' goes on behind"),
    "bomb": ("a.npz", lambda: npz({"a.npy": npy(np.zeros((2048, 2048)))}), TooLargeError, "at most 1,000,000 vertices"),
    "bomb of a header": (
        "a.npz",
        lambda: npz({"a.npy": npy_header("(2, 2)" + " " * 32 * MIB, major=2)}),
        FormatError,
        "no header of version 1.0 or 2.0 .*: save it again",
    ),
    "lying directory": (
        "a.npz",
        lambda: lying_npz(980_000 * 320 + len(npy_header("(980000, 1, 40)")), npy_header("(980000, 1, 40)")),
        TooLargeError,
        "expands at most 2048 times, got .* bytes that promise 313,600,000",
    ),
    # GeoTIFF
    "nothing but nodata": (
        "a.tif",
        lambda: tiff(np.full((1, 2, 3), -9), nodata=-9),
        InputError,
        "at least one valid point, got 2 x 3 holes",
    ),
    "NaN in a GeoTIFF": (
        "a.tif",
        lambda: tiff(np.full((1, 2, 2), np.nan)),
        InputError,
        "at least one valid point, got 2 x 2 holes",
    ),
    "truncated GeoTIFF": (
        "a.tif",
        lambda: tiff(np.ones((1, 99, 99), np.float32))[:-2000],
        FormatError,
        "GDAL cannot read this GeoTIFF",
    ),
    "half a directory": ("a.tif", lambda: b"II*\0\x08\0\0\0\xff\xff", FormatError, "GDAL cannot read this GeoTIFF"),
    "complex GeoTIFF": ("a.tif", lambda: tiff(np.zeros((1, 2, 2), np.complex64)), FormatError, "got complex64"),
    "one pixel": ("a.tif", lambda: tiff(np.zeros((1, 1, 1), np.int16)), FormatError, "at least two points"),
    "sparse GeoTIFF": (
        "a.tif",
        lambda: tiff(np.zeros((1, 4096, 1024), np.uint8), SPARSE_OK=True, tiled=True),
        TooLargeError,
        "at most 1,000,000 vertices",
    ),
}


@pytest.mark.parametrize("case", REFUSALS)
def test_bad_files_are_refused(tmp_path: Path, case: str) -> None:
    name, content, error, message = REFUSALS[case]
    path = tmp_path / name
    path.write_bytes(content())
    limit = {} if case.startswith(("terabytes", "gigabytes")) else {"max_vertices": 1_000_000}
    refuse(path, error, message, **limit)


def test_geotiff_that_promises_far_more_than_it_holds_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "sparse.tif"
    path.write_bytes(tiff(np.zeros((1, 10000, 10000), np.uint8), SPARSE_OK=True, tiled=True))
    assert path.stat().st_size < 20_000
    refuse(path, TooLargeError, "expands at most 2048 times, got .* bytes that promise 100,000,000")


def test_a_vrt_is_refused_and_what_it_points_at_is_never_asked_for(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    rasterio = pytest.importorskip("rasterio")
    monkeypatch.setattr(rasterio, "open", lambda *_, **__: pytest.fail("GDAL was given a VRT"))
    (tmp_path / "secret.tif").write_bytes(b"II*\0" + bytes(100))
    with socket.create_server(("127.0.0.1", 0)) as server:
        server.setblocking(False)
        port = server.getsockname()[1]
        for target in (str(tmp_path / "secret.tif"), f"/vsicurl/http://127.0.0.1:{port}/secret.tif"):
            path = tmp_path / "dem.tif"
            path.write_text(
                '<VRTDataset rasterXSize="5" rasterYSize="4"><VRTRasterBand dataType="Int16" band="1"><SimpleSource>'
                f"<SourceFilename>{target}</SourceFilename></SimpleSource></VRTRasterBand></VRTDataset>"
            )
            refuse(path, FormatError, f"this is text that begins with '<VRTDataset.*{ONE_OF}")
        with pytest.raises(BlockingIOError):
            server.accept()


def test_gdal_itself_is_held_to_one_driver(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    rasterio = pytest.importorskip("rasterio")
    drivers = []
    true_open = rasterio.open

    def recording_open(path: str, **options: Any) -> Any:
        drivers.append(options["driver"])
        return true_open(path, **options)

    path = tmp_path / "a.tif"
    path.write_bytes(tiff(np.ones((1, 3, 3), np.int16)))
    monkeypatch.setattr(rasterio, "open", recording_open)
    formats.read(path)
    assert drivers == ["GTiff"]


def test_obj_names_its_first_wrong_face_and_follows_no_reference(tmp_path: Path) -> None:
    (tmp_path / "other.mtl").write_text("newmtl a")
    (tmp_path / "other.mtl").chmod(0)
    path = tmp_path / "a.obj"
    grid = "mtllib other.mtl\n" + "".join(f"v {i % 3} {i // 3} 0\n" for i in range(9))
    path.write_text(grid + "f 1 2 5 4\nf 2 3 6 5\nf 4 5 8 7\nf 5 6 9 8\n")
    assert formats.read(path).shape == (3, 3)
    path.write_text(grid + "f 1 2 5 4\nf 2 3 6 5\nf 4 5 8 7\nf 5 6 8 9\n")
    refuse(path, FormatError, "expected a grid, or a mesh that grid lines cut into .* got 4 quads in 4 blocks")
    refuse(path, TooLargeError, "expected at most 5 vertices, got", max_vertices=5)


def test_obj_stops_reading_at_the_limit(tmp_path: Path) -> None:
    path = tmp_path / "a.obj"
    path.write_text("v 0 0 0\nv 0 0 1\n" + "f 1 2 2 1\n" * 50)
    refuse(path, TooLargeError, "expected at most 20 faces, got 50 or more", max_vertices=10)
    path.write_text("v 0 0 0\nv 0 0 1\n" + "l 1 2\n" * 50)
    refuse(path, TooLargeError, "expected at most 10 segments, got more", max_vertices=10)
    path.write_bytes(b"#" * (2 * MIB))
    with pytest.raises(FormatError, match="line 1: expected a line of at most 1,048,576 bytes, got a longer one"):
        formats.read(path)


def test_folders_and_pipes_are_refused(tmp_path: Path) -> None:
    refuse(tmp_path, FormatError, "expected a regular file or the folder of a Zarr store, got another folder")
    os.mkfifo(tmp_path / "pipe")
    refuse(tmp_path / "pipe", FormatError, "expected a regular file, got a folder, a pipe or a device")


def test_options_are_checked_before_the_file_is_read(tmp_path: Path) -> None:
    path = tmp_path / "a.npy"
    path.write_bytes(npy(np.zeros(7)))
    refuse(path, OptionError, r"expected an option of format npy \(none\), got 'colour'", colour="red")


@pytest.mark.parametrize("kind", ["npy", "npz"])  # a mesh in text with fewer faces is a mesh
def test_every_prefix_is_refused(tmp_path: Path, kind: str) -> None:
    heights = np.arange(12.0).reshape(3, 4)
    file = io.BytesIO()
    if kind == "npz":
        file.write(npz({"a.npy": npy(heights)}))
    else:
        formats.write_stream(Surface(heights), kind, file)
    whole = file.getvalue()
    path = tmp_path / f"a.{kind}"
    for length in range(len(whole)):
        path.write_bytes(whole[:length])
        with pytest.raises(FormatError):
            formats.read(path)
    path.write_bytes(whole)
    assert formats.read(path).shape == (3, 4)


SEEDS = {
    "npy": npy(np.arange(12, dtype=np.int16).reshape(3, 4)),
    "npz": npz({"a.npy": npy(np.arange(12, dtype=np.int16).reshape(3, 4)), "dx.npy": npy(0.5)}),
    "obj": b"v 0 0 0\nv 1 0 0\nv 0 1 0\nv 1 1 0\nv 0 2 0\nv 1 2 0\nvt 0 0\nf 1/1 2/1 4/1 3/1\nf 3 4 -1 -2 # end\n",
}


@pytest.mark.filterwarnings("ignore::lodestream.errors.FormatWarning")  # of what is left out
@pytest.mark.parametrize("kind", [*SEEDS, "tif"])
@given(edits=st.lists(st.tuples(st.integers(0, 1 << 16), st.binary(max_size=4)), min_size=1, max_size=4))
def test_damaged_files_give_a_surface_or_a_refusal(kind: str, edits: list[tuple[int, bytes]]) -> None:
    content = tiff(np.arange(12, dtype=np.int16).reshape(1, 3, 4)) if kind == "tif" else SEEDS[kind]
    for place, patch in edits:
        place %= len(content)
        content = content[:place] + patch + content[place + len(patch) :]
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / f"a.{kind}"
        path.write_bytes(content)
        try:
            outcome: Surface | InputError = formats.read(path, max_vertices=1000)
        except InputError as error:
            outcome = error
    if isinstance(outcome, Surface):
        assert outcome.shape[0] * outcome.shape[1] <= 1000
    else:
        assert TOLD.search(str(outcome))
        assert str(outcome).isprintable()


def test_a_signalling_nan_is_a_hole_like_any_other(tmp_path: Path) -> None:
    heights = np.add.outer(np.arange(9.0), np.arange(7.0)).astype(np.float32) ** 2
    heights.view(np.uint32)[3, 3] = 0xFFA00000
    for points in (heights, np.stack([heights, heights, heights], axis=2)):
        back = decode(encode(points)).points
        assert np.array_equal(back, points, equal_nan=True)
    triangles = np.array([[i, i + 1, i + 8] for i in range(56)] + [[i, i + 8, i + 7] for i in range(56)])
    triangles = triangles[np.tile(np.arange(56) % 7 != 6, 2)]
    lines = ["ply", "format binary_little_endian 1.0", f"element vertex {heights.size}"]
    lines += [f"property float {name}" for name in "xyz"]
    lines += [f"element face {len(triangles)}", "property list uchar int vertex_indices", "end_header", ""]
    rows, columns = np.mgrid[:9, :7].astype(np.float32)
    vertices = np.stack([columns, rows, heights], axis=2).astype("<f4")
    vertices.view(np.uint32)[3, 3, 2] = 0xFFA00000
    faces = b"".join(b"\x03" + triangle.astype("<i4").tobytes() for triangle in triangles)
    path = tmp_path / "mesh.ply"
    path.write_bytes("\n".join(lines).encode() + vertices.tobytes() + faces)
    surface = formats.read(path)
    assert sorted(surface.shape) == [7, 9]
    assert np.isnan(surface.points).any(axis=2).sum() == 1


@pytest.mark.parametrize("extra", ["", "property list uchar int more\n"])
def test_a_number_that_its_float_cannot_hold_is_refused(tmp_path: Path, extra: str) -> None:
    vertices = "".join(f"{x} {1e60 if x * y else 0} {y}{' 0' if extra else ''}\n" for x in (0, 1) for y in (0, 1))
    path = tmp_path / "far.ply"
    path.write_text(
        "ply\nformat ascii 1.0\nelement vertex 4\nproperty float x\nproperty float y\nproperty float z\n"
        f"{extra}element face 1\nproperty list uchar int vertex_indices\nend_header\n{vertices}4 0 1 3 2\n"
    )
    with pytest.raises(FormatError, match="can hold"):
        formats.read(path)
