"""Text with a line "x y z" for each node: the grid that it is, whatever the order of its lines, or a refusal."""

from __future__ import annotations

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
from lodestream import formats
from lodestream.errors import FormatError, FormatWarning, InputError, OptionError, TooLargeError
from lodestream.formats import text_arrays

Array = NDArray[Any]

ROWS, COLUMNS = 40, 50


def nodes(rows: int = ROWS, columns: int = COLUMNS) -> Array:
    """x, y and z of a grid, shape (row, column, 3); rows go to the south."""
    row, column = np.mgrid[0:rows, 0:columns]
    height = np.round(100 + 20 * np.sin(column / 9) * np.cos(row / 7), 2)
    return np.stack((372000.5 + column, 5812000.5 - row, height), axis=-1)


def lines_of(points: Array, separator: str = " ") -> str:
    return "".join(
        separator.join(f"{value:.10g}" for value in point) + "\n" for point in points.reshape(-1, points.shape[-1])
    )


def read(path: Path, text: str, **options: Any) -> tuple[ls.Surface, list[str]]:
    path.write_text(text)
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always", FormatWarning)
        surface = formats.read(path, **options)
    return surface, [str(warning.message) for warning in caught if warning.category is FormatWarning]


def places_of(surface: ls.Surface) -> Array:
    """x, y and z of a surface in any order, with NaN for holes, sorted; shape (point, 3)."""
    from lodestream.coordinates.height_fields import to_xyz

    points: Array = to_xyz(surface).points[..., :3].reshape(-1, 3)
    points = points[np.isfinite(points).all(axis=1)]
    return points[np.lexsort(points.T)]


def sorted_points(points: Array) -> Array:
    flat: Array = points.reshape(-1, points.shape[-1])[:, :3]
    return flat[np.lexsort(flat.T)]


@pytest.mark.parametrize("suffix", [".txt", ".xyz", ".dat", ".csv"])
@pytest.mark.parametrize("separator", [" ", ",", ";", "\t", ", "])
def test_every_suffix_and_separator(tmp_path: Path, suffix: str, separator: str) -> None:
    points = nodes()
    surface, notes = read(tmp_path / f"a{suffix}", lines_of(points, separator))
    assert (surface.shape, notes) == ((ROWS, COLUMNS), [])
    np.testing.assert_array_equal(surface.points, points[..., 2])
    assert surface.metadata["geotransform"] == [372000.0, 1.0, 0.0, 5812001.0, 0.0, -1.0]
    assert surface.mask is None
    np.testing.assert_array_equal(places_of(ls.decode(ls.encode(surface))), sorted_points(points))


def serpentine(points: Array) -> Array:
    turned = points.copy()
    turned[1::2] = turned[1::2, ::-1]
    return turned


ORDERS: dict[str, Callable[[Array], Array]] = {
    "x fastest, to the south": lambda points: points,
    "x fastest, to the north": lambda points: points[::-1],
    "x fastest, to the west": lambda points: points[:, ::-1],
    "y fastest, to the south": lambda points: points.transpose(1, 0, 2),
    "y fastest, to the north": lambda points: points[::-1].transpose(1, 0, 2),
    "y fastest, from the east": lambda points: points[:, ::-1].transpose(1, 0, 2),
    "serpentine": serpentine,
    "serpentine along y": lambda points: serpentine(points.transpose(1, 0, 2)),
    "shuffled": lambda points: np.random.default_rng(3).permutation(points.reshape(-1, 3)),
}


@pytest.mark.parametrize("order", ORDERS)
def test_every_order_of_lines(tmp_path: Path, order: str) -> None:
    points = nodes()
    surface, notes = read(tmp_path / "a.txt", lines_of(ORDERS[order](points)))
    assert (surface.shape, notes) == ((ROWS, COLUMNS), [])
    expected = points[..., 2]
    if "to the north" in order:
        expected = expected[::-1]
    if "west" in order or "east" in order:
        expected = expected[:, ::-1]
    np.testing.assert_array_equal(surface.points, expected)
    np.testing.assert_array_equal(places_of(surface), sorted_points(points))


def test_nodes_without_a_line_are_holes(tmp_path: Path) -> None:
    points = nodes()
    missing = np.hypot(*np.mgrid[-20:20, -25:25]) > 17
    missing[12] = missing[:, 30] = True  # a row and a column that no line has
    surface, _ = read(tmp_path / "a.txt", lines_of(points[~missing]))
    rows, columns = np.flatnonzero(~missing.all(axis=1)), np.flatnonzero(~missing.all(axis=0))
    window = np.s_[rows[0] : rows[-1] + 1, columns[0] : columns[-1] + 1]
    assert surface.mask is not None
    np.testing.assert_array_equal(surface.mask, ~missing[window])
    np.testing.assert_array_equal(surface.points[surface.mask], points[window][..., 2][surface.mask])
    assert surface.metadata["geotransform"][1::4] == [1.0, -1.0]
    np.testing.assert_array_equal(places_of(ls.decode(ls.encode(surface))), sorted_points(points[~missing]))


@pytest.mark.parametrize("digits", [10, 3])
@pytest.mark.parametrize(("rows", "columns"), [((7,), ()), ((7, 8, 20), (3,)), ((), (10, 11, 12, 30)), ((38,), (1,))])
def test_rows_and_columns_that_no_line_has_are_holes_with_a_note(
    tmp_path: Path, rows: tuple[int, ...], columns: tuple[int, ...], digits: int
) -> None:
    points = nodes()
    points[..., :2] = np.round((points[..., :2] - points[0, 0, :2]) / 3, digits)
    missing = np.zeros((ROWS, COLUMNS), bool)
    missing[list(rows)] = missing[:, list(columns)] = True
    surface, notes = read(tmp_path / "a.csv", lines_of(points[~missing], ","))
    assert surface.mask is not None
    np.testing.assert_array_equal(surface.mask, ~missing)
    np.testing.assert_array_equal(surface.points[surface.mask], points[~missing][:, 2])
    step = "0.3333"
    expected = [
        f"{len(lost)} of {size} places along {name}, with a step of {step}, have no points, and are holes"
        for name, lost, size in (("x", columns, COLUMNS), ("y", rows, ROWS))
        if lost
    ]
    assert notes == expected
    np.testing.assert_allclose(places_of(surface), sorted_points(points[~missing]), rtol=0, atol=1e-8)


@pytest.mark.parametrize(
    ("y", "words"),
    [
        ([0.0, 10, 20, 30, 50, 75, 100, 150], None),
        ([0.0, 10, 20, 30, 50, 100], "y is uneven: 6 of 11 places with a step of 10 have points"),
        ([0.0, 1, 2, 3, 4, 5, 1e12], "y is uneven: 7 of 1,000,000,000,001 places with a step of 1 have points"),
        ([0.0, 1, 3, 4, 6, 7, 9], "y is uneven: 7 of 10 places with a step of 1 have points"),
        ([0.0, 5e-324, 1e300], None),
    ],
)
def test_uneven_axes_keep_their_rows_and_say_so_where_they_may_lack_some(
    tmp_path: Path, y: list[float], words: str | None
) -> None:
    x, rows = np.meshgrid(np.arange(9.0), y)
    points = np.stack((x, rows, np.sin(x + rows)), axis=-1)
    text = "".join(f"{x} {y} {z}\n" for x, y, z in points.reshape(-1, 3))
    surface, notes = read(tmp_path / "a.txt", text)
    assert (surface.shape, surface.mask, notes) == ((len(y), 9), None, [words] if words else [])
    np.testing.assert_array_equal(places_of(surface), sorted_points(points))


def quoted(points: Array, separator: str, comma: str = ".") -> str:
    return "".join(
        separator.join(f'"{value:.10g}"'.replace(".", comma) for value in point) + "\n"
        for point in points.reshape(-1, 3)
    )


@pytest.mark.parametrize("names", ["", '"x","y","z"\n', "x,y,z\n"])
@pytest.mark.parametrize(
    ("separator", "comma"), [(",", "."), (", ", "."), (" ", "."), ("\t", "."), (";", "."), (";", ",")]
)
def test_numbers_in_quotation_marks_are_numbers(tmp_path: Path, names: str, separator: str, comma: str) -> None:
    points = nodes()
    text = names.replace(",", separator) + quoted(points, separator, comma)
    surface, notes = read(tmp_path / "a.csv", text)
    assert (surface.shape, notes) == ((ROWS, COLUMNS), [])
    np.testing.assert_array_equal(surface.points, points[..., 2])
    np.testing.assert_array_equal(places_of(surface), sorted_points(points))


@pytest.mark.parametrize(
    "text",
    [
        '"1,5","2,5","3,5"\n"1,5","3,5","3,5"\n',  # decimal points or thousands
        '"1" 0.5 0.7\n"2" 0.5 0.7\n',  # names of rows, as R writes them
        '"0.5" "1.5" "2.5"\n1 2 3\n1 2 4\n',  # numbers that are names of columns
        '1,2,3\n"1",3,3\n',
        'x,y,z\n"1,5","2,5","3,5"\n',
    ],
)
def test_other_quotation_marks_are_refused_as_such(tmp_path: Path, text: str) -> None:
    with pytest.raises(FormatError, match="expected quotation marks around all numbers or none"):
        read(tmp_path / "a.csv", text)


def test_headers_of_segments_are_comments(tmp_path: Path) -> None:
    points = nodes()
    text = "".join(f"> -Z{number}\n" + lines_of(row, "\t") for number, row in enumerate(points))
    for head in ("", "# @VGMT1.0 @GMULTIPOINT\n"):
        surface, notes = read(tmp_path / "a.txt", head + text)
        assert (surface.shape, notes) == ((ROWS, COLUMNS), [])
        np.testing.assert_array_equal(surface.points, points[..., 2])
        np.testing.assert_array_equal(places_of(surface), sorted_points(points))


def test_a_height_of_nan_is_a_hole(tmp_path: Path) -> None:
    points = nodes()
    points[3, 4, 2] = np.nan
    surface, _ = read(tmp_path / "a.txt", lines_of(points))
    assert surface.mask is not None
    assert np.argwhere(~surface.mask).tolist() == [[3, 4]]


def test_uneven_axes_keep_their_places(tmp_path: Path) -> None:
    points = nodes(9, 7)
    points[..., 0] = np.cumsum([1.5, 2, 0.1, 7, 3, 11, 2])
    surface, _ = read(tmp_path / "a.txt", lines_of(points))
    assert surface.shape == (9, 7)
    np.testing.assert_array_equal(places_of(surface), sorted_points(points))


@pytest.mark.parametrize(
    ("head", "attributes", "variable"),
    [
        ("x y z temperature kind\n", ["temperature", "kind"], None),
        ("x;y;depth;temperature;kind\n", ["temperature", "kind"], "depth"),
        ('"X","Y","Z","temperature","kind"\n', ["temperature", "kind"], None),
        ("# survey of 1999\n\n# x y z temperature kind\n", ["temperature", "kind"], None),
        ("\ufeffEasting\tNorthing\tElevation\ttemperature\tkind\n", ["temperature", "kind"], "Elevation"),
        ("% made by hand\n! and foot\n// and ear\nx y z temperature kind # names\n", ["temperature", "kind"], None),
    ],
)
def test_columns_with_names_are_attributes(
    tmp_path: Path, head: str, attributes: list[str], variable: str | None
) -> None:
    points = nodes(9, 7)
    more = np.concatenate((points, points[..., 2:] / 4, np.arange(63.0).reshape(9, 7, 1)), axis=-1)
    separator = next((mark for mark in ";\t," if mark in head), " ")
    surface, notes = read(tmp_path / "a.csv", head + lines_of(more, separator))
    assert (list(surface.attributes), notes) == (attributes, [])
    np.testing.assert_array_equal(surface.points, points[..., 2])
    np.testing.assert_array_equal(surface.attributes["kind"], np.arange(63).reshape(9, 7))
    assert surface.metadata.get("variable") == variable


def test_names_say_which_columns_are_places(tmp_path: Path) -> None:
    points = nodes(9, 7)
    latitude, longitude = 50 - np.arange(9) / 10, 7 + np.arange(7) / 10
    points[..., 0], points[..., 1] = longitude, latitude[:, None]
    table = np.concatenate((np.arange(63).reshape(9, 7, 1), points[..., [1, 0, 2]]), axis=-1)
    surface, _ = read(tmp_path / "a.csv", "number,lat,lon,depth\n" + lines_of(table, ","))
    np.testing.assert_array_equal(surface.points, points[..., 2])
    assert list(surface.attributes) == ["number"]
    np.testing.assert_allclose(places_of(surface), sorted_points(points), atol=1e-12)


def test_a_globe_is_closed(tmp_path: Path) -> None:
    points = nodes(9, 36)
    points[..., 0], points[..., 1] = np.arange(36) * 10, (40 - 10 * np.arange(9))[:, None]
    surface, _ = read(tmp_path / "a.txt", "lon lat z\n" + lines_of(points))
    assert (surface.shape, surface.closed) == ((9, 36), (False, True))
    assert read(tmp_path / "a.txt", "x y z\n" + lines_of(points))[0].closed == (False, False)


def test_further_columns_without_names_are_left_out_with_a_note(tmp_path: Path) -> None:
    points = nodes(9, 7)
    more = np.concatenate((points, points[..., :2]), axis=-1)
    for suffix in (".txt", ".xyz"):
        surface, notes = read(tmp_path / f"a{suffix}", lines_of(more))
        np.testing.assert_array_equal(surface.points, points[..., 2])
        assert notes == ["left out columns 4, 5: a first line with names makes attributes"]


@pytest.mark.parametrize("separator", [",", ";", " "])
@pytest.mark.parametrize("missing", ["", "NA", "NaN", "n/a", "NULL"])
def test_missing_heights_in_the_words_of_other_programs(tmp_path: Path, missing: str, separator: str) -> None:
    if not missing and separator == " ":
        return  # nothing between spaces is no column
    points = nodes(9, 7)
    lines = lines_of(points, separator).splitlines()
    for line in (0, 11, 62):
        lines[line] = lines[line].rpartition(separator)[0] + separator + missing
    surface, notes = read(tmp_path / "a.csv", "\n".join([separator.join("xyz"), *lines]))
    expected = points[..., 2].copy()
    expected.flat[[0, 11, 62]] = np.nan
    np.testing.assert_array_equal(surface.points, expected)
    assert notes == []


@pytest.mark.parametrize("suffix", [".txt", ".xyz", ".csv"])
def test_exponents_of_fortran(tmp_path: Path, suffix: str) -> None:
    points = nodes(9, 7)
    text = "".join(f"{x:.1f} {y:.1f} {z:.8E}\n".replace("E", "D") for x, y, z in points.reshape(-1, 3))
    surface, _ = read(tmp_path / f"a{suffix}", text)
    np.testing.assert_array_equal(surface.points, points[..., 2])


@pytest.mark.parametrize("suffix", [".txt", ".xyz", ".csv"])
@pytest.mark.parametrize(("names", "place"), [("x,y,z,label,q", 3), ("date,x,y,z,q", 0), ("x,y,id,z,q", 2)])
def test_columns_of_texts_are_left_out_with_a_note(tmp_path: Path, suffix: str, names: str, place: int) -> None:
    points = nodes(9, 7)
    words = [f"{x:.1f} {y:.1f} {z:.8g} 7".split() for x, y, z in points.reshape(-1, 3)]
    for number, row in enumerate(words):
        row.insert(place, "2001-02-03" if number % 2 else "a1")
    surface, notes = read(tmp_path / f"a{suffix}", "\n".join([names, *map(",".join, words)]))
    np.testing.assert_array_equal(surface.points, points[..., 2])
    assert notes == [f"left out columns of texts: {names.split(',')[place]}"]
    assert (surface.attributes["q"] == 7).all()


@pytest.mark.parametrize("encoding", ["utf-8", "latin-1"])
def test_names_with_letters_beyond_ascii(tmp_path: Path, encoding: str) -> None:
    (tmp_path / "a.csv").write_text("x,y,Höhe\n" + lines_of(nodes(9, 7), ","), encoding=encoding)
    assert formats.read(tmp_path / "a.csv").metadata["variable"] == "Höhe"


def test_heights_of_which_the_first_is_a_text_are_not_left_out(tmp_path: Path) -> None:
    lines = lines_of(nodes(9, 7), ",").splitlines()
    rows = [f"{line},7" for line in lines]
    rows[0] = rows[0].replace(lines[0].split(",")[2], "*")
    with pytest.raises(FormatError):
        read(tmp_path / "a.csv", "\n".join(["x,y,height,count", *rows]))
    # Without a column that is called so, the first numbers behind x and y are what there is.
    words = [",".join([*line.split(",")[:2], "a", line.split(",")[2]]) for line in lines]
    surface, notes = read(tmp_path / "a.csv", "\n".join(["x,y,label,level", *words]))
    assert (surface.metadata["variable"], notes) == ("level", ["left out columns of texts: label"])


@pytest.mark.parametrize(
    ("wrong", "expected"),
    [
        ("372005.5,5812000.5,high", "got 'high' in line 8, column 3"),
        ("372005.5,5812000.5", "got 2 in line 8"),
        ("372005.5,5812000.5,1,2", "got 4 in line 8"),
    ],
)
def test_a_wrong_line_is_told_by_its_number(tmp_path: Path, wrong: str, expected: str) -> None:
    lines = ["# heights", "x,y,z", *lines_of(nodes(9, 7), ",").splitlines()]
    lines[7] = wrong
    with pytest.raises(FormatError, match=f"expected 3 numbers in each line, as in the first, {expected}"):
        read(tmp_path / "a.csv", "\n".join(lines))


def test_decimal_commas(tmp_path: Path) -> None:
    points = nodes(9, 7)
    surface, _ = read(tmp_path / "a.txt", lines_of(points, ";").replace(".", ","))
    np.testing.assert_array_equal(surface.points, points[..., 2])


def test_equal_lines_are_one_node(tmp_path: Path) -> None:
    points = nodes(9, 7)
    text = lines_of(points)
    surface, _ = read(tmp_path / "a.txt", text + lines_of(points[4]))
    np.testing.assert_array_equal(surface.points, points[..., 2])
    points[4, :, 2] += 1
    with pytest.raises(
        FormatError, match=r"one value for each node of a grid, got .* at x = 372000.5, y = 5811996.5: "
    ):
        read(tmp_path / "a.txt", text + lines_of(points[4]))


def rotated() -> Array:
    points = nodes()
    turn = np.array([[0.8, 0.6], [-0.6, 0.8]])
    points[..., :2] = points[..., :2] @ turn
    return points


@pytest.mark.parametrize(
    "points",
    [
        np.random.default_rng(1).normal(size=(2000, 3)),
        np.random.default_rng(1).normal(size=(2, 3)),
        np.arange(30.0).reshape(10, 3),
        rotated(),
        nodes(1, 50),
        nodes(50, 1),
    ],
    ids=["scattered", "two lines", "diagonal", "rotated", "row", "column"],
)
@pytest.mark.parametrize("suffix", [".txt", ".xyz"])
def test_points_that_are_no_grid_are_refused(tmp_path: Path, points: Array, suffix: str) -> None:
    with pytest.raises(
        FormatError, match=r"these [\d,]+ points x y z are no grid along x and y, with .* of y: "
    ) as caught:
        read(tmp_path / f"a{suffix}", lines_of(points))
    assert "layout=heights takes the columns for heights" in str(caught.value)
    surface, _ = read(tmp_path / f"a{suffix}", lines_of(points), layout="heights")
    np.testing.assert_allclose(surface.points, points.reshape(-1, 3))


def test_the_layout_may_be_said(tmp_path: Path) -> None:
    points = nodes(3, 4)
    more = np.concatenate((points, points[..., :2]), axis=-1)
    heights, _ = read(tmp_path / "a.txt", lines_of(more))  # twelve lines are too few to tell
    assert heights.shape == (12, 5)
    surface, _ = read(tmp_path / "a.txt", lines_of(more), layout="points")
    assert surface.shape == (3, 4)
    with pytest.raises(OptionError, match="expected layout=heights or layout=points, got 'rows'"):
        read(tmp_path / "a.txt", lines_of(more), layout="rows")
    with pytest.raises(FormatError, match="this file has 2 columns, and points have three at least"):
        read(tmp_path / "a.txt", "1 2\n3 4\n", layout="points")
    with pytest.raises(OptionError, match="expected layout=points for one file, got 2 files"):
        formats.read(tmp_path / "a.txt", tmp_path / "a.txt", layout="points")


def test_tables_of_heights_stay_tables(tmp_path: Path) -> None:
    heights = np.round(np.random.default_rng(0).normal(size=(60, 5)) * 4)  # whose columns have few values
    surface, _ = read(tmp_path / "a.txt", lines_of(heights))
    np.testing.assert_array_equal(surface.points, heights)
    for path in ("x", "y", "z"):
        np.savetxt(tmp_path / f"{path}.dat", nodes(6, 3)[..., "xyz".index(path)])
    surface = formats.read(*(tmp_path / f"{path}.dat" for path in "xyz"))
    assert surface.points.shape == (6, 3, 3)


def plot3d(dims: str, values: Array) -> str:
    return dims + "\n" + "".join(f"{a:.6f} {b:.6f} {c:.6f}\n" for a, b, c in values.reshape(-1, 3))


def test_plot3d_of_this_suffix_stays_plot3d(tmp_path: Path) -> None:
    points = np.moveaxis(nodes(4, 6), -1, 0)
    for dims, values in (("6 4 1", points), ("1\n6 4 1", points)):
        surface, _ = read(tmp_path / "a.xyz", plot3d(dims, values))
        assert (surface.points.shape, surface.metadata["format"]) == ((4, 6, 3), "plot3d")
    large = np.moveaxis(nodes(60, 50), -1, 0)
    surface, _ = read(tmp_path / "a.xyz", plot3d("50 60 1", large))
    assert surface.metadata["format"] == "plot3d"
    path = tmp_path / "numbers"
    path.write_text(plot3d("6 4 1", points))
    assert formats.read(path, format_name="xyz").metadata["format"] == "plot3d"
    path.write_text(lines_of(nodes()))
    assert formats.read(path, format_name="xyz").shape == (ROWS, COLUMNS)


@pytest.mark.parametrize("shape", [(3, 4), (60, 50)])
@pytest.mark.parametrize("first", [0, 1, 100])
def test_whole_numbers_are_points_too(tmp_path: Path, shape: tuple[int, int], first: int) -> None:
    points = np.stack(
        (*(np.indices(shape)[::-1] + first), np.arange(shape[0] * shape[1]).reshape(shape) + first), axis=-1
    )
    for turned in (points, points.transpose(1, 0, 2)):
        surface, _ = read(tmp_path / "a.xyz", lines_of(turned))
        np.testing.assert_array_equal(surface.points, points[..., 2])


def test_limits(tmp_path: Path) -> None:
    text = lines_of(nodes())
    read(tmp_path / "a.txt", text, max_vertices=ROWS * COLUMNS)
    with pytest.raises(TooLargeError, match="expected at most 1,999 vertices, got an array of 2000 x 1 x 3"):
        read(tmp_path / "a.txt", text, max_vertices=1999)
    cross = lines_of(np.concatenate((nodes()[0], nodes()[:, 0], nodes()[5], nodes()[:, 9])))
    with pytest.raises(TooLargeError, match="expected at most 500 vertices, got an array of 40 x 50"):
        read(tmp_path / "a.txt", cross, max_vertices=500)


def test_many_lines_are_read_some_at_a_time(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(text_arrays, "_LINES_AT_ONCE", 7)
    points = nodes()
    surface, _ = read(tmp_path / "a.txt", "# a\n\n" + lines_of(points[:20]) + "# b\n\n" + lines_of(points[20:]))
    np.testing.assert_array_equal(surface.points, points[..., 2])


@given(
    rows=st.integers(2, 9),
    columns=st.integers(2, 9),
    steps=st.tuples(st.floats(0.001, 1e4), st.floats(0.001, 1e4)),
    seed=st.integers(0, 2**32 - 1),
)
def test_any_order_of_any_grid(
    tmp_path_factory: pytest.TempPathFactory, rows: int, columns: int, steps: tuple[float, float], seed: int
) -> None:
    random = np.random.default_rng(seed)
    x, y = (np.arange(count) * step - 5e3 for count, step in zip((columns, rows), steps, strict=True))
    points = np.stack((*np.meshgrid(x, y), random.normal(size=(rows, columns))), axis=-1)
    shuffled = random.permutation(points.reshape(-1, 3))
    text = "".join(" ".join(repr(float(value)) for value in point) + "\n" for point in shuffled)
    surface, _ = read(tmp_path_factory.mktemp("points") / "a.txt", text)
    assert surface.shape == (rows, columns)
    np.testing.assert_array_equal(places_of(surface), sorted_points(points))


@pytest.mark.parametrize("end", ["\n", "\r\n", "\r"])
@pytest.mark.parametrize("names", ["", "x y z\n", "# x y z\n"])
@pytest.mark.parametrize("suffix", [".txt", ".csv", ".xyz"])
def test_every_end_of_lines(tmp_path: Path, end: str, names: str, suffix: str) -> None:
    text = (names + lines_of(nodes())).replace("\n", end)
    (tmp_path / f"grid{suffix}").write_bytes(text.encode())
    surface = ls.read(tmp_path / f"grid{suffix}")
    np.testing.assert_array_equal(surface.points, nodes()[..., 2])


def test_the_line_of_a_wrong_number_is_told_whatever_ends_it(tmp_path: Path) -> None:
    lines = lines_of(nodes()).splitlines()
    lines[7] = "1 2 here"
    (tmp_path / "grid.txt").write_bytes("\r".join(lines).encode())
    with pytest.raises(FormatError, match="got 'here' in line 8, column 3"):
        ls.read(tmp_path / "grid.txt")


def test_lines_of_any_end_are_bounded(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(text_arrays, "_LONGEST_LINE", 64)
    (tmp_path / "grid.txt").write_bytes(lines_of(nodes()).replace("\n", "\r").encode())
    assert ls.read(tmp_path / "grid.txt").shape == (ROWS, COLUMNS)
    (tmp_path / "grid.txt").write_bytes(b"1 " * 40 + b"\r1 2\r")
    with pytest.raises(TooLargeError, match="lines of fewer than 64 bytes"):
        ls.read(tmp_path / "grid.txt")


def test_columns_of_one_name_are_all_kept(tmp_path: Path) -> None:
    points = np.concatenate([nodes(), nodes()[..., 2:] + [1, 2, 3]], axis=-1)
    surface, notes = read(tmp_path / "grid.csv", "x,y,z,q,z,q\n" + lines_of(points, ","))
    np.testing.assert_array_equal(surface.points, points[..., 2])
    assert list(surface.attributes) == ["q", "z_5", "q_6"]
    for name, column in zip(surface.attributes, (3, 4, 5), strict=True):
        np.testing.assert_allclose(surface.attributes[name], points[..., column], atol=1e-9)
    assert notes == [
        "column 5 has the name of another, 'z', and is read as 'z_5'",
        "column 6 has the name of another, 'q', and is read as 'q_6'",
    ]


@pytest.mark.parametrize(
    "places",
    [
        ("-1.7e308", "0", "1.7e308"),
        ("-1.7e308", "1.7e308"),
        ("-1.7e308", "-1e308", "0", "1.7e308"),
        ("-1e308", "-5e307", "0", "1e308"),
        ("0", "1", "2", "1.7e308"),
    ],
)
@pytest.mark.parametrize("swapped", [False, True])
def test_axes_whose_steps_are_beyond_all_numbers(tmp_path: Path, places: tuple[str, ...], swapped: bool) -> None:
    lines = [(x, str(y), str(number)) for number, (y, x) in enumerate((y, x) for y in range(3) for x in places)]
    text = "".join(" ".join((y, x, z) if swapped else (x, y, z)) + "\n" for x, y, z in lines)
    surface, notes = read(tmp_path / "grid.txt", text)
    assert notes == []
    with pytest.raises(InputError, match=r"expected values of at most 1e\+300 in magnitude"):
        ls.encode(surface)
    points = surface.points.reshape(-1, 3)
    points = points[:, [1, 0, 2]] if swapped else points
    expected = np.array(lines, np.float64)
    np.testing.assert_array_equal(points[np.argsort(points[:, 2])], expected)
