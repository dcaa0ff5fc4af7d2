from __future__ import annotations

import itertools
from typing import Any
from unittest.mock import Mock, patch

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray

from lodestream import kernels
from lodestream.grid.axis import AxisStep, axis_step
from lodestream.transform import lifting
from lodestream.transform.lifting import CLAMP, TAPS, forward_step, inverse_step

from . import reference_steps as reference
from .reference_steps import CLOSED, FREE, Ends
from .refinement import refinement_matrix

LARGEST = 2**24
#: Every kind of end.
ENDS = [FREE, Ends(left=True), Ends(right=True), Ends(left=True, right=True), CLOSED]
PREDICTORS = [(0, 0), (16, 0), (32, -7), (127, -127), (-127, 127), (-3, 90)]

Ints = NDArray[np.int32]


def step_of(length: int, ends: Ends) -> AxisStep:
    return axis_step(length, ends.closed, (ends.left, ends.right))


def random_grid(shape: tuple[int, int], seed: int, largest: int = LARGEST) -> Ints:
    return np.random.default_rng(seed).integers(-largest, largest, shape, np.int32, endpoint=True)


def hardest_lines(length: int) -> list[list[int]]:
    """Lines that drive levels and coefficients far out: alternating, impulses, steps, and the signs of the filters."""
    k = np.arange(length)
    signs = [
        k * 0 + 1,
        1 - 2 * (k % 2),
        1 - 2 * (k // 2 % 2),
        1 - 2 * ((k + 1) // 2 % 2),
        1 - 2 * (k // 3 % 2),
        np.where(k < length // 2, 1, -1),
        np.where(k == length // 2, 1, -1),
        # What makes the update of the middle node as large as can be: midpoints alternate with the taps' signs.
        np.where(k % 2 == 0, -1, 1 - 2 * (abs(k - length // 2) // 2 % 2)),
        np.where(k % 2 == 0, 1, 1 - 2 * (abs(k - length // 2) // 2 % 2)),
    ]
    return [[int(s) * LARGEST for s in line] for line in signs]


def test_the_taps_are_the_optimum_s_and_sum_to_a_quarter() -> None:
    exact = (1 - 1 / np.sqrt(2)) * (2 * np.sqrt(2) - 3) ** np.arange(len(TAPS))
    assert TAPS.sum() == 2**22
    assert np.abs(TAPS / 2**24 - exact).max() < 1.5 / 2**24


@pytest.mark.parametrize("axis", [0, 1])
@pytest.mark.parametrize("ends", ENDS)
def test_a_step_is_that_of_the_reference(ends: Ends, axis: int) -> None:
    for length, predictor in itertools.product(range(1, 41), PREDICTORS):
        lines = random_grid((length, 5), length)
        lines[:, 3] = np.arange(length) ** 2
        ours = np.array(lines if axis == 0 else lines.T, order="C")
        forward_step(ours, axis, step_of(length, ends), predictor)
        expected = reference.forward(lines.astype(np.int64), ends, *predictor).astype(np.int32)
        np.testing.assert_array_equal(ours if axis == 0 else ours.T, expected)


def stepped(lines: Ints, axis: int, step: AxisStep, predictor: tuple[int, int], inverse: bool) -> Ints:
    """The step of lines along axis 0, made along either axis."""
    ours = np.array(lines if axis == 0 else lines.T, order="C")
    (inverse_step if inverse else forward_step)(ours, axis, step, predictor)
    return ours if axis == 0 else ours.T


@pytest.mark.parametrize("ends", ENDS)
@pytest.mark.parametrize(("axis", "nodes"), [(0, range(31, 57)), (0, range(84, 87)), (1, range(2067, 2069))])
def test_chunks_of_nodes_leave_no_trace(ends: Ends, axis: int, nodes: range) -> None:
    """The kernel works on 32 nodes of a strip at a time, and on 2048 of a row; at the end on up to 19 more."""
    for count, odd in itertools.product(nodes, (0, 1)):
        length, predictor = 2 * count - odd, PREDICTORS[count % len(PREDICTORS)]
        lines = random_grid((length, 17 if axis == 0 else 1), count)
        coefficients = reference.forward(lines.astype(np.int64), ends, *predictor).astype(np.int32)
        step = step_of(length, ends)
        np.testing.assert_array_equal(stepped(lines, axis, step, predictor, False), coefficients)
        coefficients >>= 3
        samples = reference.inverse(coefficients.astype(np.int64), ends, *predictor)
        np.testing.assert_array_equal(stepped(coefficients, axis, step, predictor, True), samples)


@pytest.mark.parametrize("ends", ENDS)
@pytest.mark.parametrize(("axis", "width"), [(0, 16), (0, 64), (0, 83), (1, 3)])
def test_details_that_just_fit_16_bits_are_stepped_as_others_are(ends: Ends, axis: int, width: int) -> None:
    """Where processors can, short details are multiplied two by two."""
    rng = np.random.default_rng(width)
    for length, largest in itertools.product((9, 64, 150), (1, 2**12, 2**15 - 1, 2**15, 2**15 + 1)):
        step = step_of(length, ends)
        lines = rng.choice(np.array([-largest, 1 - largest, -1, 0, largest - 1, largest], np.int32), (length, width))
        # All with the signs of the taps round one node, which makes its update as large as can be.
        lines[step.coarse :, 0] = largest * (1 - 2 * (abs(np.arange(step.midpoints) - step.midpoints // 2) % 2))
        samples = reference.inverse(lines.astype(np.int64), ends, 0, 0)
        np.testing.assert_array_equal(stepped(lines, axis, step, (0, 0), True), samples)
        coefficients = reference.forward(lines.astype(np.int64), ends, 16, -2)
        np.testing.assert_array_equal(stepped(lines, axis, step, (16, -2), False), coefficients)


@pytest.mark.parametrize("ends", [FREE, CLOSED])
@pytest.mark.parametrize(("axis", "shape", "several"), [(1, (1, 4_260_004), (2, 1)), (0, (66_604, 64), (1, 2))])
def test_long_lines_take_several_calls_and_come_out_as_in_one(
    ends: Ends, axis: int, shape: tuple[int, int], several: tuple[int, int]
) -> None:
    """Lines that the kernel does not take together are done in one call."""
    step = step_of(shape[axis], ends)
    work = np.empty((step.midpoints + step.run + 25) * (64 if axis == 0 else 1) + 16, np.int32)
    for inverse in (0, 1):
        lines = random_grid(shape, inverse, 2**16)
        whole = np.tile(lines, several)
        fixed = step.midpoints, step.run, step.extension(10), 32, -7
        assert kernels.lift(inverse, axis, whole, *fixed, 0, work) == step.run
        calls, done = 0, 0
        while done < step.run:
            done, calls = kernels.lift(inverse, axis, lines, *fixed, done, work), calls + 1
        assert calls > 1
        np.testing.assert_array_equal(np.tile(lines, several), whole)


@pytest.mark.parametrize("at_once", [1, 500, 4000])
def test_lines_are_divided_between_calls(at_once: int) -> None:
    for axis, width in itertools.product((0, 1), (1, 15, 64, 70, 143, 200)):
        lines = random_grid((21, width), width)
        expected = reference.forward(lines.astype(np.int64), FREE, 32, -7)
        lift = Mock(wraps=kernels.lift)
        with patch.object(lifting, "_SAMPLES_PER_CALL", at_once), patch.object(kernels, "lift", lift):
            ours = stepped(lines, axis, axis_step(21), (32, -7), False)
            np.testing.assert_array_equal(ours, expected)
            planes = [call.args[2].size for call in lift.call_args_list]
            np.testing.assert_array_equal(stepped(ours, axis, axis_step(21), (32, -7), True), lines)
        assert sum(planes) == lines.size
        assert max(planes) <= max(at_once, 21 * 64)


def test_strips_of_columns_and_strided_windows_make_no_difference() -> None:
    for width in (1, 63, 64, 65, 130):
        lines = random_grid((23, width), width)
        window = np.zeros((46, 2 * width + 7), np.int32)[3:26, 5 : 5 + width]
        window[:] = lines
        expected = reference.forward(lines.astype(np.int64), FREE, 32, -7)
        forward_step(window, 0, axis_step(23), (32, -7))
        np.testing.assert_array_equal(window, expected)
        inverse_step(window, 0, axis_step(23), (32, -7))
        np.testing.assert_array_equal(window, lines)


@pytest.mark.parametrize("kind", range(len(ENDS)))
def test_every_pair_of_sizes_is_inverted_exactly(kind: int) -> None:
    for rows, columns in itertools.product(range(1, 41), repeat=2):
        # The strong predictors at the full amplitude would make coefficients beyond 28 bits, which no writer does.
        predictors = PREDICTORS[(rows + kind) % 4], PREDICTORS[(columns + rows // 4) % 4]
        original = random_grid((rows, columns), 41 * rows + columns, 2**18 if (127, -127) in predictors else LARGEST)
        # Along axis 1 the kind of end changes with the sizes, so that every kind meets every other.
        steps = step_of(rows, ENDS[kind]), step_of(columns, ENDS[(kind + rows + columns) % len(ENDS)])
        values = original.copy()
        for axis in (0, 1):
            forward_step(values, axis, steps[axis], predictors[axis])
        for axis in (1, 0):
            inverse_step(values, axis, steps[axis], predictors[axis])
        if not np.array_equal(values, original):
            pytest.fail(f"{rows} x {columns}, {steps}, {predictors} was not inverted exactly")
        assert values.shape == (rows, columns)


@given(
    length=st.integers(1, 150),
    width=st.integers(1, 4),
    ends=st.sampled_from(ENDS),
    a=st.integers(-127, 127),
    b=st.integers(-127, 127),
    largest=st.sampled_from([1, 3, 1000, LARGEST]),
    seed=st.integers(0, 2**32),
)
def test_any_line_comes_back(length: int, width: int, ends: Ends, a: int, b: int, largest: int, seed: int) -> None:
    original = random_grid((length, width), seed, largest)
    values = original.copy()
    forward_step(values, 0, step_of(length, ends), (a, b))
    np.testing.assert_array_equal(values, reference.forward(original.astype(np.int64), ends, a, b))
    inverse_step(values, 0, step_of(length, ends), (a, b))
    np.testing.assert_array_equal(values, original)


@pytest.mark.parametrize("ends", ENDS)
def test_nodes_do_not_depend_on_the_third_step(ends: Ends) -> None:
    for length in (3, 4, 9, 10, 31):
        bare, predicted = random_grid((length, 3), length), random_grid((length, 3), length)
        step = step_of(length, ends)
        forward_step(bare, 0, step, (0, 0))
        forward_step(predicted, 0, step, (127, -127))
        np.testing.assert_array_equal(bare[: step.coarse], predicted[: step.coarse])


@pytest.mark.parametrize("ends", ENDS)
def test_nodes_are_the_least_squares_optimum_with_clamped_ends_held(ends: Ends) -> None:
    for length in range(3, 41):
        lines = random_grid((length, 6), length, 2**20)  # noise of more bits meets the rounding of the taps
        step = step_of(length, ends)
        refined = refinement_matrix(length, ends.closed)
        held = [0] * (step.left and step.midpoints > 0) + [step.coarse - 1] * (step.right and step.midpoints > 0)
        free = [k for k in range(step.coarse) if k not in held]
        best = np.zeros((step.coarse, 6))
        best[held] = lines[[0 if k == 0 else length - 1 for k in held]]
        best[free] = np.linalg.lstsq(refined[:, free], lines - refined @ best, rcond=None)[0]
        forward_step(lines, 0, step, (16, 0))
        assert np.abs(lines[: step.coarse] - best).max() <= 4
        np.testing.assert_array_equal(lines[held], best[held])


@pytest.mark.parametrize("ends", ENDS)
def test_the_hardest_lines_stay_within_the_bounds(ends: Ends) -> None:
    """Ten steps of a line: levels below 2**26, bare details below 2**27, and all of them come back."""
    for length in (16, 17, 33, 64, 65, 129, 256, 1025):
        lines = np.array(hardest_lines(length), np.int32).T.copy()
        levels, work = [lines.copy()], lines
        while (step := step_of(len(work), ends)).midpoints:
            forward_step(work, 0, step, (0, 0))
            assert np.abs(work[: step.coarse]).max() < 2**26
            assert np.abs(work[step.coarse :]).max() < 2**27
            work = work[: step.coarse]
            levels.append(work.copy())
        np.testing.assert_array_equal(lines[: len(work)], levels[-1])
        for level in levels[-2::-1]:
            inverse_step(lines[: len(level)], 0, step_of(len(level), ends), (0, 0))
            np.testing.assert_array_equal(lines[: len(level)], level)


def test_sums_stay_below_2_to_the_51_where_nothing_overflows() -> None:
    """The largest update of any line within +-2**24: every detail 2**25, of the sign of its tap."""
    worst = 2 * 2**25 * int(np.abs(TAPS).sum())
    assert worst + 3 * 2**21 < 2**51


@pytest.mark.parametrize("ends", ENDS)
@pytest.mark.parametrize("predictor", PREDICTORS)
def test_hostile_coefficients_stay_within_the_limit_and_are_those_of_exact_integers(
    ends: Ends, predictor: tuple[int, int]
) -> None:
    extreme = 2**28 - 1
    for length in (2, 3, 4, 5, 6, 7, 8, 12, 19, 40):
        rng = np.random.default_rng(length)
        hostile = rng.choice(np.array([-extreme, extreme], np.int32), (length, 40))
        hostile[:, ::3] = rng.integers(-extreme, extreme, hostile[:, ::3].shape, endpoint=True)
        hostile[:, 1] = extreme
        hostile[:, 2] = extreme * (1 - 2 * (np.arange(length) % 2))
        expected = reference.inverse(hostile.astype(object), ends, *predictor)
        ours = hostile.copy()
        step = step_of(length, ends)
        inverse_step(ours, 0, step, predictor)
        np.testing.assert_array_equal(ours.astype(object), expected)
        assert not step.midpoints or np.abs(ours).max() <= CLAMP


@pytest.mark.parametrize("ends", ENDS)
@pytest.mark.parametrize("predictor", [*PREDICTORS, (1, 0)])
def test_nodes_far_out_that_rise_slowly_or_steeply_are_those_of_exact_integers(
    ends: Ends, predictor: tuple[int, int]
) -> None:
    """Whether sums are taken in 32 or in 64 bits depends on the rises alone, and makes no difference."""
    extreme = 2**28 - 1
    for length, bits in itertools.product((6, 7, 12, 19), range(4, 30)):
        step, rng = step_of(length, ends), np.random.default_rng(bits)
        lines = rng.integers(-(2**18), 2**18, (length, 3), np.int32)
        rises = rng.integers(-(2**bits), 2**bits, (step.coarse, 3)).cumsum(axis=0)
        lines[: step.coarse] = np.clip(rng.choice([-extreme, extreme], 3) + rises, -extreme, extreme)
        ours = lines.copy()
        inverse_step(ours, 0, step, predictor)
        np.testing.assert_array_equal(
            ours.astype(object), reference.inverse(lines.astype(object), ends, *predictor), f"{length}, {bits}"
        )


@pytest.mark.parametrize("predictor", PREDICTORS)
def test_details_at_the_limit_of_32_bits_are_those_of_exact_integers(predictor: tuple[int, int]) -> None:
    """Sums are taken in 32 bits while no detail is beyond 2**18."""
    for bits, length in itertools.product((2**18 - 1, 2**18, 2**18 + 1, 2**19), (9, 40, 41)):
        lines = np.zeros((length, 24), np.int32)
        signs = np.sign(TAPS[[*range(9, -1, -1), *range(10)]]).astype(np.int32)
        step = axis_step(length)
        for column in range(24):
            place = step.coarse + np.arange(20) - column + 2
            inside = (place >= step.coarse) & (place < length)
            lines[place[inside], column] = (bits * signs)[inside]
        expected = reference.inverse(lines.astype(object), FREE, *predictor)
        np.testing.assert_array_equal(stepped(lines, 0, step, predictor, True).astype(object), expected)


@given(
    length=st.integers(1, 150),
    width=st.integers(1, 80),
    axis=st.integers(0, 1),
    ends=st.sampled_from(ENDS),
    predictor=st.sampled_from(PREDICTORS),
    seed=st.integers(0, 2**32),
)
def test_any_int32_gives_samples_within_the_limit(
    length: int, width: int, axis: int, ends: Ends, predictor: tuple[int, int], seed: int
) -> None:
    lines, step = random_grid((length, width), seed, 2**31 - 1), step_of(length, ends)
    samples = stepped(lines, axis, step, predictor, True)
    assert not step.midpoints or max(abs(int(samples.min())), int(samples.max())) <= CLAMP
    stepped(lines, axis, step, predictor, False)


def test_what_does_not_fit_is_refused() -> None:
    step, plane = axis_step(9), np.zeros((9, 20), np.int32)
    fitting: list[Any] = [0, 0, plane, 4, 5, step.extension(10), 16, 0, 0, np.empty(34 * 64 + 16, np.int32)]
    assert kernels.lift(*fitting) == 5
    far, turned = step.extension(10).copy(), step.extension(10).copy()
    far[3, 0], turned[3, 1] = 4, 2
    for place, value in [
        (2, plane[:8]),
        (2, plane[:0]),
        (2, plane[:, :0]),
        (3, 0),
        (3, 3),
        (4, 4),
        (4, 6),
        (5, far),
        (5, -far),
        (5, turned),
        (5, far[1:]),
        (6, 128),
        (6, -128),
        (7, 128),
        (7, -128),
        (8, -1),
        (8, 1),
        (8, 5),
        (9, np.empty(34 * 64 + 15, np.int32)),
    ]:
        with pytest.raises(ValueError, match="do not fit"):
            kernels.lift(*fitting[:place], value, *fitting[place + 1 :])
    long, work = np.zeros((2, 9001), np.int32), np.empty(9100, np.int32)
    for rows, start in ((1, 2048), (2, 0)):
        extension = axis_step(9001).extension(10)
        assert kernels.lift(0, 1, long[:rows], 4500, 4501, extension, 0, 0, start, work) == 4501
    with pytest.raises(ValueError, match="do not fit"):
        kernels.lift(0, 1, long, 4500, 4501, extension, 0, 0, 2048, work)


@given(shapes=st.tuples(st.integers(1, 90), st.integers(1, 90)), closed=st.booleans(), seed=st.integers(0, 2**32 - 1))
def test_a_bare_inverse_is_that_of_details_that_are_all_zero(shapes: tuple[int, int], closed: bool, seed: int) -> None:
    rng = np.random.default_rng(seed)
    for axis in (0, 1):
        step = axis_step(shapes[axis], closed)
        values = rng.integers(-5000, 5000, shapes).astype(np.int32)
        zeros = values.copy()
        (zeros if axis == 0 else zeros.T)[step.coarse :] = 0
        for array, bare in ((values, True), (zeros, False)):
            inverse_step(array, axis, step, (19, -3), bare)
        np.testing.assert_array_equal(values, zeros)
