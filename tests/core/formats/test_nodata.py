"""`nodata=`: a value marks holes though the file does not say so, whatever reads the file, and a note says how many."""

from __future__ import annotations

import struct
import warnings
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray

import lodestream as ls
from lodestream.encoding.reading import read_into
from lodestream.errors import FormatError, FormatWarning, InputError, OptionError
from lodestream.formats.nodata import checked, with_nodata
from lodestream.scratch import IN_MEMORY

Array = NDArray[Any]


def heights(dtype: str = "float32") -> tuple[Array, NDArray[np.bool_]]:
    """Heights with -9999 at some points, and where these are not."""
    rows, columns = np.mgrid[0:12, 0:17]
    values = np.rint(100 + 20 * np.sin(columns / 3) * np.cos(rows / 4)).astype(dtype)
    valid = (columns > 2) | (rows > 8)
    values[~valid] = -9999
    return values, valid


def notes_of(read: Callable[[], ls.Surface]) -> tuple[ls.Surface, list[str]]:
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always", FormatWarning)
        surface = read()
    return surface, [str(warning.message) for warning in caught if warning.category is FormatWarning]


def write_npy(path: Path, values: Array) -> None:
    np.save(path, values)


def write_npz(path: Path, values: Array) -> None:
    np.savez(path, height=values)


def write_tiff(path: Path, values: Array) -> None:
    rasterio = pytest.importorskip("rasterio")
    place = rasterio.Affine(10, 0, 100, 0, -10, 200)
    shape = {"height": values.shape[0], "width": values.shape[1]}
    with rasterio.open(path, "w", driver="GTiff", count=1, dtype=values.dtype, transform=place, **shape) as file:
        file.write(values, 1)


def write_ascii(path: Path, values: Array) -> None:
    pytest.importorskip("rasterio")
    head = f"ncols {values.shape[1]}\nnrows {values.shape[0]}\nxllcorner 0\nyllcorner 0\ncellsize 1\n"
    path.write_text(head + "\n".join(" ".join(f"{value:g}" for value in row) for row in values) + "\n")


def write_text(path: Path, values: Array) -> None:
    np.savetxt(path, values, fmt="%g")


def write_netcdf(path: Path, values: Array) -> None:
    xarray = pytest.importorskip("xarray")
    pytest.importorskip("h5netcdf")
    encoding = {"z": {"_FillValue": None}}
    xarray.Dataset({"z": (("y", "x"), values)}).to_netcdf(path, engine="h5netcdf", encoding=encoding)


WRITERS: dict[str, Callable[[Path, Array], None]] = {
    "a.npy": write_npy,
    "a.npz": write_npz,
    "a.tif": write_tiff,
    "a.asc": write_ascii,
    "a.txt": write_text,
    "a.nc": write_netcdf,
}


@pytest.mark.parametrize("dtype", ["float32", "int16"])
@pytest.mark.parametrize("name", WRITERS)
def test_every_reader_of_heights_takes_it(tmp_path: Path, name: str, dtype: str) -> None:
    values, valid = heights(dtype)
    WRITERS[name](tmp_path / name, values)
    plain, _ = notes_of(lambda: ls.read(tmp_path / name))
    assert plain.mask is None
    surface, notes = notes_of(lambda: ls.read(tmp_path / name, nodata=-9999))
    np.testing.assert_array_equal(surface.mask, valid)
    np.testing.assert_array_equal(surface.points[valid], plain.points[valid])
    assert surface.dtype == plain.dtype
    assert surface.metadata["nodata"] == -9999
    assert f"nodata=-9999 masks {(~valid).sum()} of {valid.size} points" in notes
    decoded = ls.decode(ls.encode(surface))
    np.testing.assert_array_equal(decoded.mask, valid)


@pytest.mark.parametrize("name", ["a.npy", "a.tif", "a.nc"])
def test_a_file_that_is_read_into_files_gets_the_same_holes(tmp_path: Path, name: str) -> None:
    values, valid = heights()
    WRITERS[name](tmp_path / name, values)
    surface, notes = notes_of(
        lambda: read_into(tmp_path / "room", [tmp_path / name], 1 << 20, nodata="-9999")  # as the command line has it
    )
    np.testing.assert_array_equal(surface.mask, valid)
    assert len([note for note in notes if note.startswith("nodata=-9999 masks ")]) == 1
    again, _ = notes_of(lambda: read_into(tmp_path / "room", [tmp_path / name], 1 << 20, nodata="-9999"))
    np.testing.assert_array_equal(again.mask, valid)
    other, _ = notes_of(lambda: read_into(tmp_path / "room", [tmp_path / name], 1 << 20))
    assert other.mask is None


def test_holes_that_the_file_declares_stay(tmp_path: Path) -> None:
    rasterio = pytest.importorskip("rasterio")
    values, valid = heights()
    values[0, 10] = -32768
    write_tiff(tmp_path / "a.tif", values)
    with rasterio.open(tmp_path / "a.tif", "r+") as file:
        file.nodata = -32768
    surface, _ = notes_of(lambda: ls.read(tmp_path / "a.tif", nodata=-9999))
    valid[0, 10] = False
    np.testing.assert_array_equal(surface.mask, valid)
    assert surface.metadata["nodata"] == -32768
    _, notes = notes_of(lambda: ls.read(tmp_path / "a.tif", nodata=-32768))
    assert notes == ["nodata=-32768 masks nothing more: 1 of 204 points has this value and is a hole"]


@pytest.mark.parametrize(
    ("value", "dtype"), [(-12345, "float32"), (1e300, "float32"), (0.5, "int16"), (70000, "int16"), (-1, "uint8")]
)
def test_a_value_that_occurs_nowhere_is_said(tmp_path: Path, value: float, dtype: str) -> None:
    np.save(tmp_path / "a.npy", np.arange(12).reshape(3, 4).astype(dtype))
    surface, notes = notes_of(lambda: ls.read(tmp_path / "a.npy", nodata=value))
    assert surface.mask is None
    assert "nodata" not in surface.metadata
    assert notes == [f"nodata={value} masks nothing: none of 12 points has this value"]


@pytest.mark.parametrize(
    ("values", "nodata"),
    [
        (np.array([[0.1, 1], [2, 3]], np.float32), "0.1"),
        (np.array([[2**63 - 1, 2**63 - 2], [1, 2]], np.int64), 2**63 - 1),
        (np.array([[-3.4028235e38, 1], [2, 3]], np.float32), "-3.4028235e+38"),
        (np.array([[-3.4028234663852886e38, 1], [2, 3]], np.float32), -3.4028234663852886e38),
    ],
)
def test_values_are_compared_in_their_own_type(tmp_path: Path, values: Array, nodata: float | str) -> None:
    np.save(tmp_path / "a.npy", values)
    surface, notes = notes_of(lambda: ls.read(tmp_path / "a.npy", nodata=nodata))
    np.testing.assert_array_equal(surface.mask, [[False, True], [True, True]])
    assert notes == [f"nodata={checked(nodata)} masks 1 of 4 points"]


def test_nan_and_infinity_are_values_too(tmp_path: Path) -> None:
    np.save(tmp_path / "a.npy", np.array([[np.nan, 1], [-np.inf, 3]]))
    surface, notes = notes_of(lambda: ls.read(tmp_path / "a.npy", nodata="nan"))
    np.testing.assert_array_equal(surface.mask, [[False, True], [False, True]])
    assert notes == ["nodata=nan masks nothing more: 1 of 4 points has this value and is a hole"]
    _, notes = notes_of(lambda: ls.read(tmp_path / "a.npy", nodata=-np.inf))
    assert notes == ["nodata=-inf masks nothing more: 1 of 4 points has this value and is a hole"]


@pytest.mark.parametrize("value", ["high", "", "1,5", True, "0x10"])
def test_what_is_no_number_is_refused(tmp_path: Path, value: object) -> None:
    np.save(tmp_path / "a.npy", np.arange(12.0).reshape(3, 4))
    with pytest.raises(OptionError, match="nodata must be a number or nan, and is"):
        ls.read(tmp_path / "a.npy", nodata=value)  # type: ignore[arg-type]


def test_a_surface_of_nothing_but_holes_is_refused(tmp_path: Path) -> None:
    np.save(tmp_path / "a.npy", np.zeros((3, 4)))
    with pytest.raises(InputError, match=r"a\.npy: expected at least one valid point"):
        ls.read(tmp_path / "a.npy", nodata=0)


def scan() -> tuple[Array, NDArray[np.bool_]]:
    """Points of a depth camera, 0 0 0 where it measured nothing, and where it did; some others have a z of 0."""
    rows, columns = np.mgrid[0:9, 0:11]
    points = np.stack((columns - 5.0, rows - 4.0, 2 + np.cos(rows * columns)), axis=-1)
    valid = (rows + columns) % 4 > 0
    points[~valid] = 0
    points[3, 3, 2] = 0
    assert valid[3, 3]
    return points.astype(np.float32), valid


def write_pcd(path: Path, points: Array) -> None:
    rows, columns = points.shape[:2]
    head = f"VERSION 0.7\nFIELDS x y z\nSIZE 4 4 4\nTYPE F F F\nCOUNT 1 1 1\nWIDTH {columns}\nHEIGHT {rows}\n"
    head += f"VIEWPOINT 0 0 0 1 0 0 0\nPOINTS {rows * columns}\nDATA binary\n"
    path.write_bytes(head.encode() + points.astype("<f4").tobytes())


def write_range_grid(path: Path, points: Array) -> None:
    rows, columns = points.shape[:2]
    head = f"ply\nformat binary_little_endian 1.0\nobj_info num_cols {columns}\nobj_info num_rows {rows}\n"
    head += f"element vertex {rows * columns}\nproperty float x\nproperty float y\nproperty float z\n"
    head += f"element range_grid {rows * columns}\nproperty list uchar int vertex_indices\nend_header\n"
    cells = b"".join(struct.pack("<Bi", 1, number) for number in range(rows * columns))
    path.write_bytes(head.encode() + points.astype("<f4").tobytes() + cells)


@pytest.mark.parametrize(
    ("name", "write"),
    [("a.pcd", write_pcd), ("a.ply", write_range_grid), ("a.npy", lambda path, it: np.save(path, it))],
)
def test_zero_points_of_depth_cameras(tmp_path: Path, name: str, write: Callable[[Path, Array], None]) -> None:
    points, valid = scan()
    write(tmp_path / name, points)
    surface, notes = notes_of(lambda: ls.read(tmp_path / name, nodata=0))
    np.testing.assert_array_equal(surface.mask, valid)
    np.testing.assert_array_equal(surface.points[valid], points[valid])
    assert f"nodata=0 masks {(~valid).sum()} of {valid.size} points" in notes
    decoded = ls.decode(ls.encode(surface))
    np.testing.assert_array_equal(decoded.points[valid], points[valid])
    assert np.isnan(decoded.points[~valid]).all()


@pytest.mark.parametrize("dtype", ["float64", "int32"])
def test_heights_over_coordinates_lose_their_z_only(dtype: str) -> None:
    rows, columns = np.mgrid[0:9, 0:11]
    points = np.stack((columns * 3 + rows, rows * 2 - columns, rows + columns), axis=-1).astype(dtype)
    valid = (rows * columns) % 5 > 0
    points[~valid, 2] = -9999
    before = points.copy()
    surface, notes = notes_of(lambda: with_nodata(ls.Surface(points), -9999, IN_MEMORY))
    np.testing.assert_array_equal(surface.mask, valid)
    np.testing.assert_array_equal(points, before)
    assert notes == [f"nodata=-9999 masks {(~valid).sum()} of {valid.size} points"]
    if dtype == "float64":
        decoded = ls.decode(ls.encode(surface))
        np.testing.assert_array_equal(decoded.points[..., :2], before[..., :2])
        assert np.isnan(decoded.points[~valid, 2]).all()


def test_all_blocks_are_looked_at() -> None:
    first, second = np.arange(12.0).reshape(3, 4), np.arange(6.0).reshape(2, 3)
    given = ls.Surface(blocks=[ls.Block(first, attributes={"n": first}), ls.Block(second, attributes={"n": second})])
    surface, notes = notes_of(lambda: with_nodata(given, 5, IN_MEMORY))
    assert [block.holes for block in surface.blocks] == [1, 1]
    assert surface.blocks[0].attributes["n"][1, 1] == 5
    assert notes == ["nodata=5 masks 2 of 18 points"]


def test_it_is_no_option_of_a_format_and_takes_no_other(tmp_path: Path) -> None:
    (tmp_path / "a.png").write_bytes(b"\xff\xd8\xff\xe0")
    with pytest.raises(FormatError, match="not a file of a format that is read"):
        ls.read(tmp_path / "a.png", nodata=0)


@given(st.one_of(st.integers(-(10**19), 10**19), st.floats()))
def test_numbers_and_their_texts_are_the_same(value: float) -> None:
    number = checked(str(value))
    assert number == value or (number != number and value != value)
    assert type(number) is type(value)
    assert str(checked(number)) == str(number)
