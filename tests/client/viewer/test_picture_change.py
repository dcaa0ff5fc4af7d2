"""How much of a picture changes, and the estimate of what still will; the npm package is compared with this module."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra import numpy as arrays

import lodestream as ls
from lodestream.interop.pictures import pixels_of
from lodestream.planning.plan import Mark
from lodestream_client.viewer.picture_change import (
    DONE,
    VISIBLE,
    Judge,
    Stage,
    picture_change,
    remaining_share,
    share_above,
)
from lodestream_client.viewer.pictures import view_after, view_when_done

PICTURES = arrays.arrays(np.uint8, (3, 4, 4))
LAYERS = [Mark(k, k, min(k, 4), k, rms, rms) for k, rms in enumerate((16.0, 8.0, 4.0, 2.0, 1.0, 0.0))]


@pytest.mark.parametrize(
    ("colour", "distance"),
    [
        ((255, 255, 255), 100.0),
        ((255, 0, 0), np.hypot(53.24, np.hypot(80.09, 67.20))),  # published L*, a*, b* of the primaries of sRGB, D65
        ((0, 255, 0), np.hypot(87.73, np.hypot(-86.18, 83.18))),
        ((0, 0, 255), np.hypot(32.30, np.hypot(79.19, -107.86))),
        ((119, 119, 119), 50.03),
    ],
)
def test_distances_from_black_are_the_published_ones(colour: tuple[int, int, int], distance: float) -> None:
    black, other = np.zeros((1, 1, 4), np.uint8), np.zeros((1, 1, 4), np.uint8)
    black[..., 3] = other[..., 3] = 255
    other[..., :3] = colour
    change = picture_change(black, other)
    assert share_above(change, 0.83 * distance) == 1
    assert share_above(change, 1.2 * distance) == 0


@given(PICTURES, PICTURES, st.floats(1e-3, 1e3))
def test_shares_are_of_what_is_drawn_and_fall_with_the_distance(
    before: np.ndarray, now: np.ndarray, distance: float
) -> None:
    change = picture_change(before, now)
    assert change.drawn == change.bins.sum() == np.count_nonzero((before[..., 3] > 0) | (now[..., 3] > 0))
    assert 0 <= share_above(change, 1.5 * distance) <= share_above(change, distance) <= 1
    assert share_above(picture_change(now, before), distance) == share_above(change, distance)
    assert share_above(picture_change(now, now), 0.1) == 0
    in_one = np.count_nonzero((before[..., 3] > 0) != (now[..., 3] > 0))
    assert share_above(change, 1e9) * max(change.drawn, 1) >= in_one - 1e-9


@given(PICTURES, PICTURES, st.integers(0, 4), st.integers(0, 5), st.integers(0, 4))
def test_what_is_expected_is_a_share_or_unknown(
    before: np.ndarray, now: np.ndarray, first: int, last: int, finest: int
) -> None:
    change = picture_change(before, now)
    stages = [Stage(first, finest), Stage(last, finest)]
    share = remaining_share(change, stages[0], stages[1], LAYERS)
    if last <= first:
        assert np.isnan(share)
    elif last == len(LAYERS) - 1:
        assert share == 0
    else:
        assert 0 <= share <= 1


def test_a_judge_compares_with_the_picture_before() -> None:
    grey, light = np.full((10, 10, 4), 100, np.uint8), np.full((10, 10, 4), 100, np.uint8)
    light[:3] = 140
    judge = Judge(LAYERS)
    assert np.isnan(judge.remaining(Stage(0, 4), grey))
    assert judge.remaining(Stage(1, 4), light) == pytest.approx(0.3)
    assert judge.remaining(Stage(2, 4), light) == 0
    assert np.isnan(judge.remaining(Stage(3, 4), light[:5])), "another size"
    assert np.isnan(judge.remaining(Stage(3, 4), light[:5])), "the same state"


def test_nothing_is_known_of_a_picture_of_nothing_and_of_steps_too_small_to_see() -> None:
    nothing = picture_change(np.zeros((2, 2, 4), np.uint8), np.zeros((2, 2, 4), np.uint8))
    assert np.isnan(remaining_share(nothing, Stage(0, 4), Stage(1, 4), LAYERS))
    grey = np.full((2, 2, 4), 100, np.uint8)
    layers = [Mark(k, 4, 4, k, rms, rms) for k, rms in enumerate((16.0, 15.999, 0.0))]
    assert np.isnan(remaining_share(picture_change(grey, grey), Stage(0, 4), Stage(1, 4), layers))


@pytest.mark.parametrize("kind", ["waves", "rough", "torus"])
def test_little_of_a_picture_changes_after_it_looks_done(kind: str) -> None:
    rows, columns = np.mgrid[0:160, 0:200] / 20.0
    random = np.random.default_rng(5)
    surface = {
        "waves": lambda: ls.Surface((np.sin(rows) * np.cos(columns)).astype(np.float32)),
        "rough": lambda: ls.Surface(np.cumsum(np.cumsum(random.normal(0, 1, (160, 200)), 0), 1).astype(np.float32)),
        "torus": lambda: ls.Surface(_torus(64, 96), (True, True)),
    }[kind]()
    source = ls.open(ls.encode(surface))
    view, picture, share = view_when_done(source, kind)
    # What is not drawn does not count.
    drawn = np.mean(picture.pixels()[..., 3] > 0)
    assert drawn == 1 if kind != "torus" else 0.05 < drawn < 0.6
    exact = view_after(source, None)[0].surface()
    changed = picture_change(picture.pixels(), pixels_of(exact, 1000))
    assert share < DONE
    assert share_above(changed, VISIBLE) <= 0.03
    assert view.bytes < 0.6 * source.source.size


def _torus(rows: int, columns: int) -> np.ndarray:
    u, v = np.meshgrid(*(np.linspace(0, 2 * np.pi, n, endpoint=False) for n in (rows, columns)), indexing="ij")
    points = [(3 + np.cos(u)) * np.cos(v), (3 + np.cos(u)) * np.sin(v), np.sin(u) + 0.1 * np.sin(5 * v)]
    return np.stack(points, axis=2).astype(np.float32)
