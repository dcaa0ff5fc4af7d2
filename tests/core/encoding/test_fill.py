from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray

from lodestream import kernels
from lodestream.encoding import fill
from lodestream.encoding.fill import fill_holes, settle_holes
from lodestream.grid.layout import Layout
from lodestream.transform.pyramid import allocate, forward
from tests.examples import examples

from ..entropy.test_mask import blobs

DTYPES = ["int8", "int16", "int32", "int64", "uint8", "uint64", "float32", "float64"]


def hills(shape: tuple[int, int]) -> NDArray[np.float64]:
    rows, columns = np.ogrid[: shape[0], : shape[1]]
    return np.asarray(np.sin(rows / 17.0) + np.cos(columns / 23.0 + rows / 40.0))


@given(
    shape=st.tuples(st.integers(1, 40), st.integers(1, 40)),
    closed=st.tuples(st.booleans(), st.booleans()),
    dtype=st.sampled_from(DTYPES),
    channels=st.integers(0, 3),
    share=st.floats(0, 1),
    seed=st.integers(0, 2**32),
)
def test_valid_points_stay_and_holes_lie_within_their_range(
    shape: tuple[int, int], closed: tuple[bool, bool], dtype: str, channels: int, share: float, seed: int
) -> None:
    rng = np.random.default_rng(seed)
    values = rng.integers(0, 100, shape if channels == 0 else (*shape, channels)).astype(dtype)
    mask = rng.random(shape) < share
    before = values.copy()
    filled = fill_holes(values, mask, closed)
    assert np.array_equal(values, before)
    assert (filled.shape, filled.dtype) == (values.shape, values.dtype)
    assert np.array_equal(filled[mask], values[mask])
    planes = (filled[..., np.newaxis], values[..., np.newaxis]) if channels == 0 else (filled, values)
    for got, given_ in zip(np.moveaxis(planes[0], -1, 0), np.moveaxis(planes[1], -1, 0), strict=True):
        valid = given_[mask]
        assert got.min() >= (valid.min() if valid.size else 0)
        assert got.max() <= (valid.max() if valid.size else 0)


@pytest.mark.parametrize("dtype", ["int64", "uint64"])
def test_holes_beside_the_largest_integers_are_such(dtype: str) -> None:
    """Which are no float64: the next one is beyond the range of the type."""
    largest = np.iinfo(dtype).max
    values, mask = np.full((20, 30), largest, dtype), np.ones((20, 30), np.bool_)
    values[0, 0], mask[5:9, 7:20] = largest - 10_000, False
    values[~mask] = 3
    filled = fill_holes(values, mask, (False, False))
    assert (filled[~mask] >= largest - 10_000).all()
    assert (filled[5:9, 12:20] == largest).any()


def beside(place: int, step: int, length: int, wraps: bool) -> int:
    return (place + step) % length if wraps else min(max(place + step, 0), length - 1)


def plain_fill(values: NDArray[np.float64], known: NDArray[np.bool_], closed: tuple[bool, bool], sweeps: int) -> None:
    """What the kernels do, point by point."""
    rows, columns = values.shape
    height, width = (rows + 1) // 2, (columns + 1) // 2
    coarser, count = np.zeros((height, width)), np.zeros((height, width))
    whole = np.zeros((height + 2, width + 2), np.bool_)
    for i, j in np.ndindex(height, width):
        own = known[2 * i : 2 * i + 2, 2 * j : 2 * j + 2]
        for value in values[2 * i : 2 * i + 2, 2 * j : 2 * j + 2][own]:
            coarser[i, j] += 0.25 * value
        count[i, j] = own.sum()
        coarser[i, j] *= 4.0 / float(count[i, j] or 1)
        whole[i + 1, j + 1] = own.all()
    found = count > 0
    for i, j in np.ndindex(height, width):
        found[i, j] &= whole[i + 1, j + 1] or not whole[i : i + 3, j : j + 3].any()
    if not found.all():
        plain_fill(coarser, found, closed, sweeps + fill._MORE)
    holes = [(int(i), int(j)) for i, j in np.argwhere(~known)]
    for i, j in holes:
        near, here = i // 2, j // 2
        far = beside(near, 2 * (i % 2) - 1, height, closed[0])
        there = beside(here, 2 * (j % 2) - 1, width, closed[1])
        at_near = 0.75 * coarser[near, here] + 0.25 * coarser[near, there]
        at_far = 0.75 * coarser[far, here] + 0.25 * coarser[far, there]
        values[i, j] = 0.75 * at_near + 0.25 * at_far
    for sweep in range(2 * sweeps):
        step = -1 if sweep % 2 else 1
        for i, j in holes[::step]:
            up, down, top, bottom = (values[beside(i, k, rows, closed[0])] for k in (-1, 1, -2, 2))
            behind, ahead, further_behind, further_ahead = (
                beside(j, k * step, columns, closed[1]) for k in (-1, 1, -2, 2)
            )
            row = values[i]
            near = (up[j] + down[j]) + row[ahead]
            corners = (up[behind] + down[ahead]) + (up[ahead] + down[behind])
            far = (top[j] + bottom[j]) + row[further_ahead]
            others = 0.56 * near - 0.14 * corners - 0.07 * far - 0.4 * row[j]
            row[j] = (others - 0.07 * row[further_behind]) + 0.56 * row[behind]


@examples(30)
@given(
    shape=st.tuples(st.integers(1, 20), st.integers(1, 20)),
    closed=st.tuples(st.booleans(), st.booleans()),
    share=st.floats(0, 1),
    at_once=st.integers(1, 300),
    seed=st.integers(0, 2**32),
)
def test_the_kernels_do_what_a_plain_loop_does_in_any_runs(
    shape: tuple[int, int], closed: tuple[bool, bool], share: float, at_once: int, seed: int
) -> None:
    rng = np.random.default_rng(seed)
    known = rng.random(shape) < share
    known[rng.integers(shape[0]), :] = rng.random() < 0.5
    known.flat[rng.integers(known.size)] = True
    values = np.where(known, rng.normal(size=shape), 0.0)
    expected = values.copy()
    plain_fill(expected, known, closed, 2)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(fill, "_AT_ONCE", at_once)
        fill._fill(values, known, closed, 2)
    assert values.tobytes() == expected.tobytes()


def test_a_hole_step_goes_beyond_the_plate() -> None:
    """One step is 1.4 times the way to (8 near - 2 corners - far) / 20."""
    values, known = np.random.default_rng(1).normal(size=(5, 5)), np.ones((5, 5), np.bool_)
    known[2, 2] = False
    near = values[1, 2] + values[3, 2] + values[2, 1] + values[2, 3]
    corners = values[1, 1] + values[1, 3] + values[3, 1] + values[3, 3]
    far = values[0, 2] + values[4, 2] + values[2, 0] + values[2, 4]
    expected = values[2, 2] + 1.4 * ((8 * near - 2 * corners - far) / 20 - values[2, 2])
    kernels.relax(values, known, 5, 5, 0, 25, False, False)
    assert values[2, 2] == pytest.approx(expected, rel=1e-14)


PULL: dict[str, Any] = {
    "values": np.zeros((5, 4)),
    "known": np.zeros((5, 4), np.bool_),
    "rows": 5,
    "columns": 4,
    "first": 0,
    "last": 6,
    "coarser": np.zeros((3, 2)),
    "found": np.zeros((3, 2), np.bool_),
}
PUSH: dict[str, Any] = {
    **dict(list(PULL.items())[:5]),
    "last": 20,
    "closed": 0,
    "wraps": 0,
    "coarser": np.zeros((3, 2)),
}
RELAX: dict[str, Any] = {**dict(list(PUSH.items())[:-1]), "last": 300}
MISFITS: list[dict[str, Any]] = [
    {"values": np.zeros(19)},
    {"known": np.zeros(21, np.bool_)},
    {"rows": 4},
    {"rows": -5, "columns": -4},
    {"rows": 0},
    {"rows": 2**32, "columns": 2**32},
    {"first": -1},
    {"first": 5, "last": 4},
]


@pytest.mark.parametrize("changed", [*MISFITS, {"last": 7}, {"coarser": np.zeros(5)}, {"found": np.zeros(7, np.bool_)}])
def test_a_pull_that_does_not_fit_is_refused(changed: dict[str, Any]) -> None:
    assert kernels.pull(*PULL.values()) == 0
    with pytest.raises(ValueError, match="do not fit"):
        kernels.pull(*(PULL | changed).values())


@pytest.mark.parametrize("changed", [*MISFITS, {"last": 21}, {"coarser": np.zeros(7)}])
def test_a_push_that_does_not_fit_is_refused(changed: dict[str, Any]) -> None:
    assert kernels.push(*PUSH.values()) == 0
    with pytest.raises(ValueError, match="do not fit"):
        kernels.push(*(PUSH | changed).values())


@pytest.mark.parametrize("changed", MISFITS)
def test_sweeps_that_do_not_fit_are_refused(changed: dict[str, Any]) -> None:
    assert kernels.relax(*RELAX.values()) == 0
    with pytest.raises(ValueError, match="do not fit"):
        kernels.relax(*(RELAX | changed).values())


@pytest.mark.parametrize("nothing", [np.nan, np.inf, -1e300])
def test_what_stands_under_a_hole_does_not_matter(nothing: float) -> None:
    values, mask = hills((60, 80)), blobs((60, 80), 1)
    expected = fill_holes(values, mask, (False, False))
    values[~mask] = nothing
    assert np.array_equal(fill_holes(values, mask, (False, False)), expected)


def test_a_smooth_surface_is_nearly_what_it_was() -> None:
    values, mask = hills((200, 300)), np.ones((200, 300), np.bool_)
    mask[80:110, 120:160] = False
    filled = fill_holes(values, mask, (False, False))
    assert np.abs(filled - values).max() < 0.1


def test_a_plane_is_continued() -> None:
    values = np.add.outer(np.arange(100.0), 2 * np.arange(120.0))
    mask = np.ones(values.shape, np.bool_)
    mask[30:60, 40:90] = False
    assert np.abs(fill_holes(values, mask, (False, False)) - values).max() < 0.05


def test_closed_axes_are_filled_across_the_seam() -> None:
    angles = 2 * np.pi * np.arange(128) / 128
    values = np.add.outer(np.sin(angles + 1), np.cos(angles))
    mask = np.ones(values.shape, np.bool_)
    mask[-6:] = mask[:6] = False
    mask[:, -6:] = mask[:, :6] = False
    closed = np.abs(fill_holes(values, mask, (True, True)) - values).max()
    assert closed < 0.1 < np.abs(fill_holes(values, mask, (False, False)) - values).max()


@pytest.mark.parametrize("scale", [1e-300, 1e-30, 1e30, 1e300])
def test_scales_do_not_matter(scale: float) -> None:
    mask = blobs((40, 50), 3)
    filled = fill_holes(hills((40, 50)) * scale / 2, mask, (False, True)) / scale
    assert filled == pytest.approx(fill_holes(hills((40, 50)) / 2, mask, (False, True)), rel=1e-9, abs=1e-12)


def bits(coordinates: NDArray[Any], layout: Layout) -> float:
    """About what the coefficients take."""
    work = allocate(layout.grids[0].shape)
    work[...] = coordinates
    forward([work], layout)
    return float(np.log2(1.0 + np.abs(work)).sum())


@pytest.mark.parametrize("closed", [(False, False), (True, False)])
def test_settled_holes_take_fewer_bits(closed: tuple[bool, bool]) -> None:
    shape = (160, 240)
    rough = np.cumsum(np.cumsum(np.random.default_rng(5).normal(size=shape), 0), 1)
    values, mask = np.rint(10 * rough).astype(np.int32), blobs(shape, 6)
    layout = Layout.single(shape, closed, (7, 7))
    filled = fill_holes(values, mask, closed)
    settle_holes(settled := filled.copy(), mask, layout)
    assert np.array_equal(settled[mask], values[mask])
    assert settled.dtype == np.int32
    assert values[mask].min() <= settled.min() <= settled.max() <= values[mask].max()
    assert bits(settled, layout) < 0.97 * bits(filled, layout)


def test_there_is_nothing_to_settle_without_holes() -> None:
    values = np.arange(12, dtype=np.int32).reshape(3, 4)
    for mask in (np.ones((3, 4), np.bool_), np.zeros((3, 4), np.bool_)):
        settled = values.copy()
        settle_holes(settled, mask, Layout.single((3, 4), (False, False), (7, 7)))
        assert np.array_equal(settled, values)
