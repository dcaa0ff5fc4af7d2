"""Range grids in PLY and organised clouds in PCD: holes, attributes, every encoding, and what is refused."""

from __future__ import annotations

import struct
import tempfile
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray
from plyfile import PlyData, PlyElement

from lodestream import formats
from lodestream.errors import FormatError, TooLargeError

ROWS, COLUMNS = 5, 7


def scan(seed: int) -> tuple[NDArray[np.float32], NDArray[np.bool_]]:
    """Points of shape (ROWS, COLUMNS, 3) and which of them are valid."""
    random = np.random.default_rng(seed)
    valid = random.random((ROWS, COLUMNS)) < 0.7
    valid[2, 3] = True
    return random.normal(size=(ROWS, COLUMNS, 3)).astype(np.float32), valid


def write_range_grid(path: Path, seed: int, order: str, info: list[str] | None = None) -> None:
    points, valid = scan(seed)
    vertices = np.empty(int(valid.sum()), [(name, "f4") for name in ("x", "y", "z", "confidence")] + [("red", "u1")])
    for axis, name in enumerate("xyz"):
        vertices[name] = points[valid][:, axis]
    vertices["confidence"] = np.arange(len(vertices)) / 8
    vertices["red"] = np.arange(len(vertices))
    grid = np.empty(valid.size, [("vertex_indices", object)])
    numbers = np.cumsum(valid.reshape(-1)) - 1
    for place, (number, there) in enumerate(zip(numbers, valid.reshape(-1), strict=True)):
        grid["vertex_indices"][place] = np.array([number] * int(there), np.int32)
    elements = [
        PlyElement.describe(vertices, "vertex"),
        PlyElement.describe(grid, "range_grid", len_types={"vertex_indices": "u1"}, val_types={"vertex_indices": "i4"}),
    ]
    lines = [f"num_cols {COLUMNS}", f"num_rows {ROWS}"] if info is None else info
    PlyData(elements, text=not order, byte_order=order or "=", obj_info=lines).write(path)


@given(seed=st.integers(0, 2**32), order=st.sampled_from(("", "<", ">")))
def test_a_range_grid_is_read_with_its_holes_and_attributes(seed: int, order: str) -> None:
    points, valid = scan(seed)
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "scan.ply"
        write_range_grid(path, seed, order)
        surface = formats.read(path)
    assert surface.points.shape == (ROWS, COLUMNS, 3)
    assert surface.dtype == np.float32
    np.testing.assert_allclose(surface.points[valid], points[valid], rtol=0 if order else 1e-6)
    mask = np.ones_like(valid) if surface.mask is None else surface.mask
    np.testing.assert_array_equal(mask, valid)
    assert np.isnan(surface.points[~valid]).all()
    np.testing.assert_array_equal(surface.attributes["confidence"][valid], np.arange(valid.sum()) / 8)
    np.testing.assert_array_equal(surface.attributes["red"][valid], np.arange(valid.sum()))
    assert surface.metadata == {"name": "scan", "format": "ply"}


def test_a_range_grid_that_lies_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "scan.ply"
    write_range_grid(path, 3, "", ["num_rows 5"])
    with pytest.raises(FormatError, match="expected obj_info with num_cols and a whole number"):
        formats.read(path)
    write_range_grid(path, 3, "", ["num_rows 5", "num_cols 8"])
    with pytest.raises(FormatError, match="40 rows of range_grid for num_rows 5 and num_cols 8, got 35"):
        formats.read(path)
    write_range_grid(path, 3, "", ["num_rows 99999", "num_cols 99999"])
    with pytest.raises(TooLargeError, match="a range grid of 99999 x 99999"):
        formats.read(path)
    write_range_grid(path, 3, "")
    text = path.read_text()
    header, _, body = text.partition("end_header\n")
    lines = body.splitlines()
    place = next(index for index in range(len(lines) - 35, len(lines)) if lines[index].strip() != "0")
    for row, message in (("1 35", "to name vertices below"), ("2 0 1", "at most one vertex at each place")):
        changed = [*lines[:place], row, *lines[place + 1 :]]
        path.write_text(header + "end_header\n" + "\n".join(changed) + "\n")
        with pytest.raises(FormatError, match=message):
            formats.read(path)


def write_pcd(path: Path, points: NDArray[Any], data: str, **changes: str) -> None:
    """Write records of shape (rows, columns), whose fields may be of several numbers."""
    names = points.dtype.names or ()
    kinds = [points.dtype[name] for name in names]
    entries = {
        "VERSION": "0.7",
        "FIELDS": " ".join(names),
        "SIZE": " ".join(str(kind.base.itemsize) for kind in kinds),
        "TYPE": " ".join(kind.base.kind.upper() for kind in kinds),
        "COUNT": " ".join(str(kind.shape[0] if kind.shape else 1) for kind in kinds),
        "WIDTH": str(points.shape[1]),
        "HEIGHT": str(points.shape[0]),
        "VIEWPOINT": "0 0 0 1 0 0 0",
        "POINTS": str(points.size),
        "DATA": data,
    } | changes
    flat = points.reshape(-1)
    if data == "ascii":
        rows = [" ".join(repr(value) for name in names for value in row[name].reshape(-1).tolist()) for row in flat]
        content = "\n".join([*rows, ""]).encode()
    elif data == "binary":
        content = flat.tobytes()
    else:
        raw = b"".join(np.ascontiguousarray(flat[name]).tobytes() for name in names)
        packed = literal_lzf(raw)
        content = struct.pack("<II", len(packed), len(raw)) + packed + bytes(100)
    head = "".join(f"{key} {value}\n" for key, value in entries.items())
    path.write_bytes(b"# .PCD v.7 - Point Cloud Data file format\n" + head.encode() + content)


def literal_lzf(raw: bytes) -> bytes:
    """The simplest LZF data: nothing but runs of literals."""
    runs = [raw[start : start + 32] for start in range(0, len(raw), 32)]
    return b"".join(bytes([len(run) - 1]) + run for run in runs)


def cloud(seed: int) -> NDArray[Any]:
    points, valid = scan(seed)
    fields = [(name, "<f4") for name in ("x", "y", "z", "normal_x", "normal_y", "normal_z")]
    result = np.zeros(valid.shape, [*fields, ("rgb", "<u4"), ("label", "<u2"), ("hist", "<f4", (3,))])
    for axis, name in enumerate("xyz"):
        result[name] = np.where(valid, points[:, :, axis], np.nan)
        result[f"normal_{name}"] = points[:, :, axis] / 4
    result["rgb"] = 0x010203 + np.arange(valid.size).reshape(valid.shape)
    result["label"] = np.arange(valid.size).reshape(valid.shape)
    result["hist"] = points * 2
    return result


@given(seed=st.integers(0, 2**32), data=st.sampled_from(("ascii", "binary", "binary_compressed")))
def test_an_organised_cloud_is_read_with_its_holes_and_attributes(seed: int, data: str) -> None:
    points, valid = scan(seed)
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "cloud.pcd"
        write_pcd(path, cloud(seed), data)
        surface = formats.read(path)
    assert surface.dtype == np.float32
    np.testing.assert_array_equal(surface.points[valid], points[valid])
    mask = np.ones_like(valid) if surface.mask is None else surface.mask
    np.testing.assert_array_equal(mask, valid)
    assert set(surface.attributes) == {"normal", "color", "label", "hist"}
    np.testing.assert_array_equal(surface.attributes["normal"], points / 4)
    np.testing.assert_array_equal(surface.attributes["hist"], points * 2)
    assert surface.attributes["color"].dtype == np.uint8
    assert surface.attributes["color"][0, :2].tolist() == [[1, 2, 3], [1, 2, 4]]
    assert surface.attributes["label"].dtype == np.uint16
    assert surface.metadata == {"name": "cloud", "format": "pcd"}


def test_colours_packed_in_a_float_and_padding(tmp_path: Path) -> None:
    records = np.zeros((2, 3), [("x", "<f8"), ("y", "<f8"), ("_", "<u1", (7,)), ("z", "<f8"), ("rgba", "<f4")])
    records["x"] = np.arange(6).reshape(2, 3)
    records["rgba"] = np.array([0x40102030], np.uint32).view(np.float32)[0]
    for data in ("binary", "binary_compressed"):
        write_pcd(tmp_path / "a.pcd", records, data)
        surface = formats.read(tmp_path / "a.pcd")
        assert list(surface.attributes) == ["color"]
        assert surface.attributes["color"][1, 2].tolist() == [0x10, 0x20, 0x30, 0x40]
        assert surface.dtype == np.float64


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"HEIGHT": "1", "WIDTH": "35"}, "HEIGHT 1, .* which of its 35 points are neighbours: save it organised"),
        ({"WIDTH": "8"}, "itself: POINTS is 35, and WIDTH x HEIGHT is 8 x 5"),
        ({"WIDTH": "-7"}, "WIDTH and a whole number"),
        ({"WIDTH": "6", "POINTS": "30"}, "goes on behind its points: .* says 30 points, "),
        ({"TYPE": "F F F F F F U U X"}, "type I, U or F and its size, got 'hist': X 4"),
        ({"SIZE": "4 4 8 4 4 4 4 2 4"}, "x, y and z of unlike .*: save all three with TYPE F"),
        ({"COUNT": "1 1 1 1 1 1 1 1 9999999"}, "COUNT from 1 to 4096"),
        ({"FIELDS": "x y z x normal_y normal_z rgb label hist"}, "FIELDS of different names"),
        ({"FIELDS": "x y height normal_x normal_y normal_z rgb label hist"}, "no field z, only x y height .*: save it"),
        ({"FIELDS": "x y"}, "SIZE, TYPE and COUNT for each of the 2 FIELDS"),
        ({"DATA": "zipped"}, "DATA 'zipped': save the cloud as ascii or binary or binary_compressed"),
        ({"WIDTHS": "3"}, "line 7: .* has 'WIDTHS', and may have VERSION, "),
    ],
)
def test_a_header_that_lies_is_refused(tmp_path: Path, changes: dict[str, str], message: str) -> None:
    changes = {**{key: value for key, value in changes.items() if key != "WIDTHS"}}
    path = tmp_path / "a.pcd"
    write_pcd(path, cloud(1), "binary", **changes)
    if "WIDTHS" in message:
        path.write_bytes(path.read_bytes().replace(b"WIDTH ", b"WIDTHS ", 1))
    with pytest.raises(FormatError, match=message):
        formats.read(path)


def test_a_cloud_that_is_cut_or_bent_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "a.pcd"
    write_pcd(path, cloud(1), "binary")
    path.write_bytes(path.read_bytes()[:-1])
    with pytest.raises(FormatError, match=r"cut short: its header says 35 points, [\d,]+ bytes, and [\d,]+ follow"):
        formats.read(path)
    write_pcd(path, cloud(1), "ascii")
    lines = path.read_bytes().splitlines()
    for line, message in ((b"1 2 3", "line 15: expected 11 values of x y z"), (b"1 2 x" + b" 0" * 8, "got '1 2 x 0 0")):
        path.write_bytes(b"\n".join([*lines[:14], line, *lines[15:]]))
        with pytest.raises(FormatError, match=message):
            formats.read(path)
    path.write_bytes(b"\n".join(lines[:14]))
    with pytest.raises(FormatError, match="cut short: its header says 35 points, and 3 lines follow"):
        formats.read(path)
    path.write_bytes(b"# .PCD v.7\nVERSION .7\nFIELDS x y z\n")
    with pytest.raises(FormatError, match="no line DATA within 65,536 bytes: the file is cut short"):
        formats.read(path)


def test_a_compressed_cloud_that_lies_is_refused_before_memory_is_taken(tmp_path: Path) -> None:
    path = tmp_path / "bomb.pcd"
    write_pcd(path, cloud(1), "binary_compressed")
    whole = path.read_bytes()
    bomb = whole.replace(b"WIDTH 7", b"WIDTH 20000").replace(b"HEIGHT 5", b"HEIGHT 9000").replace(b"POINTS 35", b"")
    path.write_bytes(bomb)
    with pytest.raises(TooLargeError, match="expands at most 2048 times"):
        formats.read(path)
    start = whole.index(b"DATA binary_compressed\n") + len(b"DATA binary_compressed\n")
    size = struct.unpack_from("<I", whole, start)[0]
    for content, message in (
        (
            struct.pack("<II", size + 200, 42 * 35) + whole[start + 8 :],
            f"cut short: {size + 200:,} bytes .* and {size + 100:,} bytes do",
        ),
        (
            struct.pack("<II", size, 7) + whole[start + 8 :],
            "contradicts itself: .* 35 points, 1,470 bytes, and .* make 7$",
        ),
        (
            struct.pack("<II", size, 42 * 35) + b"\xff" * size,
            "LZF data that make 1,470 bytes, got ones that are damaged",
        ),
        (b"\x01", "cut short: two sizes of compressed points should follow"),
    ):
        path.write_bytes(whole[:start] + content)
        with pytest.raises(FormatError, match=message):
            formats.read(path)
