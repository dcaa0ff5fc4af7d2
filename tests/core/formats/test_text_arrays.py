"""Arrays as text: a surface in one file, or its coordinates in a file each."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from lodestream import formats
from lodestream.errors import FormatError, OptionError, TooLargeError

from ..surfaces import torus


@pytest.mark.parametrize(("suffix", "delimiter"), [(".dat", " "), (".txt", "\t"), (".csv", ","), (".csv", ";")])
def test_heights_as_text(tmp_path: Path, suffix: str, delimiter: str) -> None:
    heights = np.random.default_rng(0).normal(size=(5, 7)) * 1e3
    heights[2, 3] = np.nan
    path = tmp_path / f"a{suffix}"
    np.savetxt(path, heights, delimiter=delimiter, header="a hill", fmt="%.17g")
    surface = formats.read(path)
    assert surface.points[~np.isnan(heights)].tobytes() == heights[~np.isnan(heights)].tobytes()
    assert surface.mask is not None
    np.testing.assert_array_equal(surface.mask, ~np.isnan(heights))
    assert surface.metadata == {"name": "a", "format": "text"}


@pytest.mark.parametrize("count", [2, 3])
def test_a_file_for_each_coordinate(tmp_path: Path, count: int) -> None:
    points = torus(8, 6).astype(np.float64)
    paths = [tmp_path / f"{name}.dat" for name in "xyz"[:count]]
    for channel, path in enumerate(paths):
        np.savetxt(path, points[..., channel], fmt="%.17g")
    surface = formats.read(*paths, closed="both")
    assert surface.points.tobytes() == points[..., :count].tobytes()
    assert surface.closed == (True, True)
    assert formats.read(*paths).closed == (False, False)
    for channel, path in enumerate(paths):
        column = np.concatenate((points[..., channel], points[:, :1, channel]), axis=1)
        np.savetxt(path, column, fmt="%.17g")
    merged = formats.read(*paths)
    assert (merged.shape, merged.closed, merged.metadata["seam"]) == ((8, 6), (False, True), "cols")
    assert formats.read(*paths, closed="none").shape == (8, 7)


def test_files_of_text_that_do_not_fit(tmp_path: Path) -> None:
    np.savetxt(tmp_path / "x.dat", np.ones((3, 4)))
    np.savetxt(tmp_path / "y.dat", np.ones((4, 3)))
    with pytest.raises(FormatError, match=r"x\.dat: expected \(3, 4\) numbers in file 2 as in the first, got \(4, 3\)"):
        formats.read(tmp_path / "x.dat", tmp_path / "y.dat")
    with pytest.raises(OptionError, match="one to three files of text, got 4"):
        formats.read(*[tmp_path / "x.dat"] * 4)
    with pytest.raises(TooLargeError, match="at most 11 vertices, got an array of 3 x 4"):
        formats.read(tmp_path / "x.dat", max_vertices=11)
    (tmp_path / "x.dat").write_text("1 2\n3 hill\n")
    with pytest.raises(
        FormatError, match=r"expected 2 numbers in each line, as in the first, got 'hill' in line 2, column 2"
    ):
        formats.read(tmp_path / "x.dat")


def test_prose_is_no_array(tmp_path: Path) -> None:
    for number, text in enumerate(("hill 1 2\n", "# only\n# words\n", "1 2 3 four\n", "1 2;;3\n")):
        (tmp_path / f"{number}.txt").write_text(text)
        with pytest.raises(FormatError, match="not a file of a format that is read"):
            formats.read(tmp_path / f"{number}.txt")
    (tmp_path / "a.rst").write_text("1.5 2\n3 4\n")
    with pytest.raises(FormatError, match="not a file of a format that is read"):
        formats.read(tmp_path / "a.rst")


def test_long_lines_of_numbers_are_known_by_their_beginning(tmp_path: Path) -> None:
    heights = np.arange(6000.0).reshape(2, 3000) / 7
    np.savetxt(tmp_path / "a.txt", heights, fmt="%.17g")
    assert formats.read(tmp_path / "a.txt").points.tobytes() == heights.tobytes()
