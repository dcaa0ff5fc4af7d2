"""Seams are merged where bits repeat, angles unwrapped where they jump, and both are put back bit for bit."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray

from lodestream.coordinates.seams import merge, restore, unwrap, wrapped
from lodestream.errors import InputError
from lodestream.surface import Block, Surface

from ..surfaces import torus

Array = NDArray[Any]


def repeated(array: Array, seam: str) -> Array:
    """The array with its first row or column once more at the end."""
    if seam in ("rows", "both"):
        array = np.concatenate((array, array[:1]))
    return np.concatenate((array, array[:, :1]), axis=1) if seam in ("cols", "both") else array


def closed_by(seam: str) -> tuple[bool, bool]:
    return seam in ("rows", "both"), seam in ("cols", "both")


@pytest.mark.parametrize("seam", ["rows", "cols", "both"])
@pytest.mark.parametrize("masked", [False, True])
def test_what_repeats_is_merged_and_put_back(seam: str, masked: bool) -> None:
    points = torus(9, 7)
    mask = np.ones((9, 7), np.bool_)
    mask[0, 2] = mask[3, 3] = not masked
    colours = np.random.default_rng(0).integers(0, 255, (9, 7, 3)).astype(np.uint8)
    noise = np.full((9, 7), np.nan, np.float32)
    given_points, given_mask = repeated(points, seam), repeated(mask, seam)
    given_points[-1, -1, 2] += 0 if given_mask[-1, -1] else 5  # a hole has no value
    attributes = {"colour": repeated(colours, seam), "noise": repeated(noise, seam)}
    surface = Surface(given_points, mask=given_mask, attributes=attributes, metadata={"name": "a"})
    found = merge(surface)
    assert (found.shape, found.closed, found.metadata) == ((9, 7), closed_by(seam), {"name": "a", "seam": seam})
    np.testing.assert_array_equal(found.attributes["colour"], colours)
    back = restore(found)
    assert (back.shape, back.closed, back.metadata) == (surface.shape, (False, False), {"name": "a"})
    valid = given_mask
    assert back.points[valid].tobytes() == given_points[valid].tobytes()
    for name, values in attributes.items():
        assert back.attributes[name].tobytes() == values.tobytes()
    assert (back.mask is None) == (not masked)
    if back.mask is not None:
        np.testing.assert_array_equal(back.mask, given_mask)


def test_only_what_was_asked_for_is_merged() -> None:
    surface = Surface(repeated(torus(9, 7), "both"))
    assert merge(surface, (False, False)) is surface
    assert merge(surface, (True, False)).closed == (True, False)
    heights = Surface(repeated(np.arange(20.0).reshape(4, 5), "cols"))
    assert merge(heights) is heights
    assert merge(heights, (False, True)).metadata["seam"] == "cols"


def differing() -> dict[str, Surface]:
    points = repeated(torus(9, 7), "cols")
    bit = points.copy()
    bit[4, -1, 1] = np.nextafter(bit[4, -1, 1], np.float32(9))
    hole = np.ones(points.shape[:2], np.bool_)
    hole[2, -1] = False
    colour = np.zeros(points.shape[:2], np.uint8)
    colour[1, 0] = 1
    zero = points.copy()
    zero[3, 0, 2], zero[3, -1, 2] = 0.0, -0.0
    pole = repeated(torus(9, 7), "rows")
    pole[[0, -1]] = pole[0, 0]
    return {
        "one bit": Surface(bit),
        "a hole": Surface(points, mask=hole),
        "an attribute": Surface(points, attributes={"colour": colour}),
        "negative zero": Surface(zero),
        "a pole": Surface(pole),
        "too few": Surface(repeated(torus(9, 7)[:, :2], "cols")),
        "closed already": Surface(points, (True, True)),
        "nothing": Surface(torus(9, 7)),
    }


@pytest.mark.parametrize("name", list(differing()))
def test_what_differs_stays_apart(name: str) -> None:
    surface = differing()[name]
    assert merge(surface) is surface
    assert restore(surface) is surface


def test_a_closed_curve_is_merged() -> None:
    curve = repeated(torus(12, 1), "rows")
    found = merge(Surface(curve))
    assert (found.shape, found.closed) == ((12, 1), (True, False))
    assert restore(found).points.tobytes() == curve.tobytes()


def test_each_block_has_its_own_seam() -> None:
    one, two, three = torus(9, 7), repeated(torus(8, 6), "rows"), repeated(torus(5, 7), "both")
    found = merge(Surface(blocks=[Block(one), Block(two), Block(three)]))
    assert found.metadata["seam"] == ["", "rows", "both"]
    assert [block.closed for block in found.blocks] == [(False, False), (True, False), (True, True)]
    for block, points in zip(restore(found).blocks, (one, two, three), strict=True):
        assert block.points.tobytes() == points.tobytes()
        assert block.closed == (False, False)


@pytest.mark.parametrize("turn", [360.0, -360.0])
def test_longitudes_may_differ_by_a_turn_over_the_seam(turn: float) -> None:
    east, north = np.meshgrid(np.linspace(10, 10 + turn, 13), np.linspace(-60, 60, 5))
    points = np.stack((east, north, repeated(np.cos(np.arange(60.0)).reshape(5, 12), "cols")), axis=-1)
    assert merge(Surface(points)).closed == (False, False)
    found = merge(Surface(points), angle=(0, 360.0))
    assert (found.shape, found.closed) == ((5, 12), (False, True))
    assert found.metadata == {"seam": "cols", "turn": [0, turn, 1]}
    assert restore(found).points.tobytes() == points.tobytes()


@pytest.mark.parametrize("dtype", ["float32", "float64"])
@pytest.mark.parametrize("low", [-180.0, 0.0, -37.25])
def test_longitudes_that_jump_are_unwrapped_and_wrapped_again(dtype: str, low: float) -> None:
    rows, columns = np.indices((12, 40))
    smooth = 73.3 + 8.71 * columns + 0.9 * rows
    east = (low + (smooth - low) % 360).astype(dtype)
    points = np.stack((east, rows, np.sin(columns)), axis=-1).astype(dtype)
    mask = np.ones(east.shape, np.bool_)
    mask[2, :30] = mask[5] = mask[:, 9] = False
    for surface in (Surface(points), Surface(points, mask=mask)):
        found = unwrap(surface, 0, 360.0)
        valid = mask if surface.mask is not None else np.ones_like(mask)
        angles = np.where(valid, found.points[..., 0], np.nan)
        assert np.nanmax(np.abs(np.diff(angles, axis=1))) < 180
        assert np.nanmax(np.abs(np.diff(angles, axis=0))) < 180
        assert found.metadata["angles"][0]["channel"] == 0
        back = restore(found)
        assert (back.dtype, back.metadata) == (points.dtype, {})
        assert back.points[valid].tobytes() == points[valid].tobytes()


def test_angles_that_do_not_jump_or_cannot_be_wrapped_again_stay() -> None:
    smooth = np.stack(np.meshgrid(np.arange(0.0, 90, 9), np.arange(5.0), np.arange(1.0)), axis=-1)[:, :, 0]
    surface = Surface(smooth)
    assert unwrap(surface, 0, 360.0) is surface
    wide = smooth.copy()
    wide[..., 0] = np.tile(np.arange(0, 450, 90), 2)
    surface = Surface(wide)
    assert unwrap(surface, 0, 360.0) is surface  # 0 and 360 cannot be told apart afterwards


def test_angles_of_heights_stay_in_the_metadata() -> None:
    metadata = {"angles": [{"channel": 0, "period": 360.0, "low": 0.0}], "seam": "cols"}
    found = restore(Surface(np.arange(12.0).reshape(3, 4), (False, True), metadata=metadata))
    assert found.points[:, 4].tolist() == found.points[:, 0].tolist()
    assert found.metadata == {"angles": metadata["angles"]}


@given(
    angles=st.lists(st.floats(-720, 720), min_size=1, max_size=9),
    low=st.floats(-400, 400),
)
def test_wrapped_angles_lie_in_one_turn(angles: list[float], low: float) -> None:
    found = wrapped(np.array(angles), 360.0, low)
    assert ((found >= low - 1e-9) & (found <= low + 360 + 1e-9)).all()
    turns = (found - np.array(angles)) / 360
    np.testing.assert_allclose(turns, np.rint(turns), atol=1e-9)


@pytest.mark.parametrize(
    "said",
    [
        {"angles": 5},
        {"angles": "abc"},
        {"angles": [{}]},
        {"angles": [5]},
        {"angles": [{"channel": 9, "period": 360.0, "low": 0.0}]},
        {"angles": [{"channel": -1, "period": 360.0, "low": 0.0}]},
        {"angles": [{"channel": 0, "period": 0.0, "low": 0.0}]},
        {"angles": [{"channel": 0, "period": float("nan"), "low": 0.0}]},
        {"angles": [{"channel": float("inf"), "period": 360.0, "low": 0.0}]},
        {"angles": [{"channel": [], "period": {}, "low": "x"}]},
        {"seam": "cols", "turn": 5},
        {"seam": "cols", "turn": [0, 360.0]},
        {"seam": "cols", "turn": [9, 360.0, 1]},
        {"seam": "cols", "turn": ["a", "b", "c"]},
    ],
    ids=str,
)
def test_angles_that_anybody_has_written_are_refused(said: dict[str, Any]) -> None:
    points = np.stack([*np.mgrid[:5.0, :7.0], np.ones((5, 7))], axis=-1)
    surface = Surface(points, (False, True), metadata=said)
    with pytest.raises(InputError, match="in the metadata"):
        restore(surface)


@pytest.mark.parametrize("seam", [5, {"a": 1}, True], ids=str)
def test_a_seam_that_is_no_text_and_no_list_is_refused(seam: Any) -> None:
    surface = Surface(np.ones((5, 7)), (False, True), metadata={"seam": seam})
    with pytest.raises(InputError, match="expected a seam of words in the metadata"):
        restore(surface)


@pytest.mark.parametrize("seam", [[[]], [{}], [5], ["cols", "rows"]], ids=str)
def test_a_seam_that_anybody_has_written_is_none_where_it_is_no_word(seam: Any) -> None:
    surface = Surface(np.ones((5, 7)), (False, True), metadata={"seam": seam})
    assert restore(surface).shape == ((5, 8) if seam == ["cols", "rows"] else (5, 7))
