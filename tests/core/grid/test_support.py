"""The coefficients that samples of an axis need, against the definition: those whose change changes the samples."""

from __future__ import annotations

import numpy as np
import pytest

from lodestream.grid.axis import AxisStep, axis_step
from lodestream.grid.support import Mask, coefficients_needed
from lodestream.transform.lifting import inverse_step

#: Shows the last tap of an update, 2**-24, in both directions, and stays within the limit of the inverse.
LARGE = 2**26

#: Whether an axis is closed, and which of its ends are clamped.
ENDS = [
    (False, (False, False)),
    (False, (True, False)),
    (False, (False, True)),
    (False, (True, True)),
    (True, (False, False)),
]


def changed(step: AxisStep) -> Mask:
    """Which coefficients change which samples, shape (sample, coefficient): each is changed by itself."""
    found = np.zeros((step.length, step.length), np.bool_)
    for predictor in ((127, -127), (32, -7)):
        for change in (LARGE, -LARGE):
            lines = np.eye(step.length, dtype=np.int32) * np.int32(change)
            inverse_step(lines, 0, step, predictor)
            found |= lines != 0
    return found


@pytest.mark.parametrize(("closed", "clamped"), ENDS)
def test_a_coefficient_is_needed_if_its_change_changes_a_sample(closed: bool, clamped: tuple[bool, bool]) -> None:
    for length in range(1, 60):
        step = axis_step(length, closed, clamped)
        parts = changed(step)
        needed = np.array([coefficients_needed(sample, step) for sample in np.eye(length, dtype=np.bool_)])
        assert not (parts & ~needed).any(), length
        # A clamped end is left as it is: the details that a formula takes there cancel. So they do, by chance, where
        # the nodes are four in a circle; and two nodes have no third step.
        as_it_is = [0] * step.left + [length - 1] * step.right
        if length > 4 and not (closed and length == 8):
            inner = np.delete(np.arange(length), as_it_is)
            np.testing.assert_array_equal(needed[inner], parts[inner], str(length))


@pytest.mark.parametrize(("closed", "clamped"), ENDS)
def test_several_samples_need_what_each_of_them_needs(closed: bool, clamped: tuple[bool, bool]) -> None:
    for length in (3, 4, 8, 9, 40, 41):
        step = axis_step(length, closed, clamped)
        each = np.array([coefficients_needed(sample, step) for sample in np.eye(length, dtype=np.bool_)])
        for start in range(length):
            for stop in range(start + 1, length + 1):
                span = (np.arange(length) >= start) & (np.arange(length) < stop)
                np.testing.assert_array_equal(coefficients_needed(span, step), each[span].any(axis=0))
