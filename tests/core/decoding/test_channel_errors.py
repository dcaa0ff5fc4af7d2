"""Errors of each channel and attribute, in layers and in the index, are those of what is shown."""

from __future__ import annotations

import io
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

import lodestream as ls
from lodestream.container import Index
from lodestream.container.fields import told_roughly
from lodestream.decoding.inspection import inspect

from ..container.forgery import with_index
from ..surfaces import index_of, terrain, torus

RNG = np.random.default_rng(7)


def rough(shape: tuple[int, ...], dtype: str) -> NDArray[Any]:
    smooth = np.cumsum(np.cumsum(RNG.normal(size=shape), axis=0), axis=1)
    return smooth.astype(dtype)


def with_gaps(values: NDArray[Any]) -> NDArray[Any]:
    values = values.copy()
    values[3:6, 4] = np.nan
    values[0, 0] = np.inf
    return values


HOLES = np.ones((40, 33), np.bool_)
HOLES[10:14, 5:20] = False
SURFACES: dict[str, tuple[ls.Surface, dict[str, Any]]] = {
    "heights": (ls.Surface(terrain((40, 33)), attributes={"a": with_gaps(rough((40, 33), "float32"))}), {}),
    "colours": (
        ls.Surface(
            torus(40, 33, "float64"), (True, True), attributes={"rgb": RNG.integers(0, 255, (40, 33, 3)).astype("u1")}
        ),
        {"precision": "0.1%"},
    ),
    "wide": (ls.Surface(np.concatenate([torus(40, 33), rough((40, 33, 2), "float32")], axis=2)), {"rms": "1%"}),
    "precise": (
        ls.Surface(terrain((40, 33)), attributes={"a": rough((40, 33, 2), "float64"), "b": rough((40, 33), "int64")}),
        {"attribute_precision": {"a": 0.5}},
    ),
    "holes": (
        ls.Surface(
            np.rint(terrain((40, 33))).astype("i4"), mask=HOLES, attributes={"b": rough((40, 33), "i2") * HOLES}
        ),
        {},
    ),
}


def channels_of(block: ls.Block) -> list[NDArray[Any]]:
    arrays = (block.points, *block.attributes.values())
    return [
        a[..., k]
        for array in arrays
        for a in [array if array.ndim == 3 else array[..., None]]
        for k in range(a.shape[2])
    ]


def measured(original: ls.Surface, shown: ls.Surface) -> list[tuple[float, float]]:
    found = []
    for one, other in zip(channels_of(original.blocks[0]), channels_of(shown.blocks[0]), strict=True):
        counted = np.ones(one.shape, np.bool_) if original.mask is None else original.mask
        counted = counted & np.isfinite(one.astype(np.float64))
        delta = one[counted].astype(np.float64) - other[counted].astype(np.float64)
        found.append((float(np.sqrt((delta**2).mean())), float(np.abs(delta).max())))
    return found


def assert_told(said: tuple[tuple[float, float], ...], found: list[tuple[float, float]]) -> None:
    for pair, known in zip(said, found, strict=True):
        for a, b in zip(pair, known, strict=True):
            assert told_roughly(b * (1 - 1e-9)) <= a <= told_roughly(b * (1 + 1e-9))


@pytest.mark.parametrize("name", SURFACES)
def test_errors_of_channels_are_those_of_what_is_shown(name: str) -> None:
    surface, how = SURFACES[name]
    container = ls.encode(surface, **how)
    index = index_of(container)
    decoder = ls.Decoder()
    views = decoder.feed(container)
    assert len(index.layers[0].channels) == index.header.channels > 1
    for record, view in zip(index.layers, views, strict=False):
        if record.number + 1 < len(views):
            assert_told(record.channels, measured(surface, view.surface()))
    assert_told(index.levels[-1].channels, measured(surface, views[-1].surface()))
    for level in index.levels[:-1]:
        assert len(level.channels) == index.header.channels
    exact = all(error == (0.0, 0.0) for error in index.levels[-1].channels)
    assert exact == index.header.exact
    assert inspect(io.BytesIO(container), max_vertices=10_000).errors_checked == exact


def test_blocks_that_share_points_count_what_each_shows() -> None:
    whole, colour = torus(20, 31, "float64")[:, :25], rough((20, 25), "float32")
    blocks = [
        ls.Block(whole[:, part].copy(), attributes={"a": colour[:, part].copy()})
        for part in (slice(0, 12), slice(11, 25))
    ]
    container = ls.encode(ls.Surface(blocks=blocks))
    index = index_of(container)
    assert index.header.arrangement is not None
    views = ls.Decoder().feed(container)
    for record, view in zip(index.layers, views, strict=False):
        pairs = zip(blocks, view.surface().blocks, strict=True)
        delta = np.concatenate([(a.attributes["a"] - b.attributes["a"].astype(np.float64)).ravel() for a, b in pairs])
        if record.number + 1 < len(views):
            assert_told(record.channels[3:], [(float(np.sqrt((delta**2).mean())), float(np.abs(delta).max()))])
    inspect(io.BytesIO(container), max_vertices=10_000)


def test_a_surface_of_one_channel_tells_them_once() -> None:
    index = index_of(ls.encode(terrain((20, 21))))
    assert {layer.channels for layer in index.layers} | {level.channels for level in index.levels} == {()}


def test_forged_errors_of_channels_are_refused() -> None:
    container = ls.encode(SURFACES["heights"][0])
    index = index_of(container)

    def forged(number: int) -> Index:
        levels = list(index.levels)
        level = levels[number]
        pairs = (level.channels[0], (level.channels[1][0] / 2 or 1.0, level.channels[1][1]))
        levels[number] = replace(level, channels=pairs)
        return replace(index, levels=tuple(levels))

    for number in range(len(index.levels)):
        with pytest.raises(ls.CorruptStreamError, match=r"expected (the RMS and maximum )?error"):
            inspect(io.BytesIO(with_index(container, forged(number))), max_vertices=10_000)
