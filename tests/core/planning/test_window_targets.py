"""Windows with limits: the errors told with every state hold inside the window, and no stop comes too early."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray

import lodestream as ls
from lodestream.container import Index
from lodestream.planning.planner import plan
from lodestream.planning.selection import selection_of
from lodestream.planning.window_errors import WindowErrors, WindowFigures, read_window_errors, window_section
from lodestream.target import Region
from tests.examples import examples

from ..surfaces import index_of
from .test_region import surface_of

KINDS = ["integers", "floats", "closed", "xyz", "holes", "plane", "attributes", "terraces"]
SHAPES = [(300, 290), (20, 700), (60, 80), (530, 9)]
CONTAINERS: dict[tuple[str, int, bool], tuple[ls.Surface, bytes]] = {}


def encoded(kind: str, shape: int, single: bool) -> tuple[ls.Surface, bytes]:
    if (kind, shape, single) not in CONTAINERS:
        surface = surface_of(kind, *SHAPES[shape])
        CONTAINERS[kind, shape, single] = surface, ls.encode(surface, rms="0.1%" if single else None)
    return CONTAINERS[kind, shape, single]


def windows_of(container: bytes, index: Index) -> WindowErrors | None:
    return read_window_errors(index, lambda offset, length: container[offset : offset + length])


def within(surface: ls.Surface, found: ls.Surface, region: Region) -> tuple[float, float]:
    """RMS and maximum of the distances of a window from the original."""
    place = slice(*region[0]), slice(*region[1])
    wanted, got = (np.asarray(array, np.float64) for array in (surface.points[place], found.points))
    finite = np.isfinite(wanted)
    valid: NDArray[Any] = finite if wanted.ndim == 2 else np.all(finite, axis=2)
    if surface.mask is not None:
        valid &= surface.mask[place]
    apart = wanted[valid] - got[valid]
    squares = apart**2 if wanted.ndim == 2 else (apart**2).sum(axis=1)
    return (math.sqrt(squares.mean()), math.sqrt(squares.max())) if squares.size else (0.0, 0.0)


def views_of(container: bytes, index: Index, target: ls.Target, windows: WindowErrors | None) -> list[ls.View]:
    chosen = plan(index, target, windows=windows)
    decoder = ls.Decoder(selection_of(target))
    views = []
    for place in chosen.slices:
        views += decoder.feed_at(place.offset, container[place.offset : place.end])
    told = {(view.number, view.bytes, view.rms, view.max_error) for view in views}
    if target.order == "quality":
        assert {(mark.number, mark.bytes, mark.rms, mark.max_error) for mark in chosen.marks} <= told
    return views


@examples(20)
@given(
    st.tuples(st.sampled_from(KINDS), st.integers(0, 3), st.booleans()),
    st.tuples(st.floats(0, 1), st.floats(0, 1), st.floats(0, 1), st.floats(0, 1)),
    st.sampled_from(["until_rms", "until_max"]),
    st.floats(-5, -0.5),
    st.sampled_from(["quality", "quality", "level"]),
    st.booleans(),
)
@pytest.mark.long
def test_what_is_told_holds_and_no_stop_comes_too_early(
    kind: tuple[str, int, bool], corners: tuple[float, ...], limit: str, share: float, order: Any, with_own: bool
) -> None:
    surface, container = encoded(*kind)
    index = index_of(container)
    rows, columns = surface.points.shape[:2]
    top, bottom = sorted(int(corner * (rows - 1)) for corner in corners[:2])
    left, right = sorted(int(corner * (columns - 2)) for corner in corners[2:])
    region = (top, bottom + 1), (left, right + 2)  # a surface has two points
    tolerance = 10**share * index.header.extent
    limits: dict[str, Any] = {limit: ls.Tolerance(tolerance)}
    target = ls.Target(region=region, order=order, **limits)
    windows = windows_of(container, index) if with_own else None
    views = views_of(container, index, target, windows)
    place = slice(*region[0]), slice(*region[1])
    if "holes" in kind and not np.isfinite(surface.points[place]).any():
        return
    slack = 1e-6 * index.header.extent if kind[0] == "plane" else 1e-12 * index.header.extent
    for view in views[:: max(len(views) // 6, 1)] + views[-1:]:
        rms, worst = within(surface, view.surface(), region)
        assert rms <= view.rms * (1 + 1e-9) + slack
        assert worst <= view.max_error * (1 + 1e-9) + slack
        assert view.bound == (view.max_error > 0 and (rows, columns) != tuple(b - a for a, b in region))
    chosen = plan(index, target, windows=windows)
    if chosen.ended != "complete":
        assert chosen.ended == limit.removeprefix("until_")
        assert (rms if limit == "until_rms" else worst) <= tolerance * (1 + 1e-9) + slack


def test_a_stop_by_own_bounds_comes_sooner_than_by_those_of_the_whole() -> None:
    rng = np.random.default_rng(1)
    heights = np.zeros((512, 512), np.float32)
    heights[:256] = rng.normal(size=(256, 512)).cumsum(axis=1)
    container = ls.encode(heights)
    index = index_of(container)
    windows = windows_of(container, index)
    assert windows is not None
    target = ls.Target(region=((300, 400), (300, 400)), until_max=ls.Tolerance(1e-2, relative=True))
    near, far = plan(index, target, windows=windows), plan(index, target)
    assert near.bytes < far.bytes
    assert (near.ended, far.before) == ("max", (index.index,))
    assert near.before == (index.index, window_section(index))
    # Receivers of earlier releases know nothing of it.
    plain = plan(index, target, windows=windows, bounded=False)
    assert plain.before == (index.index,)
    assert all(math.isnan(mark.rms) for mark in plain.marks[:-1])
    assert plain.ended == "complete"


def test_the_whole_surface_as_a_window_has_its_measured_errors() -> None:
    _, container = encoded("integers", 0, False)
    index = index_of(container)
    marks = plan(index, ls.Target(region=((0, 300), (0, 290))), windows=windows_of(container, index)).marks
    assert [(m.rms, m.max_error) for m in marks[:-1]] == [(r.rms, r.max_error) for r in index.layers][: len(marks) - 1]


def test_where_all_of_a_window_may_be_holes_the_maximum_bounds_its_rms() -> None:
    _, container = encoded("holes", 0, False)
    header = index_of(container).header
    assert sum(header.holes) > 2000
    assert WindowFigures(header, ((0, 40), (0, 50))).within(3.0, 9.0) == (9.0, 9.0)
    assert WindowFigures(header, ((0, 290), (0, 290))).within(3.0, 9.0)[0] < 3.2


def test_a_section_that_is_most_of_the_container_is_left_alone() -> None:
    _, container = encoded("floats", 0, False)
    index = index_of(container)
    section = window_section(index)
    assert section is not None
    assert section == index.optional[0].range
    for size, kept in ((8 * section.length, section), (8 * section.length - 1, None)):
        assert window_section(replace(index, size=size)) == kept


def test_a_region_outside_is_refused() -> None:
    _, container = encoded("floats", 0, False)
    with pytest.raises(ls.OptionError):
        WindowFigures(index_of(container).header, ((0, 301), (0, 5)))
