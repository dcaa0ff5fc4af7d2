"""PLOT3D: every layout, found from the size of the file alone or refused, and what lies in it."""

from __future__ import annotations

import struct
import tempfile
import warnings
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import event, given
from hypothesis import strategies as st
from numpy.typing import NDArray

from lodestream import formats
from lodestream.errors import FormatError, FormatWarning, InputError, OptionError, TooLargeError
from lodestream.formats.list_directed import read_numbers
from lodestream.scratch import Room
from lodestream.surface import Surface

Dims = tuple[int, ...]


@dataclass(frozen=True)
class Written:
    """A PLOT3D file as a solver would write it."""

    blocks: tuple[Dims, ...]
    multi: bool
    iblank: bool
    precision: int = 8
    endian: str = "<"
    records: bool = False

    def coordinates(self, block: int) -> NDArray[Any]:
        """Of shape (dimensions, points), all of them different and of few digits."""
        dims = self.blocks[block]
        count = len(dims) * int(np.prod(dims))
        return (np.arange(count) / 4 + 1000.5 * block + 0.25).astype(f"f{self.precision}").reshape(len(dims), -1)

    def blank(self, block: int) -> NDArray[np.int32]:
        values = np.ones(int(np.prod(self.blocks[block])), np.int32)
        values[1::5] = 0
        return values

    def binary(self) -> bytes:
        header = [[len(self.blocks)]] if self.multi else []
        header.append([length for dims in self.blocks for length in dims])
        parts = [struct.pack(f"{self.endian}{len(row)}i", *row) for row in header]
        for block in range(len(self.blocks)):
            body = self.coordinates(block).astype(f"{self.endian}f{self.precision}").tobytes()
            parts.append(body + self.blank(block).astype(f"{self.endian}i4").tobytes() * self.iblank)
        marks = [struct.pack(f"{self.endian}i", len(part)) * self.records for part in parts]
        return b"".join(mark + part + mark for mark, part in zip(marks, parts, strict=True))

    def text(self) -> str:
        words = [str(len(self.blocks))] * self.multi
        words += [" ".join(map(str, dims)) for dims in self.blocks]
        for block in range(len(self.blocks)):
            words += map(repr, self.coordinates(block).reshape(-1).tolist())
            words += map(str, self.blank(block).tolist() * self.iblank)
        return "\n".join(words) + "\n"


def test_text_that_takes_more_memory_is_refused_with_its_figure(tmp_path: Path) -> None:
    x, y = np.meshgrid(np.arange(300.0), np.arange(400.0))
    path = tmp_path / "a.fmt"
    path.write_text("300 400 1\n" + "\n".join(map(repr, np.stack((x, y, x * y)).ravel().tolist())))
    expected = r"at most 1 MiB to read, got text that takes about [56] MiB: only binary files are read by windows"
    with pytest.raises(TooLargeError, match=expected):
        formats.read(path, room=Room(memory=1 << 20))
    assert formats.read(path, room=Room(memory=16 << 20)).shape == (400, 300)


@st.composite
def written(draw: st.DrawFn) -> Written:
    dimensions = draw(st.sampled_from((2, 3)))
    count = draw(st.integers(1, 3))
    block = st.tuples(*[st.integers(2, 5)] * 2, *[st.just(1)] * (dimensions - 2))
    return Written(
        blocks=tuple(draw(st.lists(block, min_size=count, max_size=count))),
        multi=count > 1 or draw(st.booleans()),
        iblank=draw(st.booleans()),
        precision=draw(st.sampled_from((4, 8))),
        endian=draw(st.sampled_from("<>")),
        records=draw(st.booleans()),
    )


def check(surface: Surface, file: Written) -> None:
    assert len(surface.blocks) == len(file.blocks)
    for number, (block, dims) in enumerate(zip(surface.blocks, file.blocks, strict=True)):
        assert block.shape == (dims[1], dims[0])
        channels = block.points.reshape(-1, len(dims)).T
        np.testing.assert_array_equal(channels, file.coordinates(number))
        valid = np.ones(block.shape, np.bool_) if block.mask is None else block.mask
        expected = file.blank(number) != 0 if file.iblank else np.ones(valid.size, np.bool_)
        np.testing.assert_array_equal(valid.reshape(-1), expected)


@given(file=written(), text=st.booleans())
def test_a_layout_is_found_from_the_size_or_refused_with_those_that_fit(file: Written, text: bool) -> None:
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "grid.xyz"
        path.write_bytes(file.text().encode() if text else file.binary())
        try:
            surface = formats.read(path, closed="none") if len(file.blocks) == 1 else formats.read(path)
        except FormatError as error:
            assert "that only one layout fits" in str(error)  # noqa: PT017 - a rare refusal is right, and is looked at
            event("more than one fits")
            if "choose by -o dimensions" not in str(error):
                return
            try:
                surface = formats.read(path, dimensions=str(len(file.blocks[0])))
            except FormatError as again:
                assert "that only one layout fits" in str(again)  # noqa: PT017
                return
        check(surface, file)
        assert (
            surface.points.dtype == np.dtype("f8" if text else f"f{file.precision}") if len(file.blocks) == 1 else True
        )


def test_a_size_that_two_layouts_fit_is_refused_naming_both(tmp_path: Path) -> None:
    flat = Written(((4, 6),), multi=True, iblank=True, precision=4)
    path = tmp_path / "grid.p3d"
    path.write_bytes(flat.binary())
    with pytest.raises(FormatError, match="got 300 bytes that 2 fit, choose by -o dimensions=2 or 3: ") as refused:
        formats.read(path)
    for words in (
        "1 x 4 x 6 points (grid, 3 dimensions, no count of blocks, single, little endian)",
        "4 x 6 points (grid, 2 dimensions, a count of blocks, IBLANK, single, little endian)",
    ):
        assert words in str(refused.value)
    check(formats.read(path, dimensions="2"), flat)
    assert formats.read(path, dimensions="3").shape == (6, 4)


def test_a_size_that_no_layout_fits_is_refused_with_the_nearest(tmp_path: Path) -> None:
    path = tmp_path / "grid.bin"
    whole = Written(((5, 7, 1),), multi=False, iblank=False, precision=4, endian=">").binary()
    path.write_bytes(whole[:-3])
    with pytest.raises(FormatError, match=r"got 429 bytes where .* 428 .*; or 432 \(5 x 7 x 1 points,"):
        formats.read(path)
    path.write_bytes(struct.pack("<4i", 1 << 20, 1 << 20, -1, 0) * 4)
    with pytest.raises(FormatError, match="with dimensions=3, which begins with dimensions of blocks, got none in any"):
        formats.read(path, dimensions="3")
    path.write_bytes(whole)
    for name, value, message in (
        ("dimensions", "4", "dimensions= from 2 to 3, got 4"),
        ("block", "2", "block= from 1 to 1, got 2"),
        ("plane", "x3", "plane= an axis and an index, such as i0, j3 or k-1, .* got 'x3'"),
        ("plane", "i2", "no plane= for a surface, which 5 x 7 x 1 points are already"),
    ):
        with pytest.raises(OptionError, match=message):
            formats.read(path, **{name: value})  # type: ignore[arg-type]
    assert formats.read(path, plane="k0").shape == (7, 5)


@pytest.mark.parametrize(
    ("plane", "index"), [("i0", (..., 0)), ("i-1", (..., 3)), ("j2", (slice(None), 2)), ("k-5", 0)]
)
def test_a_plane_of_a_volume(tmp_path: Path, plane: str, index: Any) -> None:
    file = Written(((4, 3, 5),), multi=False, iblank=True)
    path = tmp_path / "grid.x"
    path.write_bytes(file.binary())
    surface = formats.read(path, plane=plane)
    volume = file.coordinates(0).reshape(3, 5, 3, 4)
    expected = np.stack([channel[index] for channel in volume], axis=-1)
    np.testing.assert_array_equal(surface.points, expected)
    assert surface.mask is not None
    np.testing.assert_array_equal(surface.mask, file.blank(0).reshape(5, 3, 4)[index] != 0)
    assert surface.metadata["plane"] == plane
    assert surface.metadata["volumes"] == [[4, 3, 5]]
    with pytest.warns(FormatWarning, match="took plane i0 of a volume of 4 x 3 x 5 points; choose others with plane="):
        default = formats.read(path)
    np.testing.assert_array_equal(default.points[:, 0, 0], volume[0, :, 0, 0])
    with pytest.raises(OptionError, match="plane= k from -5 to 4 for a volume of 4 x 3 x 5 points, got 5"):
        formats.read(path, plane="k5")
    with pytest.raises(TooLargeError, match="at most 10 vertices, got 15"):
        formats.read(path, plane="i0", max_vertices=10)


def test_several_planes_of_a_volume_are_blocks(tmp_path: Path) -> None:
    file = Written(((4, 3, 5), (2, 3, 1)), multi=True, iblank=True)
    path = tmp_path / "grid.x"
    path.write_bytes(file.binary())
    surface = formats.read(path, plane="i0, j-1,k2")
    assert [block.shape for block in surface.blocks] == [(5, 3), (5, 4), (3, 4), (3, 2)]
    for block, plane in zip(surface.blocks, ("i0", "j-1", "k2"), strict=False):
        (alone,) = formats.read(path, plane=plane, block="1").blocks
        np.testing.assert_array_equal(block.points, alone.points)
        np.testing.assert_array_equal(block.mask, alone.mask)
    np.testing.assert_array_equal(surface.blocks[3].points.reshape(-1, 3).T, file.coordinates(1))
    assert surface.metadata["plane"] == "i0,j-1,k2"
    # Planes that meet share the points of their edge.
    np.testing.assert_array_equal(surface.blocks[0].points[:, -1], surface.blocks[1].points[:, 0])
    for plane in ("i0,", "i0,i0", ",".join(f"i{index}" for index in range(65))):
        with pytest.raises(OptionError, match=r"or up to 64 different planes with commas, such as i0,i-1, got"):
            formats.read(path, plane=plane)
    with pytest.raises(OptionError, match=r"plane= j from -3 to 2 .* got 3"):
        formats.read(path, plane="i0,j3")
    with pytest.raises(TooLargeError, match=r"at most 40 vertices, got 53 \(4 blocks\)"):
        formats.read(path, plane="i0,j-1,k2", max_vertices=40)


def test_one_block_of_several_and_a_curve(tmp_path: Path) -> None:
    file = Written(((4, 3, 1), (2, 6, 1)), multi=True, iblank=False)
    path = tmp_path / "grid.g"
    path.write_text(file.text())
    surface = formats.read(path, block="2")
    assert surface.shape == (6, 2)
    np.testing.assert_array_equal(surface.points.reshape(-1, 3).T, file.coordinates(1))
    curve = Written(((7, 1, 1),), multi=False, iblank=False)
    path.write_text(curve.text())
    assert formats.read(path).points.shape == (7, 1, 3)


def test_other_values_of_iblank_are_kept(tmp_path: Path) -> None:
    path = tmp_path / "grid.fmt"
    numbers = " ".join(f"{value}.5" for value in range(24))
    path.write_text(f"2 4\n {numbers[: numbers.index('16.5')]} 1 1 0 2 -3 1 1 1\n")
    surface = formats.read(path, dimensions="2")
    assert surface.points.shape == (4, 2, 2)
    assert surface.mask is not None
    assert surface.mask.tolist() == [[True, True], [False, True], [True, True], [True, True]]
    assert surface.attributes["iblank"].tolist() == [[1, 1], [0, 2], [-3, 1], [1, 1]]


@pytest.mark.parametrize("word", ["7e30", "-7e30", "2147483648", "0.5", "nan", "inf", "-inf"])
def test_text_whose_iblank_is_no_integer_of_32_bits_is_refused(tmp_path: Path, word: str) -> None:
    path = tmp_path / "grid.fmt"
    numbers = " ".join(f"{value}.5" for value in range(16))
    path.write_text(f"2 4\n {numbers} 1 1 0 2 -3 1 1 {word}\n")
    with pytest.raises(FormatError, match=f"IBLANK of integers of 32 bits, got {float(word):g}".replace("+", r"\+")):
        formats.read(path, dimensions="2")


@pytest.mark.parametrize("value", [-(2**31), 2**31 - 1])
def test_text_has_any_iblank_of_32_bits(tmp_path: Path, value: int) -> None:
    path = tmp_path / "grid.fmt"
    numbers = " ".join(f"{value}.5" for value in range(16))
    path.write_text(f"2 4\n {numbers} 1 1 0 2 -3 1 1 {value}\n")
    surface = formats.read(path, dimensions="2")
    assert surface.attributes["iblank"].tolist() == [[1, 1], [0, 2], [-3, 1], [1, value]]


def test_q_and_function_files_give_attributes(tmp_path: Path) -> None:
    grid = Written(((4, 3, 1), (2, 3, 1)), multi=True, iblank=False, endian=">", records=True)
    (tmp_path / "g.x").write_bytes(grid.binary())

    def records(parts: list[NDArray[Any]]) -> bytes:
        packed = [part.astype(part.dtype.newbyteorder(">")).tobytes() for part in parts]
        return b"".join(struct.pack(">i", len(part)) + part + struct.pack(">i", len(part)) for part in packed)

    head = np.array([2], np.int32)
    fields = [np.arange(5.0 * count) for count in (12, 6)]
    reference = np.array([0.5, 2.0, 1e6, 0.25])
    q = [head, np.array([4, 3, 1, 2, 3, 1], np.int32), reference, fields[0], reference, fields[1]]
    (tmp_path / "g.q").write_bytes(records(q))
    functions = [np.arange(2 * count).astype(np.float32) for count in (12, 6)]
    (tmp_path / "g.f").write_bytes(records([head, np.array([4, 3, 1, 2, 2, 3, 1, 2], np.int32), *functions]))
    surface = formats.read(tmp_path / "g.x", tmp_path / "g.q", tmp_path / "g.f")
    assert surface.metadata["scalars"] == {"mach": 0.5, "alpha": 2.0, "reynolds": 1e6, "time": 0.25}
    for block, values, two in zip(surface.blocks, fields, functions, strict=True):
        density, *momentum, energy = values.reshape(5, *block.shape)
        np.testing.assert_array_equal(block.attributes["density"], density)
        np.testing.assert_array_equal(block.attributes["momentum"], np.stack(momentum, axis=-1))
        np.testing.assert_array_equal(block.attributes["stagnation_energy"], energy)
        np.testing.assert_array_equal(block.attributes["function_2"], two.reshape(2, *block.shape)[1])
        assert block.attributes["function_1"].dtype == np.float32
    with pytest.raises(OptionError, match=r"expected one Q file, got another: g\.q"):
        formats.read(tmp_path / "g.x", tmp_path / "g.q", tmp_path / "g.q")
    (tmp_path / "again.q").write_bytes(records([*q[:4], reference * 2, q[5]]))
    with pytest.warns(FormatWarning, match="left out the reference numbers of later blocks of a Q file"):
        surface = formats.read(tmp_path / "g.x", tmp_path / "again.q")
    assert surface.metadata["scalars"]["mach"] == 0.5
    (tmp_path / "other.q").write_bytes(records([head, np.array([4, 3, 1, 2, 2, 1], np.int32), *q[2:]]))
    with pytest.raises(FormatError, match=r"other\.q: expected a PLOT3D Q or function file.* dimensions of the grid"):
        formats.read(tmp_path / "g.x", tmp_path / "other.q")


@pytest.mark.parametrize("precision", [4, 8])
@pytest.mark.parametrize("record", [512, 4096])
def test_a_file_padded_to_a_record_is_read(tmp_path: Path, record: int, precision: int) -> None:
    grid = Written(((9, 7, 1),), multi=False, iblank=False, precision=precision)
    (tmp_path / "g.x").write_bytes(grid.binary())
    fields = np.arange(1, 5 * 63 + 1.0).astype(f"<f{precision}")
    q = struct.pack("<3i", 9, 7, 1) + np.array([0.5, 2, 1e6, 0.25], fields.dtype).tobytes() + fields.tobytes()
    padded = q + bytes(-len(q) % record)
    assert len(padded) > len(q)
    (tmp_path / "g.q").write_bytes(padded)
    surface = formats.read(tmp_path / "g.x", tmp_path / "g.q")
    np.testing.assert_array_equal(surface.attributes["stagnation_energy"].reshape(-1), fields[4 * 63 :])
    assert surface.metadata["scalars"]["reynolds"] == 1e6
    # What is no padding: other bytes than zeros, or an end that is not one of a record.
    for name, content in (
        ("one.q", padded[:-1] + b"\1"),
        ("short.q", padded[:-4]),
        ("long.q", padded + bytes(1 << 17)),
    ):
        (tmp_path / name).write_bytes(content)
        with pytest.raises(FormatError, match=f"{name}: expected a PLOT3D Q or function file whose size fits"):
            formats.read(tmp_path / "g.x", tmp_path / name)


@pytest.mark.parametrize("endian", ["<", ">"])
@pytest.mark.parametrize("blocks", [0, 1, 3])
@pytest.mark.parametrize(("fields", "species"), [(5, 0), (6, 0), (9, 2)])
def test_a_q_file_of_overflow_is_refused_with_what_to_do(
    tmp_path: Path, endian: str, blocks: int, fields: int, species: int
) -> None:
    def record(*parts: Any) -> bytes:
        arrays = [np.asarray(part) for part in parts]
        content = b"".join(array.astype(f"{endian}{array.dtype.str[1:]}").tobytes() for array in arrays)
        marker = struct.pack(f"{endian}i", len(content))
        return marker + content + marker

    dims = [(6, 4, 1), (5, 5, 5), (2, 3, 4)][: blocks or 1]
    count = [record(np.int32(blocks))] if blocks else []
    points = [record(np.ones((3, *size[::-1]))) for size in dims]
    (tmp_path / "grid.x").write_bytes(b"".join([*count, record(np.array(dims, np.int32)), *points]))
    q = [*count, record(np.array([*np.ravel(dims), fields, species], np.int32))]
    for size in dims:
        q += [record(np.ones(7), np.int32(0), np.ones(8 + species)), record(np.ones((fields, *size[::-1])))]
    (tmp_path / "q.save").write_bytes(b"".join(q))
    words = rf"got a Q file of OVERFLOW with {fields} fields and {species} species, which is not read: open it with"
    with pytest.raises(FormatError, match=rf"q\.save: expected a PLOT3D grid file, {words}"):
        formats.read(tmp_path / "q.save")
    options = {"block": 1, "plane": "k0"} if blocks else {"plane": "k0"}
    with pytest.raises(FormatError, match=rf"q\.save: expected a PLOT3D Q or function file, {words}"):
        formats.read(tmp_path / "grid.x", tmp_path / "q.save", **options)


@pytest.mark.parametrize("more", [0.0, 1.4])
def test_reference_numbers_in_a_longer_record_are_read(tmp_path: Path, more: float) -> None:
    grid = Written(((4, 3, 1), (2, 3, 1)), multi=True, iblank=False, endian="<", records=True)
    (tmp_path / "g.x").write_bytes(grid.binary())
    reference = np.array([0.5, 2.0, 1e6, 0.25, *[more] * 12])
    parts = [np.array([2], "<i4"), np.array([4, 3, 1, 2, 3, 1], "<i4")]
    for count in (12, 6):
        parts += [reference, np.arange(5.0 * count)]
    packed = [part.tobytes() for part in parts]
    marked = b"".join(struct.pack("<i", len(part)) + part + struct.pack("<i", len(part)) for part in packed)
    (tmp_path / "g.q").write_bytes(marked)
    with warnings.catch_warnings(record=True) as notes:
        warnings.simplefilter("always")
        surface = formats.read(tmp_path / "g.x", tmp_path / "g.q")
    assert [str(note.message) for note in notes] == (
        ["left out 12 numbers of a Q file behind the four reference numbers"] if more else []
    )
    assert surface.metadata["scalars"]["time"] == 0.25
    np.testing.assert_array_equal(surface.blocks[1].attributes["density"].reshape(-1), np.arange(6.0))


@pytest.mark.parametrize(
    ("text", "numbers"),
    [
        ("1 2.5\n-3e2", [1, 2.5, -300]),
        ("3*1.5, 2*-4.\n7", [1.5, 1.5, 1.5, -4, -4, 7]),
        ("1.0D+02 1.5d0 1.25-101 2.+100", [100, 1.5, 1.25e-101, 2e100]),
        ("1,2 ,3\r\n4\x1a", [1, 2, 3, 4]),
    ],
)
def test_numbers_as_fortran_writes_them(tmp_path: Path, text: str, numbers: list[float]) -> None:
    path = tmp_path / "numbers"
    path.write_text(text, newline="")
    assert read_numbers(path)[0].tolist() == numbers


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("1 2\n3 x4 5\n", "line 2: expected numbers, got '3 x4 5'"),
        ("1 2\n3,,5\n", "line 2: expected numbers, got '3,,5'"),
        ("1 2\n0*5\n", "line 2: expected numbers"),
        ("1 2\n\n4*\n", "line 3: expected numbers"),
        ("1_0\n", "line 1: expected numbers"),
        ("2*3*4\n", "line 1: expected numbers"),
        ("****** 1\n", "line 1: expected numbers"),
    ],
)
def test_text_that_is_no_number_is_refused_with_its_line(tmp_path: Path, text: str, message: str) -> None:
    path = tmp_path / "numbers"
    path.write_text(text)
    with pytest.raises(FormatError) as refused:
        read_numbers(path)
    assert message in str(refused.value)


@pytest.mark.parametrize("text", ["3000000000*1.5\n", "9*1.5\n" + "8000000*0.\n" * 1000])
def test_repeat_counts_that_expand_a_small_file_are_refused(tmp_path: Path, text: str) -> None:
    path = tmp_path / "bomb.fmt"
    path.write_text("30000 30000 1\n" + text)
    with pytest.raises(TooLargeError, match="repeat counts that expand the file at most 64 times"):
        formats.read(path)


def test_nan_everywhere_is_no_surface(tmp_path: Path) -> None:
    path = tmp_path / "grid.fmt"
    path.write_text("3 4 1\n36*NaN\n")
    with pytest.raises(InputError, match="at least one valid point, got 4 x 3 holes"):
        formats.read(path)


def test_a_file_without_a_suffix_is_known_by_its_dimensions(tmp_path: Path) -> None:
    file = Written(((4, 6, 1), (3, 2, 1)), multi=True, iblank=False, endian=">")
    for content in (file.binary(), file.text().encode()):
        (tmp_path / "grid").write_bytes(content)
        with warnings.catch_warnings():
            assert formats.sniff(tmp_path / "grid").name == "plot3d"
