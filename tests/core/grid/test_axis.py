from __future__ import annotations

import itertools

import numpy as np
import pytest
from numpy.typing import NDArray

from lodestream.grid.axis import AxisStep, axis_lengths, axis_step, coarse_length, extension

from ..transform import reference_steps as reference
from ..transform.refinement import refinement_matrix


@pytest.mark.parametrize("closed", [False, True])
def test_coarse_lengths_are_those_of_the_definition(closed: bool) -> None:
    for length in range(1, 200):
        assert coarse_length(length, closed) == reference.coarse(length, closed)
        assert coarse_length(length, closed) == refinement_matrix(length, closed).shape[1]


def test_an_axis_stops_at_two_nodes_or_closed_at_three_or_four() -> None:
    for length in range(2, 300):
        assert axis_lengths(length, False)[0] == 2
    for length in range(3, 300):
        assert axis_lengths(length, True)[0] in (3, 4)
    assert axis_lengths(1, False) == [1]
    assert axis_lengths(1, True) == [1]
    assert axis_lengths(4097, False)[-1] == 4097
    assert len(axis_lengths(4097, False)) == 13


def test_an_axis_that_stops_is_coarsened_while_its_length_is_odd() -> None:
    assert axis_lengths(13, False, stops=True) == [4, 7, 13]
    assert axis_lengths(12, False, stops=True) == [12]
    assert axis_step(12, False, (True, True), stops=True) == AxisStep(12, 12, 0, 12, False, True, True)
    for length in range(1, 100):
        lengths = axis_lengths(length, False)
        kept = [n for n in lengths if all(m % 2 for m in lengths if m > n)]
        assert axis_lengths(length, False, stops=True) == kept
        assert axis_lengths(length, True, stops=True) == axis_lengths(length, True)


def test_nodes_and_midpoints_of_a_step_account_for_every_sample() -> None:
    for length, closed in itertools.product(range(1, 60), (False, True)):
        step = axis_step(length, closed)
        assert step.length == length == step.coarse + step.midpoints
        nodes, links = step.run, step.run if step.wraps else step.run - 1
        if step.midpoints:
            assert step.midpoints == links
            assert step.tail == (nodes == step.coarse - 1) == (not closed and length % 2 == 0)
            assert step.wraps == (closed and length % 2 == 0)
        else:
            assert step.coarse == length


def test_the_end_beyond_a_gap_is_free_and_closed_axes_have_no_clamped_ends() -> None:
    assert axis_step(9, False, (True, True)) == AxisStep(9, 5, 4, 5, False, True, True)
    assert axis_step(10, False, (True, True)) == AxisStep(10, 6, 4, 5, False, True, False)
    assert axis_step(9, True, (True, True)) == AxisStep(9, 5, 4, 5, False, False, False)
    assert axis_step(10, True, (True, True)) == AxisStep(10, 5, 5, 5, True, False, False)


def test_extension_repeats_with_the_period_of_its_ends() -> None:
    for count, left, right in itertools.product(range(1, 8), (False, True), (False, True)):
        period = {0: 2 * (count + 1), 1: 2 * count + 1, 2: 2 * count}[left + right]
        details = np.arange(1, count + 1)
        line = _line(details, extension(count, left, right, False, 40))
        np.testing.assert_array_equal(line[:-period], line[period:])
        assert line[40 - 1] == (-1 if left else 0)
        assert line[40 + count] == (-count if right else 0)
    np.testing.assert_array_equal(_line(np.arange(1, 4), extension(3, False, False, True, 4)), [3, *[1, 2, 3] * 3, 1])


def _line(details: NDArray[np.int64], table: NDArray[np.int64]) -> NDArray[np.int64]:
    """Details with what lies beyond their ends."""
    reach = len(table) // 2
    outside = details[table[:, 0]] * table[:, 1]
    return np.concatenate([outside[:reach], details, outside[reach:]])
