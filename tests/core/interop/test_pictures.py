"""Pictures by matplotlib: which way up, how high, and where closed axes end."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

import lodestream as ls
from tests.core.surfaces import torus

pytest.importorskip("matplotlib")

_UP = {"geotransform": [0.0, 1.0, 0.0, 0.0, 0.0, 1.0]}


def _figure(surface: ls.Surface) -> Any:
    from matplotlib.figure import Figure

    from lodestream.interop.pictures import draw_surface

    figure = Figure()
    draw_surface(figure, surface, 200)
    return figure


def _mapped(metadata: dict[str, Any], heights: NDArray[np.float64]) -> NDArray[np.float64]:
    drawn: NDArray[np.float64] = np.asarray(
        _figure(ls.Surface(heights, metadata=metadata)).axes[0].images[0].get_array()
    )
    return drawn


@pytest.fixture
def points(monkeypatch: pytest.MonkeyPatch) -> Callable[[ls.Surface], NDArray[np.float64]]:
    """Draws a surface, and gives the points that matplotlib is told, [row, column, xyz]."""
    from mpl_toolkits.mplot3d import Axes3D  # type: ignore[import-untyped]

    told: list[NDArray[np.float64]] = []
    original = Axes3D.plot_surface

    def listening(axes: Any, x: Any, y: Any, z: Any, **options: Any) -> Any:
        told.append(np.stack([x, y, z], axis=2))
        return original(axes, x, y, z, **options)

    monkeypatch.setattr(Axes3D, "plot_surface", listening)

    def drawn(surface: ls.Surface) -> NDArray[np.float64]:
        _figure(surface)
        return told.pop()

    return drawn


@pytest.mark.parametrize(
    ("metadata", "flip"),
    [
        ({}, (1, 1)),
        (_UP, (-1, 1)),
        ({"geotransform": [0.0, 1.0, 0.0, 0.0, 0.0, -1.0]}, (1, 1)),
        ({"axes": {"x": [9, -1], "y": [0, 2]}}, (-1, -1)),
        ({"axes": {"x": [170, 3], "y": [9, -1]}, "angles": [{"channel": 0, "period": 360.0, "low": -180.0}]}, (1, 1)),
        ({"axes": "none"}, (1, 1)),
    ],
)
def test_north_is_at_the_top(metadata: dict[str, Any], flip: tuple[int, int]) -> None:
    heights = np.arange(60.0).reshape(5, 12)
    assert np.array_equal(_mapped(metadata, heights), heights[:: flip[0], :: flip[1]])


def test_x_along_the_rows_is_drawn_across() -> None:
    heights = np.arange(60.0).reshape(5, 12)
    axes = {"x": [0, 1], "y": [0, 1], "rows": "x"}
    assert np.array_equal(_mapped({"axes": axes}, heights), heights.T[::-1])


def test_heights_of_another_unit_are_fitted(points: Callable[[ls.Surface], NDArray[np.float64]]) -> None:
    x, y = np.meshgrid(np.linspace(0, 3, 20), np.linspace(0, 2, 15))
    for high, height in ((9000.0, 0.2 * 3), (3.1, 0.2 * 3), (2.0, 2.0)):
        drawn = points(ls.Surface(np.stack([x, y, high * x / 3], axis=2)))
        assert np.ptp(drawn[..., 2]) == pytest.approx(height)
        assert np.ptp(drawn[..., 0]) == 3


def test_points_that_are_no_heights_are_fitted_from_ten_times_their_width_on(
    points: Callable[[ls.Surface], NDArray[np.float64]],
) -> None:
    x, y = np.meshgrid(np.linspace(0, 3, 20), np.linspace(0, 2, 15))
    for high, height in ((9000.0, 0.2 * 3), (29.0, 29.0)):
        drawn = points(ls.Surface(np.stack([x, y + np.sin(3 * x) / 4, high * x / 3], axis=2)))
        assert np.ptp(drawn[..., 2]) == pytest.approx(height)


@pytest.mark.parametrize("angles", [{}, {"angles": [{"channel": 0, "period": 360.0, "low": 0.0}]}])
def test_what_goes_once_round_ends_a_turn_further(
    points: Callable[[ls.Surface], NDArray[np.float64]], angles: dict[str, Any]
) -> None:
    x, y = np.meshgrid(np.arange(5.0, 360, 10), np.linspace(-80, 80, 17))
    drawn = points(ls.Surface(np.stack([x, y, np.cos(y)], axis=2), (False, True), metadata=angles))
    assert drawn.shape == (17, 37, 3)
    assert (np.diff(drawn[..., 0], axis=1) == 10).all()


def test_no_quad_spans_half_a_turn(points: Callable[[ls.Surface], NDArray[np.float64]]) -> None:
    x, y = np.meshgrid(np.arange(5.0, 360, 10), np.linspace(60, 80, 9))
    x[5:] += 360
    angles = [{"channel": 0, "period": 360.0, "low": 0.0}]
    drawn = points(ls.Surface(np.stack([x, y, np.cos(y)], axis=2), metadata={"angles": angles}))
    assert np.isnan(drawn).all(axis=(1, 2)).tolist() == [row == 5 for row in range(9)]


def test_a_torus_stays_closed(points: Callable[[ls.Surface], NDArray[np.float64]]) -> None:
    drawn = points(ls.Surface(torus(30, 20), (True, True)))
    assert drawn.shape == (31, 21, 3)
    assert np.array_equal(drawn[0], drawn[-1])
    assert np.array_equal(drawn[:, 0], drawn[:, -1])
