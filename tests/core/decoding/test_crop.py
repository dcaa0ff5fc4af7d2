"""The reconstruction of a window is what the reconstruction of the whole has there, in every state."""

from __future__ import annotations

import functools
from typing import TYPE_CHECKING

import numpy as np
import pytest
from numpy.typing import NDArray

import lodestream as ls
from lodestream.decoding.crop import crop_across_seam, crop_axis
from lodestream.grid.axis import axis_step
from lodestream.planning.selection import Selection
from lodestream.transform.lifting import forward_step, inverse_step

#: What a container does not keep is another matter, see test_losses.
pytestmark = pytest.mark.filterwarnings("ignore:values of attributes at:lodestream.FormatWarning")

if TYPE_CHECKING:
    pass

CLOSURES = [(False, False), (True, False), (False, True), (True, True)]


@pytest.mark.parametrize("closed", [False, True])
def test_what_a_step_takes_of_an_axis_gives_what_is_wanted(closed: bool) -> None:
    for length in range(1, 70):
        step = axis_step(length, closed)
        for start in range(0, length, 3):
            for stop in range(start + 1, length + 1, 4):
                crop = crop_axis(step, start, stop)
                assert crop.start >= 0
                assert crop.start + stop - start <= crop.step.length
                assert 0 <= crop.first <= crop.first + crop.step.coarse <= step.coarse
                assert crop.step.coarse + crop.step.midpoints == crop.step.length
                assert crop.step.length <= max(stop - start + 60, 4) or step.wraps


@pytest.mark.parametrize("closed", [False, True])
def test_what_a_step_takes_across_the_seam_gives_what_is_wanted(closed: bool) -> None:
    """Undone crop by crop, they are the samples of the axis that goes on from its last one with the first."""
    rng = np.random.default_rng(5)
    for length in [*range(1, 75), 120, 121]:
        step = axis_step(length, closed)
        rule = (16, 0) if length % 2 else (22, -2)
        whole = np.cumsum(rng.integers(-90, 90, (length, 2)), axis=0).astype(np.int32)
        line = whole.copy()
        forward_step(line, 0, step, rule)
        nodes, details = line[: step.coarse], line[step.coarse :]
        for start in range(0, length, 3):
            for stop in range(start + 1, (start if closed else 0) + length + 1, 4):
                found = crop_across_seam(step, start, stop)
                taken, made = [], []
                for crop in found.crops:
                    own = np.arange(crop.first, crop.first + crop.step.coarse)
                    taken += own.tolist()
                    beside = np.arange(crop.first, crop.first + crop.step.midpoints)
                    # Only where an axis wraps a crop goes on beyond its last nodes.
                    assert step.wraps or own[-1] < step.coarse
                    part = [np.take(nodes, own, 0, mode="wrap")]
                    part += [np.take(details, beside, 0, mode="wrap")] if beside.size else []
                    samples = np.concatenate(part)
                    assert len(samples) == crop.step.length
                    inverse_step(samples, 0, crop.step, rule)
                    made.append(samples)
                assert np.array_equal(np.array(taken) % step.coarse, np.arange(*found.nodes) % step.coarse)
                assert 0 <= found.nodes[0] < step.coarse
                assert found.nodes[1] - found.nodes[0] <= step.coarse
                every = np.concatenate(made)
                wanted = np.concatenate([every[slice(*span)] for span in found.wanted])
                assert np.array_equal(wanted, np.take(whole, np.arange(start, stop), 0, mode="wrap"))
                assert len(every) <= stop - start + 120


@pytest.mark.parametrize("length", [73, 120, 121])
@pytest.mark.parametrize("rule", [(16, 0), (127, -127)])
def test_rough_samples_need_all_that_a_step_takes_beside_them(length: int, rule: tuple[int, int]) -> None:
    """Differences of millions show the smallest weights, which those of hundreds round away."""
    step = axis_step(length, length > 73)
    whole = np.random.default_rng(5).integers(-(1 << 20), 1 << 20, (length, 2)).astype(np.int32)
    line = whole.copy()
    forward_step(line, 0, step, rule)
    nodes, details = line[: step.coarse], line[step.coarse :]
    for start in range(length - 9):
        for stop in (start + 1, start + 9):
            found, made = crop_across_seam(step, start, stop), []
            for crop in found.crops:
                ranges = (np.arange(crop.first, crop.first + n) for n in (crop.step.coarse, crop.step.midpoints))
                parts = [np.take(of, own, 0, mode="wrap") for of, own in zip((nodes, details), ranges, strict=True)]
                made.append(np.concatenate(parts))
                inverse_step(made[-1], 0, crop.step, rule)
            every = np.concatenate(made)
            wanted = np.concatenate([every[slice(*span)] for span in found.wanted])
            np.testing.assert_array_equal(wanted, whole[start:stop])


@functools.cache
def surfaces() -> dict[str, ls.Surface]:
    rows, columns = np.mgrid[:300, :340].astype(float)
    heights = np.rint(200 * np.sin(rows / 40) * np.cos(columns / 30) + np.random.default_rng(2).normal(size=(300, 340)))
    across = np.linspace(0.1, 7.7, 340)  # a rule whose last number is given
    xyz: NDArray[np.float64] = np.stack([np.broadcast_to(across, heights.shape), rows * 0.1, heights], axis=2)
    holes = np.hypot(rows - 100, columns - 100) < 30
    return {
        "linspace": ls.Surface(xyz),
        "bands": ls.Surface(
            heights.astype(np.float32) / 3,
            mask=~holes,
            attributes={"rgb": rng_colours(heights), "t": heights / 7},
            metadata={"geotransform": [5e5, 30.0, 0.0, 4e6, 0.0, -30.0]},
        ),
        "wide": ls.Surface((heights * 2**40).astype(np.int64)),
        "torus": ls.Surface(np.rint(heights * 9).astype(np.int32), (True, True)),
        "odd cylinder": ls.Surface(heights[:, :339], (False, True)),
    }


@functools.cache
def contained(kind: str) -> bytes:
    return ls.encode(surfaces()[kind])


def rng_colours(heights: NDArray[np.float64]) -> NDArray[np.uint8]:
    return (np.stack([heights, heights + 9, heights * 3], axis=2) % 256).astype(np.uint8)


@pytest.mark.parametrize("kind", list(surfaces()))
def test_every_view_of_a_window_is_cut_out_of_the_whole(kind: str) -> None:
    surface = surfaces()[kind]
    decoder = ls.Decoder()
    decoder.feed(contained(kind))
    rng = np.random.default_rng(1)
    for view in decoder.layers[:: max(len(decoder.layers) // 5, 1)] + decoder.layers[-1:]:
        (top, bottom), (left, right) = (sorted(rng.choice(n, 2, replace=False)) for n in surface.shape)
        region = (int(top), int(bottom)), (int(left), int(right))
        place = slice(top, bottom), slice(left, right)
        window, whole = view.window(region), view.surface()
        assert window.points.dtype == surface.dtype
        if view.complete:
            assert window.points.tobytes() == np.ascontiguousarray(whole.points[place]).tobytes()
            for name, values in window.attributes.items():
                assert values.tobytes() == np.ascontiguousarray(whole.attributes[name][place]).tobytes()
        if surface.points.ndim == 3:  # x and y follow a rule that knows the whole
            assert window.points[..., :2].tobytes() == np.ascontiguousarray(whole.points[place][..., :2]).tobytes()
        valid = np.ones(window.shape, np.bool_)
        np.testing.assert_array_equal(
            valid if window.mask is None else window.mask, valid if whole.mask is None else whole.mask[place]
        )
        if "geotransform" in surface.metadata:
            assert window.metadata["geotransform"] == [5e5 + 30 * left, 30, 0, 4e6 - 30 * top, 0, -30]


def test_a_window_of_holes_alone_is_refused() -> None:
    decoder = ls.Decoder(Selection(((95, 105), (95, 105))))
    decoder.feed(contained("bands"))
    with pytest.raises(ls.InputError):
        decoder.surface()
