"""Infinities, and NaN beside numbers: they come back bit for bit, wherever they stand."""

from __future__ import annotations

import functools
import random
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray

import lodestream as ls
from lodestream import CorruptStreamError
from lodestream.container import describe, sections
from lodestream.container.fields import FieldWriter
from lodestream.container.frames import section_extent
from lodestream.entropy.mask import encode_mask
from lodestream.planning.planner import plan
from lodestream.planning.selection import selection_of
from lodestream.surface import finite_block
from tests.examples import examples

from .surfaces import follow, index_of, terrain, torus

#: What a container does not keep is another matter, see test_losses.
pytestmark = pytest.mark.filterwarnings("ignore:values of attributes at:lodestream.FormatWarning")

CLOSURES = [(False, False), (False, True), (True, False), (True, True)]

Values = NDArray[Any]


def as_they_return(surface: ls.Surface) -> list[list[Values]]:
    """Points and attributes of each block when every value comes back that should: what the documentation promises."""
    found = []
    for block in surface.blocks:
        coordinates = block.points.reshape(*block.shape, -1)[..., :3]
        if block.points.dtype.kind == "f":
            none = np.isnan(coordinates).all(axis=2)
            finite = np.isfinite(coordinates).all(axis=2)
        else:
            none, finite = np.zeros(block.shape, bool), np.ones(block.shape, bool)
        if block.mask is not None:
            none |= finite & ~block.mask
        arrays = [block.points.copy(), *(array.copy() for array in block.attributes.values())]
        for array in arrays:
            array[none] = np.nan if array.dtype.kind == "f" else 0
        found.append(arrays)
    return found


def same(surface: ls.Surface, wanted: Sequence[Sequence[Values]]) -> bool:
    """Whether all values are these, bit for bit."""
    return all(
        found.tobytes() == array.tobytes()
        for block, arrays in zip(surface.blocks, wanted, strict=True)
        for found, array in zip((block.points, *block.attributes.values()), arrays, strict=True)
    )


def assert_comes_back(surface: ls.Surface) -> bytes:
    container = ls.encode(surface)
    found = ls.decode(container)
    assert same(found, as_they_return(surface))
    for block, original in zip(found.blocks, surface.blocks, strict=True):
        assert block.holes == original.holes
    assert same(ls.decode(ls.encode(found)), as_they_return(surface))
    assert index_of(container).header.exact
    return container


def sprinkled(array: Values, rng: np.random.Generator, share: float) -> Values:
    """The array with infinities of both signs, NaN of any pattern and zeros of both signs here and there."""
    if array.dtype.kind != "f":
        return array
    unsigned = f"u{array.dtype.itemsize}"
    quiet = int(np.array(np.nan, array.dtype).view(unsigned))
    odd = [quiet, quiet ^ 1 << 8 * array.dtype.itemsize - 1, quiet | 5, quiet - (1 << 20)]
    plain = np.array([np.inf, -np.inf, np.inf, -np.inf, 0.0, -0.0], array.dtype).view(unsigned)
    pool = np.concatenate([plain, np.array(odd, unsigned)])
    patterns = np.where(rng.random(array.shape) < share, rng.choice(pool, array.shape), array.view(unsigned))
    return np.ascontiguousarray(patterns).view(array.dtype)


def lake(shape: tuple[int, int], channels: int = 1, dtype: str = "float32") -> Values:
    """Ground with infinities in it, of one channel a different one at each."""
    rng = np.random.default_rng(7)
    y, x = np.mgrid[: shape[0], : shape[1]].astype(float)
    points = np.stack([x + 0.1 * np.sin(y), y + 0.2 * np.cos(x), terrain(shape)], axis=-1)[..., -channels:].astype(
        dtype
    )
    points = sprinkled(points, rng, 0.03)
    return points[..., 0] if channels == 1 else points


@pytest.mark.parametrize("dtype", ["float32", "float64"])
@pytest.mark.parametrize("closed", CLOSURES)
def test_infinite_heights_come_back_with_their_sign(dtype: str, closed: tuple[bool, bool]) -> None:
    heights = terrain((33, 41)).astype(dtype)
    heights[3, 4:9], heights[20:23, 7], heights[0, 0], heights[10, 10] = np.inf, -np.inf, -0.0, np.nan
    container = assert_comes_back(ls.Surface(heights, closed))
    facts = describe(index_of(container))
    assert (facts["holes"], facts["non_finite"], facts["exact"]) == (9, 8, True)


@pytest.mark.parametrize("value", [np.inf, -np.inf, np.nan])
@pytest.mark.parametrize("channel", [0, 1, 2])
def test_the_other_coordinates_of_a_point_come_back_too(value: float, channel: int) -> None:
    points = torus(24, 18, "float64")
    points[5, 6:9, channel] = value
    points[11, 3] = np.nan
    container = assert_comes_back(ls.Surface(points, (True, True), attributes={"n": np.arange(432).reshape(24, 18)}))
    assert describe(index_of(container))["non_finite"] == 3


@st.composite
def surfaces(draw: st.DrawFn) -> ls.Surface:
    """Small ones of every kind, with what is not finite here and there."""
    rng = np.random.default_rng(draw(st.integers(0, 2**32)))
    dtype = draw(st.sampled_from(["float32", "float64"]))
    channels = draw(st.sampled_from([0, 2, 3, 4]))
    attributes = draw(st.booleans())
    masked = draw(st.booleans())
    shares = st.sampled_from([0.0, 0.02, 0.2, 0.9])
    smooth = draw(st.booleans())
    blocks = []
    for _ in range(draw(st.sampled_from([1, 1, 1, 2, 3]))):
        shape = draw(st.tuples(st.integers(1, 12), st.integers(2, 12)))
        size = (*shape, channels) if channels else shape
        points = np.cumsum(rng.normal(size=size), axis=0) if smooth else rng.integers(-9, 9, size)
        points = points.astype(dtype)
        known = points.reshape(-1)[: channels or 1].copy()
        points = sprinkled(points, rng, draw(shares))
        points.reshape(-1)[: channels or 1] = known  # one point at least is valid
        named: dict[str, Values] = {}
        if attributes:
            named = {
                "t": sprinkled(rng.normal(size=shape).astype("f4"), rng, draw(shares)),
                "flow": sprinkled(rng.normal(size=(*shape, 2)), rng, draw(shares)),
                "k": rng.integers(-9, 9, shape).astype("i2"),
            }
        mask = rng.random(shape) < 0.8
        mask[0, 0] = True
        closed = draw(st.sampled_from(CLOSURES))
        blocks.append(ls.Block(points, closed, mask=mask if masked else None, attributes=named))
    return ls.Surface(blocks=blocks)


@examples(15)
@given(surfaces())
@pytest.mark.long
def test_every_surface_comes_back_bit_for_bit(surface: ls.Surface) -> None:
    assert_comes_back(surface)


@examples(13)
@given(surfaces(), st.booleans())
def test_with_a_precision_or_an_error_infinities_come_back_and_the_rest_nearly(surface: ls.Surface, rms: bool) -> None:
    attributes = {name: "0.25" for name in ("t", "flow") if name in surface.blocks[0].attributes}
    error = {"rms": "1%"} if rms else {"precision": "1%"}
    decoder = ls.Decoder()
    decoder.feed(ls.encode(surface, **error, attribute_precision=attributes))  # type: ignore[call-overload]
    assert decoder.header is not None
    assert (decoder.rms if rms else decoder.max_error) <= 0.01 * decoder.header.extent
    found = decoder.surface()
    for block, wanted, original in zip(found.blocks, as_they_return(surface), surface.blocks, strict=True):
        assert block.holes == original.holes
        valid = np.ones(block.shape, bool) if block.mask is None else block.mask
        away = [b.points.reshape(*b.shape, -1)[valid, :3].astype(float) for b in (block, original)]
        assert np.linalg.norm(away[0] - away[1], axis=-1).max() <= decoder.max_error * (1 + 1e-9)
        named = [block.points, *block.attributes.values()]
        for array, given_, rough in zip(
            named, wanted, [True, *(n in attributes for n in block.attributes)], strict=True
        ):
            odd = ~np.isfinite(given_)
            assert np.array_equal(np.isfinite(array), ~odd)
            assert array[odd].tobytes() == given_[odd].tobytes()
            if not rough:
                assert array.tobytes() == given_.tobytes()
            elif array is not block.points:
                assert (np.abs(array[~odd].astype(float) - given_[~odd]) <= 0.2500001).all()


KINDS: dict[str, Callable[[], tuple[ls.Surface, dict[str, Any]]]] = {
    "heights": lambda: (ls.Surface(lake((300, 290))), {}),
    "xyz": lambda: (ls.Surface(lake((60, 75), 3, "float64"), attributes={"t": lake((60, 75), 1)}), {}),
    "plane": lambda: (ls.Surface(plane()), {}),
    "terraces": lambda: (ls.Surface(terraces()), {}),
    "precision": lambda: (ls.Surface(lake((70, 66))), {"precision": "0.1%"}),
    "error": lambda: (ls.Surface(lake((70, 66), 3)), {"rms": "0.1%"}),
    "blocks": lambda: (ls.Surface(blocks=pair()), {}),
    "sphere": lambda: (ls.Surface(globe(), (False, True)), {}),
}


def plane() -> Values:
    """x and y by a rule, also where z is infinite or NaN; and nothing at all in one corner."""
    y, x = np.mgrid[:70, :66].astype(float)
    points = np.stack([500000.0 + 30 * x, 4e6 - 30 * y, terrain((70, 66))], axis=-1)
    points[3:5, 7:20, 2], points[30, 30:40, 2], points[31, 30:40, 2] = np.inf, -np.inf, np.nan
    points[:9, :5] = np.nan
    return points


def terraces() -> Values:
    heights = np.floor(terrain((90, 80), 2) / 15).astype(np.float32)
    heights[3:5, 7:20], heights[30, 30:40], heights[:9, :5] = np.inf, -np.inf, np.nan
    return heights


def pair() -> list[ls.Block]:
    """Two blocks with a common side, on which there are infinities too."""
    whole = lake((40, 33), 3, "float64")
    whole[17, 5:9, 1], whole[17, 20] = np.inf, np.nan
    return [ls.Block(whole[:18].copy()), ls.Block(whole[17:].copy())]


def globe() -> Values:
    v, u = np.meshgrid(np.linspace(0, np.pi, 33), 2 * np.pi * np.arange(48) / 48, indexing="ij")
    points = np.stack([np.sin(v) * np.cos(u), np.sin(v) * np.sin(u), np.cos(v)], axis=2)
    points[0], points[-1] = (0, 0, 1), (0, 0, -1)
    points[5, 40:], points[0, 3, 2], points[20, 2:5, 0] = np.inf, -np.inf, np.nan
    return points


@functools.cache
def encoded(kind: str) -> tuple[ls.Surface, bytes]:
    surface, how = KINDS[kind]()
    return surface, ls.encode(surface, **how)


def test_the_kinds_are_what_they_are_called() -> None:
    assert [kind for kind in KINDS if index_of(encoded(kind)[1]).header.plane is not None] == ["plane"]
    arranged = [kind for kind in KINDS if index_of(encoded(kind)[1]).header.arrangement is not None]
    assert arranged == ["blocks", "sphere"]


def holes_of(block: ls.Block) -> Values:
    assert block.mask is not None
    return ~block.mask


@pytest.mark.parametrize("kind", KINDS)
def test_every_prefix_shows_holes_until_the_last_byte_brings_the_infinities(kind: str) -> None:
    surface, container = encoded(kind)
    decoder = ls.Decoder()
    step = max(1, len(container) // 3000)
    seen = 0
    for place in range(0, len(container), step):
        decoder.feed(container[place : place + step])
        for view in decoder.layers[seen:]:
            shown = view.surface()
            for block, original in zip(shown.blocks, surface.blocks, strict=True):
                assert np.array_equal(holes_of(block), holes_of(original))
                if not view.complete:
                    assert np.isnan(block.points[holes_of(original)]).all()
        seen = len(decoder.layers)
    assert decoder.complete
    if kind not in ("precision", "error"):
        assert same(decoder.surface(), as_they_return(surface))
        assert decoder.max_error == 0
    for level in range(decoder.header.levels if decoder.header else 0):
        for block in decoder.surface(level).blocks:
            assert block.mask is None or np.isnan(block.points[~block.mask]).all()


@pytest.mark.parametrize("kind", KINDS)
def test_what_the_index_plans_gives_the_same(kind: str) -> None:
    surface, container = encoded(kind)
    wanted = ls.decode(container)
    for target in (ls.Target(), ls.Target(order="level")):
        decoder, _ = follow(container, plan(index_of(container), target), 7000)
        assert decoder.complete
        assert same(decoder.surface(), [[b.points, *b.attributes.values()] for b in wanted.blocks])
    if len(surface.blocks) == 1:
        rows, columns = (2, 29), (1, 30)
        index = index_of(container)
        target = ls.Target(region=(rows, columns))
        chosen = plan(index, target)
        window = ls.Decoder(selection_of(target))
        for place in (*chosen.before, *chosen.ranges, *chosen.after):
            window.feed_at(place.offset, container[place.offset : place.end])
        assert window.complete
        block = wanted.blocks[0]
        cut = [array[slice(*rows), slice(*columns)] for array in (block.points, *block.attributes.values())]
        assert same(window.surface(), [cut])
        assert same(window.view().window(((4, 20), (5, 9))), [[a[2:18, 4:8] for a in cut]])


@pytest.mark.parametrize("kind", KINDS)
def test_a_flipped_bit_gives_what_came_before_it_or_a_clear_error(kind: str) -> None:
    _, container = encoded(kind)
    whole = ls.decode(container)
    shuffle = random.Random(kind)
    places = [shuffle.randrange(len(container)) for _ in range(40)]
    masks = index_of(container).layers[0].offset
    places += [shuffle.randrange(masks) for _ in range(40)]
    for place in places:
        damaged = bytearray(container)
        damaged[place] ^= 1 << shuffle.randrange(8)
        decoder = ls.Decoder()
        try:
            decoder.feed(bytes(damaged))
            decoder.finish()
            found = decoder.surface()
        except (ls.CorruptStreamError, ls.UnsupportedVersionError, ls.TruncatedStreamError):
            continue
        assert same(found, [[b.points, *b.attributes.values()] for b in whole.blocks])


def kinds_of(container: bytes) -> list[int]:
    place, kinds = sections_start(), []
    while place < len(container) - sections.FOOTER_LENGTH:
        extent = section_extent(container[place : place + 10], place)
        assert extent is not None
        kinds.append(container[place])
        place += extent[1]
    return kinds


def sections_start() -> int:
    return len(sections.SIGNATURE)


def test_without_infinities_holes_cost_what_they_did() -> None:
    heights = lake((60, 70))
    heights[np.isinf(heights)] = np.nan
    for points in (heights, heights[:50, :60]):
        kinds = kinds_of(ls.encode(points))
        assert sections.MASKS in kinds
        assert sections.KEPT_MASKS not in kinds
    assert sections.KEPT_MASKS in kinds_of(ls.encode(lake((60, 70))))


def test_half_of_all_points_infinite_costs_a_few_per_cent() -> None:
    rng = np.random.default_rng(3)
    heights = np.cumsum(rng.normal(size=(140, 150)), axis=1).astype(np.float32)
    half = rng.random(heights.shape) < 0.5
    heights[half] = np.nan
    holes = len(ls.encode(heights))
    for signs in ([np.inf], [np.inf, -np.inf], [np.inf, np.nan]):
        heights[half] = rng.choice(signs, int(half.sum()))
        container = assert_comes_back(ls.Surface(heights))
        # Nothing that is worth a byte where all are alike, and a bit for each of them where each is one of two.
        assert len(container) - holes < (0.001 if len(signs) == 1 else 0.035) * heights.nbytes


def test_one_infinity_costs_some_bytes() -> None:
    heights = terrain((400, 400))
    heights[17, 5] = np.nan
    with_hole = len(ls.encode(heights))
    heights[17, 5] = np.inf
    # Every window has a second piece then, which is empty and takes two bytes of tables.
    assert len(ls.encode(heights)) < with_hole + 2 * 13**2 + 100


def test_an_attribute_with_a_precision_keeps_what_is_not_finite() -> None:
    temperature = terrain((33, 40))
    temperature[3:6, 7:9], temperature[8, 8], temperature[9, 9] = np.nan, np.inf, -np.inf
    surface = ls.Surface(torus(33, 40), (True, True), attributes={"t": temperature})
    found = ls.decode(ls.encode(surface, attribute_precision={"t": "0.5"})).attributes["t"]
    odd = ~np.isfinite(temperature)
    assert found[odd].tobytes() == temperature[odd].tobytes()
    assert 0 < np.abs(found[~odd] - temperature[~odd]).max() <= 0.5


def masks_section(holes: int, mask: Values, kept: int, data: bytes | None) -> bytes:
    out = FieldWriter()
    out.pack("q", 0)
    out.varint(holes)
    coded = encode_mask(mask)
    out.varint(len(coded))
    out.data += coded
    out.varint(kept)
    if data is not None:
        out.varint(len(data))
        out.data += data
    return sections.section(sections.KEPT_MASKS, bytes(out.data))


def test_masks_that_lie_about_what_is_kept_are_corrupt() -> None:
    heights = terrain((30, 31))
    heights[3, 4:9], heights[5, 5] = np.inf, np.nan
    container = ls.encode(heights)
    place = sections_start()
    extent = section_extent(container[place : place + 10], place)
    assert extent is not None
    start, end = place + extent[1], index_of(container).layers[0].offset
    mask = np.isfinite(heights)
    kept = np.isinf(heights)
    good = masks_section(6, mask, 5, encode_mask(kept))
    assert container[start:end] == good
    elsewhere = kept.copy()
    elsewhere[3, 4], elsewhere[20, 20] = False, True
    for bad in (
        masks_section(6, mask, 7, encode_mask(kept)),
        masks_section(6, mask, 5, encode_mask(elsewhere)),
        masks_section(6, mask, 4, encode_mask(kept)),
        masks_section(6, mask, 6, encode_mask(kept)),
        masks_section(6, mask, 5, encode_mask(kept) + bytes(9)),
        masks_section(6, mask, 5, None),
        masks_section(7, mask, 7, None),
    ):
        with pytest.raises(CorruptStreamError):
            ls.decode(container[:start] + bad + container[end:])


def test_a_block_says_which_holes_are_kept() -> None:
    points = torus(4, 5)
    assert ls.Block(points).kept is None
    points[0, 0], points[1, 1, 2], points[2, 2, 0], points[3, 3] = np.nan, np.nan, np.inf, -np.inf
    mask = np.ones((4, 5), bool)
    mask[0, 4] = mask[2, 2] = False
    kept = ls.Block(points, mask=mask).kept
    assert kept is not None
    assert np.argwhere(kept).tolist() == [[1, 1], [2, 2], [3, 3]]
    assert ls.Block(np.arange(20).reshape(4, 5), mask=mask).kept is None


@pytest.mark.parametrize("shape", [(3, 4), (3, 4, 3)])
def test_a_block_of_finite_points_is_the_block_that_is_looked_through(shape: tuple[int, ...]) -> None:
    points, mask = np.arange(np.prod(shape), dtype=np.float64).reshape(shape), np.ones(shape[:2], np.bool_)
    named = {"kind": np.arange(12).reshape(3, 4)}
    for holes in (0, 2):
        mask[0, :holes] = False
        found = finite_block(points, (True, False), mask, named)
        expected = ls.Block(points, (True, False), mask=mask, attributes=named)
        assert np.shares_memory(found.points, points)
        assert found.closed == expected.closed
        assert found.holes == expected.holes == holes
        assert (found.mask is None) == (expected.mask is None)
        assert found.mask is not mask
        np.testing.assert_array_equal(found.attributes["kind"], named["kind"])
    for wrong in (np.zeros((1, 1)), np.zeros((3, 4, 1)), np.zeros(5)):
        with pytest.raises(ls.InputError):
            finite_block(wrong, (False, False), None, {})
    with pytest.raises(ls.InputError):
        finite_block(points, (False, False), None, {"kind": np.zeros((2, 2))})
