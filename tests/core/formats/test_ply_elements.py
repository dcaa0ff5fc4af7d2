"""Headers and elements of PLY files, as another library writes them and as nobody should."""

from __future__ import annotations

import tempfile
from pathlib import Path
from typing import Any

import hypothesis.extra.numpy as npst
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray
from plyfile import PlyData, PlyElement

from lodestream.errors import FormatError
from lodestream.formats.attributes import group, split
from lodestream.formats.ply.elements import Lists, read_elements
from lodestream.formats.ply.header import read_header

TYPES = ["i1", "u1", "i2", "u2", "i4", "u4", "f4", "f8"]

records = st.lists(st.sampled_from(TYPES), min_size=1, max_size=4).flatmap(
    lambda types: st.tuples(
        *[npst.arrays(code, 5, elements=npst.from_dtype(np.dtype(code), allow_nan=False)) for code in types]
    )
)


def write(path: Path, elements: list[PlyElement], order: str) -> None:
    PlyData(elements, text=not order, byte_order=order or "=").write(path)


def as_record(columns: tuple[NDArray[Any], ...]) -> NDArray[Any]:
    result = np.empty(len(columns[0]), [(f"p{index}", column.dtype) for index, column in enumerate(columns)])
    for index, column in enumerate(columns):
        result[f"p{index}"] = column
    return result


@given(
    columns=records,
    lists=st.lists(st.lists(st.integers(0, 2**31 - 1), max_size=4), min_size=5, max_size=5),
    order=st.sampled_from(("", "<", ">")),
    same=st.booleans(),
)
def test_what_another_library_writes_is_read(
    columns: tuple[NDArray[Any], ...], lists: list[list[int]], order: str, same: bool
) -> None:
    lists = [lists[0]] * 5 if same else lists
    faces = np.empty(5, [("p0", columns[0].dtype), ("indices", object)])
    faces["p0"] = columns[0]
    for row, values in enumerate(lists):
        faces["indices"][row] = np.array(values, np.int32)
    elements = [
        PlyElement.describe(as_record(columns), "vertex"),
        PlyElement.describe(faces, "face", len_types={"indices": "u1"}, val_types={"indices": "i4"}),
        PlyElement.describe(as_record(columns[:1]), "more"),
    ]
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "a.ply"
        write(path, elements, order)
        tables = read_elements(path, read_header(path))
    assert list(tables) == ["vertex", "face", "more"]
    for index, column in enumerate(columns):
        read = tables["vertex"][f"p{index}"]
        assert not isinstance(read, Lists)
        assert read.dtype == column.dtype
        np.testing.assert_allclose(read, column, rtol=1e-6 if not order else 0)  # text of float32 has few digits
    indices = tables["face"]["indices"]
    assert isinstance(indices, Lists)
    assert indices.counts.tolist() == [len(values) for values in lists]
    assert indices.values.tolist() == [value for values in lists for value in values]


HEADER = """ply
format ascii 1.0
element vertex 2
property float x
property uchar c
element face 1
property list uchar int v
end_header
"""


@pytest.mark.parametrize("order", ["ascii", "binary_little_endian", "binary_big_endian"])
@pytest.mark.parametrize("rows", [0, 1, 3])
def test_an_element_may_have_no_property(tmp_path: Path, order: str, rows: int) -> None:
    path = tmp_path / "a.ply"
    header = f"ply\nformat {order} 1.0\nelement nothing {rows}\nelement vertex 1\nproperty uchar c\nend_header\n"
    path.write_bytes(header.encode() + (b"\n" * rows + b"7\n" if order == "ascii" else b"\x07"))
    tables = read_elements(path, read_header(path))
    assert tables["nothing"] == {}
    read = tables["vertex"]["c"]
    assert not isinstance(read, Lists)
    assert read.tolist() == [7]


@pytest.mark.parametrize(
    ("header", "body", "message"),
    [
        (HEADER.replace("end_header", "end"), "", "ends with end_header within"),
        (HEADER.replace("format ascii 1.0\n", ""), "", "a line of the format, got none"),
        (HEADER.replace("ascii 1.0", "ascii 2.0"), "", "line 2: expected a line of a PLY 1.0 header"),
        (HEADER.replace("vertex 2", "vertex -2"), "", "line 3: expected a line of a PLY 1.0 header"),
        (HEADER.replace("float x", "quad x"), "", "line 4: expected a line of a PLY 1.0 header, got 'property quad x'"),
        (HEADER.replace("uchar c", "uchar x"), "", "line 5: expected properties of different names, got 'x' twice"),
        (HEADER.replace("list uchar", "list float"), "", "line 7: expected a list whose length is an integer"),
        (
            HEADER.replace("vertex 2", "vertex 2147483648"),
            "1 2\n",
            "for which at least 8,589,934,592 bytes follow it, and 4 do",
        ),
        (HEADER.replace("face", "vertex"), "1 2\n3 4\n0\n", "elements of different names"),
        (HEADER, "1 2\n3 4\n", "1 rows of face, for which at least 10 bytes follow it, and 8 do"),
        (HEADER, "1 2\n3\n1 77777\n", "line 10: expected 2 numbers of vertex, got '3'"),
        (HEADER, "1 2\n3 x\n0\n", "line 10: expected numbers of vertex, got '3 x'"),
        (HEADER, "1 2\n3 256\n0\n", "line 10: expected an integer from 0 to 255 (c) of vertex"),
        (
            HEADER.replace("property list uchar int v\n", ""),
            "1 2\n3 4\n0\n",
            "line 10: expected 0 numbers of face, got '0'",
        ),
        (HEADER, "1 2\n3 4\n3 5 6\n", "line 11: expected lists after their lengths of face"),
        (HEADER, "1 2\n3 4\n1 5 6\n", "line 11: expected 2 numbers of face"),
        (HEADER, "1 2\n3 4\n1 5e9\n", "expected v of face as integers"),
        (HEADER, "1 2\n3 4\n1 5\n7\n", "line 12: expected the end of the file after its elements, got '7'"),
    ],
)
def test_a_bad_text_is_refused_with_its_line(tmp_path: Path, header: str, body: str, message: str) -> None:
    path = tmp_path / "a.ply"
    path.write_text(header + body)
    with pytest.raises(FormatError) as refused:
        read_elements(path, read_header(path))
    assert message in str(refused.value)


BINARY = HEADER.replace("ascii", "binary_little_endian").encode()
ROWS = np.array([(1.5, 2), (3.5, 4)], [("x", "<f4"), ("c", "u1")]).tobytes()


@pytest.mark.parametrize(
    ("rows", "message"),
    [
        (ROWS + b"\x02" + bytes(4), "1 rows of face, and at row 0 4 bytes are missing"),
        (ROWS + b"\x00\x00", "the end of the file after its elements, got 1 bytes more"),
        (ROWS[:-4], "2 rows of vertex, for which at least 10 bytes follow it, and 6 do"),
    ],
)
def test_a_bad_binary_file_is_refused(tmp_path: Path, rows: bytes, message: str) -> None:
    path = tmp_path / "a.ply"
    path.write_bytes(BINARY + rows)
    with pytest.raises(FormatError, match=message):
        read_elements(path, read_header(path))


def test_lines_may_end_as_on_any_system(tmp_path: Path) -> None:
    text = HEADER.replace("element face", "comment  a b\nobj_info num_cols 3\nelement face") + "1.5 2\n3.5 4\n2 0 1"
    for end in ("\n", "\r\n", "\r"):
        path = tmp_path / "a.ply"
        path.write_bytes(text.replace("\n", end).encode())
        header = read_header(path)
        assert header.info == ("a b", "num_cols 3")
        table = read_elements(path, header)["vertex"]
        np.testing.assert_array_equal(table["x"], [1.5, 3.5])


def test_columns_become_attributes_and_columns_again() -> None:
    columns = {
        **{name: np.full(3, number, np.uint8) for number, name in enumerate(("red", "green", "blue", "alpha"))},
        "confidence": np.arange(3.0),
        **{name: np.full(3, number, np.float32) for number, name in enumerate(("nx", "ny", "nz", "s", "t"))},
        "momentum_0": np.zeros(3),
        "momentum_1": np.ones(3),
        "lone_0": np.ones(3),
        "kind_0": np.ones(3),
        "kind_1": np.ones(3, np.int8),
    }
    attributes = group(columns)
    assert {name: values.shape for name, values in attributes.items()} == {
        "color": (3, 4),
        "confidence": (3,),
        "normal": (3, 3),
        "uv": (3, 2),
        "momentum": (3, 2),
        "lone_0": (3,),
        "kind_0": (3,),
        "kind_1": (3,),
    }
    back = split(attributes)
    assert back.keys() == columns.keys()
    for name, column in columns.items():
        np.testing.assert_array_equal(back[name], column)
    assert list(split({"color": np.zeros((2, 3), np.uint8), "uv": np.zeros((2, 3))})) == [
        *("red", "green", "blue"),
        *("uv_0", "uv_1", "uv_2"),
    ]
