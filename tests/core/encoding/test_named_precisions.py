"""Precisions of single coordinates and components hold, and all else comes back bit for bit."""

from __future__ import annotations

import io
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray

import lodestream as ls
from lodestream.decoding.inspection import inspect

from ..surfaces import terrain, torus

SHAPE = (40, 50)


def wind() -> NDArray[np.float64]:
    return np.stack([terrain(SHAPE, 1), terrain(SHAPE, 2), terrain(SHAPE, 3)], axis=2)


def errors(surface: ls.Surface, **options: Any) -> dict[str, float]:
    """The largest error of each channel of what comes back; the container is sound."""
    container = ls.encode(surface, **options)
    inspect(io.BytesIO(container), max_vertices=1 << 20)
    found: dict[str, float] = {}
    for own, back in zip(surface.blocks, ls.decode(container).blocks, strict=True):
        points, other = (each.points.astype("f8").reshape(*each.shape, -1) for each in (own, back))
        for name, error in zip(
            "z" if own.points.ndim == 2 else "xyz", np.abs(points - other).max(axis=(0, 1)), strict=False
        ):
            found[name] = max(found.get(name, 0.0), float(error))
        for name, values in own.attributes.items():
            parts = np.abs(values.astype("f8") - back.attributes[name]).reshape(*own.shape, -1).max(axis=(0, 1))
            for part, error in enumerate(parts):
                key = f"{name}_{part}" if values.ndim == 3 else name
                found[key] = max(found.get(key, 0.0), float(error))
    return found


@pytest.mark.parametrize("dtype", ["float32", "float64", "int32"])
def test_a_coordinate_has_its_own_and_the_others_are_exact(dtype: str) -> None:
    points = (torus(*SHAPE, "float64") * 1000).astype(dtype)
    surface = ls.Surface(points, (True, True), attributes={"n": terrain(SHAPE, 3)})
    found = errors(surface, attribute_precision={"z": 5})
    assert 1 <= found.pop("z") <= 5
    assert set(found.values()) == {0}
    found = errors(surface, precision="0.01%", attribute_precision={"z": "1%"})
    extent = np.sqrt((np.ptp(points.astype("f8"), axis=(0, 1)) ** 2).sum())
    assert np.hypot(found["x"], found["y"]) <= 1e-4 * extent
    assert 1e-4 * extent < found["z"] <= 1e-2 * np.ptp(points[..., 2])


@given(st.floats(1e-4, 5.0), st.floats(1e-4, 5.0))
def test_components_have_theirs_beside_that_of_the_whole(first: float, whole: float) -> None:
    surface = ls.Surface(terrain(SHAPE)[:9, :8], attributes={"wind": wind()[:9, :8]})
    found = errors(surface, attribute_precision={"wind_0": first})
    assert 0 < found["wind_0"] <= first
    assert found["z"] == found["wind_1"] == found["wind_2"] == 0
    found = errors(surface, attribute_precision={"wind_0": first, "wind": whole})
    assert 0 < found["wind_0"] <= first
    assert 0 < np.hypot(found["wind_1"], found["wind_2"]) <= whole


def test_heights_are_z_and_an_attribute_of_that_name_comes_first() -> None:
    surface = ls.Surface(terrain(SHAPE), attributes={"a": terrain(SHAPE, 1)})
    assert 0.1 < errors(surface, attribute_precision={"z": 0.5})["z"] <= 0.5
    named = ls.Surface(torus(*SHAPE), (True, True), attributes={"z": terrain(SHAPE)})
    back = ls.decode(ls.encode(named, attribute_precision={"z": 0.5}))
    assert np.array_equal(back.points, named.points)
    assert not np.array_equal(back.attributes["z"], named.attributes["z"])


def test_x_and_y_that_follow_a_rule_stay_exact_and_holes_stay_holes() -> None:
    y, x = np.mgrid[: SHAPE[0], : SHAPE[1]]
    points = np.stack([3.0 + 2 * x, 7.0 - y, terrain(SHAPE)], axis=2)
    mask = np.ones(SHAPE, np.bool_)
    mask[5:9, 5:9] = False
    surface = ls.Surface(points, mask=mask)
    back = ls.decode(ls.encode(surface, attribute_precision={"x": 0.5, "z": 0.25}))
    assert back.mask is not None
    assert np.array_equal(back.mask, mask)
    assert np.array_equal(back.points[mask][:, :2], points[mask][:, :2])
    assert 0 < np.abs(back.points - points)[mask].max() <= 0.25


def test_blocks_that_touch_stay_watertight() -> None:
    points = torus(*SHAPE, "float64")
    surface = ls.Surface(blocks=[ls.Block(points[:, :26]), ls.Block(points[:, 25:])])
    back = ls.decode(ls.encode(surface, attribute_precision={"z": 0.01}))
    assert np.array_equal(back.blocks[0].points[:, -1], back.blocks[1].points[:, 0])
    assert 0.001 < np.abs(back.blocks[1].points - points[:, 25:])[..., 2].max() <= 0.01
    assert np.array_equal(back.blocks[1].points[..., :2], points[:, 25:, :2])


def test_a_precision_holds_beside_noise_of_which_the_lattice_keeps_a_few_bits() -> None:
    rng = np.random.default_rng(0)
    noise = rng.integers(0, 2**31, size=(200, 200), dtype="u4").view("f4")
    noise[~(np.isfinite(noise) & (np.abs(noise) < 1e30))] = 1
    values = rng.integers(-30000, 30000, size=(200, 200)).astype("i2")
    parts = rng.normal(size=(200, 200, 2))
    surface = ls.Surface(noise, attributes={"a": values, "b": parts})
    back = ls.decode(ls.encode(surface, attribute_precision={"a": 1, "b_1": 1e-5}))
    assert np.array_equal(back.points, noise)
    assert np.abs(back.attributes["a"].astype("i4") - values).max() <= 1
    assert np.array_equal(back.attributes["b"][..., 0], parts[..., 0])
    assert np.abs(back.attributes["b"] - parts).max() <= 1e-5


def test_a_constant_channel_is_exact_whatever_share_of_its_range_is_allowed() -> None:
    surface = ls.Surface(np.full((5, 6), 3.25), attributes={"b": np.full((5, 6, 2), 7.5)})
    assert set(errors(surface, attribute_precision={"z": "0.1%", "b_0": "0.1%"}).values()) == {0}


@pytest.mark.parametrize(
    ("options", "words"),
    [
        (
            {"attribute_precision": {"x": 1}},
            "that could have a precision; there are wind, z, wind_0, wind_1, wind_2",
        ),
        ({"attribute_precision": {"wind_3": 1}}, "there is no 'wind_3' that could have a precision"),
        ({"rms": 0.5, "attribute_precision": {"z": 1}}, "expected either a root mean square error or a precision of z"),
        ({"attribute_precision": {"z": 0}}, "expected a precision above 0"),
    ],
)
def test_names_that_are_not_there_and_contradictions_are_refused(options: dict[str, Any], words: str) -> None:
    surface = ls.Surface(terrain(SHAPE), attributes={"wind": wind()})
    with pytest.raises((ls.OptionError, ls.InputError), match=words):
        ls.encode(surface, **options)


def test_components_are_named_in_streams_for_one_error_too() -> None:
    found = errors(
        ls.Surface(terrain(SHAPE), attributes={"wind": wind()}), rms=2.0, attribute_precision={"wind_1": 0.5}
    )
    assert 0 < found["wind_1"] <= 0.5
    assert found["wind_0"] == found["wind_2"] == 0
    assert found["z"] > 0


def test_errors_are_0_at_the_end_where_attributes_alone_have_a_precision() -> None:
    random = np.random.default_rng(3)
    values = random.normal(size=(2, 90, 90)).astype(np.float32)
    surface = ls.Surface(values[0], attributes={"t": values[1]})
    decoder = ls.Decoder()
    decoder.feed(ls.encode(surface, attribute_precision={"t": 0.05}))
    view = decoder.view()
    assert view.complete
    assert view.rms == view.max_error == 0


def test_a_container_is_exact_only_if_all_of_it_is() -> None:
    noise = np.random.default_rng(3).integers(-500, 500, (40, 40)).astype(np.int16)
    met = np.full((40, 40), -2, np.int16)  # the second block has a value of the lattice
    blocks = [ls.Surface(points).blocks[0] for points in (noise, met)]
    container = ls.encode(ls.Surface(blocks=blocks), precision=3)
    back = [block.points.astype(int) for block in ls.decode(container).blocks]
    assert np.abs(back[0] - noise).max() == 3
    assert (back[1] == met).all()
