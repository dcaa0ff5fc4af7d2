"""Surfaces that have large units: those of test_decoder and others, and headers that name levels they do not have."""

from __future__ import annotations

import numpy as np
import pytest

import lodestream as ls
from lodestream.container.codecs import LARGE_UNITS
from tests.golden.generate import digests

from ..container.forgery import with_header
from ..planning.test_region import received
from ..surfaces import all_large, contained, index_of, terrain, torus

LAKE = np.hypot(*(np.mgrid[:40, :60] - np.array([15, 20])[:, None, None])) < 9


def kinds() -> dict[str, ls.Surface]:
    heights = terrain((40, 60), 5)
    wide = np.cumsum(np.cumsum(np.random.default_rng(6).normal(size=(40, 60)), 0), 1)
    sides = [torus(25, 24, "float64")[:, a:b] for a, b in ((0, 9), (8, 24))]
    attributes = {"t": wide.astype(np.float32), "k": np.rint(heights).astype(np.int32), "few": LAKE.astype(np.uint8)}
    return {
        "attributes": ls.Surface(np.rint(heights).astype(np.int16), (True, False), attributes=attributes),
        "holes": ls.Surface(np.where(LAKE, np.nan, heights), attributes={"t": np.where(LAKE, np.nan, wide)}),
        "widest": ls.Surface(np.random.default_rng(7).integers(-(2**31), 2**31, (33, 70), np.int32)),
        "blocks": ls.Surface(blocks=[ls.Block(side, attributes={"v": side[..., 0].copy()}) for side in sides]),
        "closed": ls.Surface(torus(27, 32), (True, True)),
        "one row": ls.Surface(wide[:1]),
        "one column": ls.Surface(wide[:, :1], (True, False)),
    }


@pytest.mark.parametrize("name", kinds())
def test_all_that_a_surface_may_have_comes_back_in_any_chunks(name: str) -> None:
    surface = kinds()[name]
    with all_large():
        container = ls.encode(surface)
    index = index_of(container)
    assert index.header.large == 1
    decoder = ls.Decoder()
    decoder.feed(container)
    for found, block in zip(decoder.surface().blocks, surface.blocks, strict=True):
        assert np.array_equal(found.points, block.points, equal_nan=True)
        for key, array in block.attributes.items():
            assert np.array_equal(found.attributes[key], array, equal_nan=array.dtype.kind == "f")
    errors = [view.rms for view in decoder.layers]
    assert errors == sorted(errors, reverse=True)
    shown = [digests(view.surface()) for view in decoder.layers]
    for chunk in (1 + len(container) // 150, 1 + len(container) // 7):
        parts, seen = ls.Decoder(), []
        for start in range(0, len(container), chunk):
            seen += [digests(view.surface()) for view in parts.feed(container[start : start + chunk])]
        assert seen == shown
    if len(surface.blocks) == 1:
        rows, columns = surface.blocks[0].shape
        region = (rows // 3, rows // 2 + 1), (columns // 4, columns // 2 + 1)
        window = received(container, ls.Target(region=region)).surface()
        cut = surface.blocks[0].points[slice(*region[0]), slice(*region[1])]
        assert np.array_equal(window.blocks[0].points, cut, equal_nan=True)


def test_the_finest_levels_are_large_from_so_many_points_on() -> None:
    for shape, large in (((181, 181), 0), ((182, 182), 1)):
        heights = terrain(shape, 1).astype(np.float32)
        header = index_of(ls.encode(heights)).header
        assert header.large == large * header.levels
        assert (LARGE_UNITS in header.codecs) == bool(large)


def test_units_of_indices_are_never_large() -> None:
    heights = terrain((60, 70), 2)
    with all_large():
        alone = ls.encode(heights, rms="1%")
        both = ls.encode(ls.Surface(heights, attributes={"k": np.rint(heights).astype(np.int16)}), rms="1%")
    assert LARGE_UNITS not in index_of(alone).header.codecs
    assert LARGE_UNITS in index_of(both).header.codecs
    assert np.array_equal(ls.decode(both).attributes["k"], np.rint(heights).astype(np.int16))


@pytest.mark.parametrize("name", ["metres", "torus", "pair", "constant"])
def test_a_level_beyond_the_finest_is_one_that_no_unit_has(name: str) -> None:
    container, index = contained(name)
    assert index.header.large == 0
    for large in (index.header.levels + 1, 255):
        changed = ls.decode(with_header(container, large=large))
        assert changed.points.tobytes() == ls.decode(container).points.tobytes()


@pytest.mark.parametrize("name", ["metres", "torus", "attributes", "large heights", "large torus"])
def test_units_that_are_called_large_and_are_not_are_read_without_a_fault(name: str) -> None:
    container, index = contained(name)
    shown = []
    for large in range(index.header.levels + 1):
        changed, layers = with_header(container, large=large), ls.Decoder()
        layers.feed(changed[: index.layers[-2].end])
        shown.append(layers.surface().points.tobytes())
        if large == index.header.large:
            assert ls.decode(changed).points.tobytes() == ls.decode(container).points.tobytes()
        else:
            with pytest.raises(ls.CorruptStreamError, match="expected"):
                ls.decode(changed)
    assert len(set(shown)) > index.header.levels // 2
