"""Bézier patches: sampled so that patches that share control points share their points, bit for bit."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray

from lodestream import formats
from lodestream.errors import FormatError, OptionError, TooLargeError
from lodestream.formats.bezier import _sampled

Points = NDArray[np.float64]


def write(path: Path, patches: list[Points]) -> Path:
    lines = [str(len(patches))]
    for patch in patches:
        lines.append(f"{patch.shape[0] - 1} {patch.shape[1] - 1}")
        lines += [" ".join(map(repr, point)) for point in patch.reshape(-1, 3).tolist()]
    path.write_text("\n".join(lines) + "\n")
    return path


def random_patch(seed: int, rows: int, columns: int) -> Points:
    return np.random.default_rng(seed).normal(size=(rows, columns, 3)) * 7


def bernstein(control: Points, u: float, v: float) -> Points:
    """The point of a patch by the definition."""
    from math import comb

    rows, columns = control.shape[0] - 1, control.shape[1] - 1
    a = [comb(rows, i) * u**i * (1 - u) ** (rows - i) for i in range(rows + 1)]
    b = [comb(columns, j) * v**j * (1 - v) ** (columns - j) for j in range(columns + 1)]
    point: Points = np.einsum("i,j,ijk->k", a, b, control)
    return point


@given(seed=st.integers(0, 2**32), rows=st.integers(2, 6), columns=st.integers(2, 6), density=st.integers(1, 9))
def test_points_are_those_of_the_definition(seed: int, rows: int, columns: int, density: int) -> None:
    control = random_patch(seed, rows, columns)
    points = _sampled(control, density)
    assert points.shape == (density + 1, density + 1, 3)
    for r in range(density + 1):
        for c in range(density + 1):
            np.testing.assert_allclose(points[r, c], bernstein(control, r / density, c / density), atol=1e-12)
    for corner in ((0, 0), (0, -1), (-1, 0), (-1, -1)):
        np.testing.assert_array_equal(points[corner], control[corner])


@given(
    seed=st.integers(0, 2**32),
    degree=st.integers(1, 5),
    density=st.integers(1, 20),
    turns=st.tuples(*[st.integers(0, 7)] * 2),
)
def test_a_shared_side_has_the_same_bits_whichever_way_its_patches_lie(
    seed: int, degree: int, density: int, turns: tuple[int, int]
) -> None:
    def turned(array: Points, turn: int) -> Points:
        array = np.rot90(array, turn % 4)
        return array[:, ::-1] if turn > 3 else array

    def back(array: Points, turn: int) -> Points:
        array = array[:, ::-1] if turn > 3 else array
        return np.rot90(array, -(turn % 4))

    one, two = random_patch(seed, degree + 1, degree + 1), random_patch(seed + 1, degree + 1, degree + 1)
    two[:, 0] = one[:, -1]
    first, second = (
        back(_sampled(turned(patch, turn), density), turn) for patch, turn in zip((one, two), turns, strict=True)
    )
    assert first[:, -1].tobytes() == second[:, 0].tobytes()


def test_a_collapsed_side_stays_one_point(tmp_path: Path) -> None:
    patch = random_patch(1, 4, 4)
    patch[:, 0] = [0.1, -0.0, 0.3]
    surface = formats.read(write(tmp_path / "pole.bpt", [patch]), density="23")
    assert surface.shape == (24, 24)
    assert len({point.tobytes() for point in surface.points[:, 0]}) == 1
    np.testing.assert_array_equal(surface.points[0, 0], [0.1, 0.0, 0.3])
    assert surface.metadata == {"name": "pole", "format": "bpt", "density": 23}


def test_patches_of_several_degrees_are_blocks(tmp_path: Path) -> None:
    path = write(tmp_path / "two.bpt", [random_patch(1, 4, 4), random_patch(2, 2, 6)])
    assert [block.shape for block in formats.read(path).blocks] == [(17, 17), (17, 17)]
    with pytest.raises(TooLargeError, match="at most 100 vertices, got 2 patches of 17 x 17 points"):
        formats.read(path, max_vertices=100)
    with pytest.raises(OptionError, match="density= from 1 to 16384, got 0"):
        formats.read(path, density="0")


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("x\n", "bytes|text that begins with 'x'"),
        ("-1\n", "a count of patches from 1 to 16,384 first"),
        ("1e9\n", "a count of patches from 1 to 16,384 first"),
        ("2\n1 1\n" + "0 0 0\n" * 4, "two degrees from 1 to 32 for patch 2 of 2, got the end of the file"),
        ("1\n0 3\n", "two degrees from 1 to 32 for patch 1 of 1, got 0 3"),
        ("1\nnan 3\n", "two degrees from 1 to 32 for patch 1 of 1, got nan 3"),
        ("1\n3 3\n0 0 0\n", "16 control points of finite numbers for patch 1 of 1"),
        ("1\n1 1\n" + "0 nan 0\n" * 4, "4 control points of finite numbers for patch 1 of 1"),
        ("1\n1 1\n" + "0 0 0\n" * 5, "the end of the file after 1 patches, got 3 more numbers"),
    ],
)
def test_a_bad_file_is_refused(tmp_path: Path, text: str, message: str) -> None:
    (tmp_path / "bad.bpt").write_text(text)
    with pytest.raises(FormatError, match=message):
        formats.read(tmp_path / "bad.bpt")
