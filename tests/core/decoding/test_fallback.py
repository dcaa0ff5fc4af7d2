"""Where the compiled kernels are missing: all is decoded alike, which is said once; nothing is encoded."""

from __future__ import annotations

import io
import logging
import random
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

import lodestream as ls
from lodestream.container import capacity
from lodestream.container.capacity import Capacity
from lodestream.decoding.inspection import inspect
from lodestream.encoding import prepared
from lodestream.planning.planner import plan
from lodestream.planning.selection import Selection
from lodestream.reference.small_units import SmallUnit
from lodestream.target import Target, Tolerance
from tests.torture.targets import TARGETS, mutate

from ..surfaces import follow, index_of, terrain
from .comparison import WHY, agree_on, assert_same, surfaces, without_kernels

#: What a container does not keep is another matter, see test_losses.
pytestmark = pytest.mark.filterwarnings("ignore:values of attributes at:lodestream.FormatWarning")

GOLDEN = Path(__file__).parents[2] / "golden"

#: One of every kind that plain Python decodes in a moment.
NAMES = (
    *("attributes", "blocks-bricks", "blocks-holes", "cube-sphere-even", "curve", "error-blocks", "heights-offsets"),
    *("holes-closed", "infinite-blocks", "infinite-error", "infinite-plane", "moebius", "planar-open", "plane-turned"),
    *("sphere-closed", "torus-odd", "two-points"),
)


def fed(data: bytes, chunks: int = 2**62, selection: Selection | None = None) -> ls.Decoder:
    decoder = ls.Decoder(selection)
    for start in range(0, len(data), chunks):
        decoder.feed(data[start : start + chunks])
    return decoder


@pytest.mark.parametrize("name", NAMES)
def test_every_state_is_the_same(name: str) -> None:
    data = (GOLDEN / f"{name}.lode").read_bytes()
    fast = fed(data)
    assert fast.header is not None
    layers = sorted({0, len(fast.layers) // 2, len(fast.layers) - 1})
    level = fast.header.levels // 2
    wanted = [fast.layers[number].surface() for number in layers]
    with without_kernels():
        slow = fed(data, 1000)
        assert_same(slow.surface(level), fast.surface(level))
        for number, surface in zip(layers, wanted, strict=True):
            assert_same(slow.layers[number].surface(), surface)


@pytest.mark.parametrize("name", ["attributes", "heights-offsets", "holes-float32", "infinite-plane", "sphere-closed"])
def test_windows_are_the_same(name: str) -> None:
    data = (GOLDEN / f"{name}.lode").read_bytes()
    fast = fed(data)
    assert fast.header is not None
    rows, columns = fast.header.shape
    region = (rows // 4, rows // 2), (columns // 3, columns)
    selection = Selection(region)
    wanted = [fast.layers[0].window(region), fast.view().window(region), fed(data, selection=selection).surface()]
    with without_kernels():
        slow = fed(data)
        found = [slow.layers[0].window(region), slow.view().window(region), fed(data, selection=selection).surface()]
    for one, other in zip(found, wanted, strict=True):
        assert_same(one, other)


@pytest.mark.parametrize(
    "target", [Target(order="level"), Target(level=3), Target(until_rms=Tolerance(20.0)), Target(max_bytes=2000)]
)
def test_slices_in_any_order_give_the_same_views(target: Target) -> None:
    data = ls.encode(terrain((40, 33), 3).astype(np.float32))
    steps = plan(index_of(data), target)
    _, wanted = follow(data, steps)
    with without_kernels():
        _, views = follow(data, steps, 700)
        assert [view.rms for view in views] == [view.rms for view in wanted]
        for number in {0, len(views) - 1}:
            assert_same(views[number].surface(), wanted[number].surface())


def layers_of(name: str) -> bytes:
    """A golden file without its residual, which would be applied when it comes."""
    data = (GOLDEN / f"{name}.lode").read_bytes()
    residual = index_of(data).residual
    return data if residual is None else data[: residual.offset]


def test_a_state_before_the_last_one_decodes_nothing_of_what_came_since() -> None:
    data = layers_of("planar-open")
    with without_kernels():
        slow, fed_so_far = ls.Decoder(), 0
        while len(slow.layers) < 2:
            slow.feed(data[fed_so_far : fed_so_far + 1])
            fed_so_far += 1
        slow.surface()
        slow.feed(data[fed_so_far:])
        plain = slow._reconstruction
        waiting = dict(plain._queue)
        assert len(waiting) > 0  # or decoding too much would not show
        slow.layers[0].surface()
        assert plain._queue == waiting
        assert_same(slow.surface(), fed(data).surface())


@pytest.mark.parametrize(("name", "every"), [("sphere-closed", 51), ("attributes", 131)])
def test_an_interrupted_view_is_decoded_on_from_where_it_was(
    name: str, every: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    data = layers_of(name)
    wanted, code, blocks = fed(data).surface(), SmallUnit._code, 0

    def interrupted(*arguments: Any) -> int:
        nonlocal blocks
        blocks += 1
        found = code(*arguments)
        if blocks % every == 0 and blocks <= 4 * every:
            raise KeyboardInterrupt
        return found

    monkeypatch.setattr(SmallUnit, "_code", interrupted)
    with without_kernels():
        slow, interrupts = fed(data), 0
        while True:
            try:
                found = slow.surface()
                break
            except KeyboardInterrupt:
                interrupts += 1
        assert interrupts == 4
        assert_same(found, wanted)


def test_some_attributes_alone_are_the_same() -> None:
    data = (GOLDEN / "attributes-types.lode").read_bytes()
    first, *others = fed(data).surface().blocks[0].attributes
    assert others
    wanted = fed(data, selection=Selection(attributes=(first,))).surface()
    with without_kernels():
        assert_same(fed(data, selection=Selection(attributes=(first,))).surface(), wanted)


@settings(max_examples=12)
@given(surfaces(), st.sampled_from([{}, {"precision": "1e-3d"}, {"rms": "1e-2d"}]), st.integers(0), st.integers(0))
def test_the_reference_and_the_kernels_agree(
    surface: ls.Surface, options: dict[str, str], layer: int, level: int
) -> None:
    agree_on(ls.encode(surface, **options), layer, level)  # type: ignore[call-overload]


@settings(max_examples=12)
@given(st.tuples(st.integers(2, 40), st.integers(2, 130)), st.booleans(), st.integers(0, 2**32), st.integers(0))
def test_they_agree_on_tiles_and_chunks_of_any_size(
    shape: tuple[int, int], floats: bool, seed: int, layer: int
) -> None:
    rng = np.random.default_rng(seed)
    heights = np.cumsum(rng.normal(size=shape), axis=1)
    tile, chunk = ((short, 8 + int(rng.integers(0, 3)) - short) for short in map(int, rng.integers(1, 7, 2)))
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(prepared, "tile_exponents", lambda *_: tile)
        patch.setattr(prepared, "chunk_exponents", lambda *_: [chunk])
        data = ls.encode(heights.astype(np.float32) if floats else np.rint(9 * heights).astype(np.int16))
    header = index_of(data).header
    assert (header.tile, header.chunk) == (tile, chunk)
    agree_on(data, layer, header.levels)


def outcome(data: bytes) -> list[str | list[bytes]]:
    """What becomes of a container: errors by their class, and the points of its first and last layer."""
    decoder, found = ls.Decoder(max_vertices=5000), list[str | list[bytes]]()
    try:
        decoder.feed(data)
    except ls.LodestreamError as error:
        found.append(type(error).__name__)
    for number in sorted({0, len(decoder.layers) - 1}) if decoder.layers else ():
        try:
            found.append([block.points.tobytes() for block in decoder.layers[number].surface().blocks])
        except ls.LodestreamError as error:
            found.append(type(error).__name__)
    return found


@pytest.mark.parametrize("name", ["heights-decimal", "infinite-error", "moebius", "planar-open"])
def test_what_strangers_send_is_taken_and_refused_alike(name: str) -> None:
    data, random_ = (GOLDEN / f"{name}.lode").read_bytes(), random.Random(name)
    found = []
    for _ in range(12):
        changed = TARGETS["containers"].mend(mutate(data, random_))
        found.append(outcome(changed))
        with without_kernels():
            assert outcome(changed) == found[-1]
    assert any(isinstance(part, str) for parts in found for part in parts)
    assert any(isinstance(last, list) for *_, last in filter(None, found))


def test_it_is_said_once_and_by_what_decodes(caplog: pytest.LogCaptureFixture) -> None:
    data = (GOLDEN / "planar-open.lode").read_bytes()
    with without_kernels(), caplog.at_level(logging.WARNING):
        decoder = fed(layers_of("planar-open"))
        assert index_of(data).header.levels == 4
        assert not caplog.records
        decoder.surface()
        decoder.layers[0].surface()
        ls.decode(data)
        assert [WHY in record.getMessage() for record in caplog.records] == [True]


def test_encoding_and_inspecting_are_refused_before_anything_is_done() -> None:
    with without_kernels():
        with pytest.raises(ls.UnavailableError, match=f"^encoding .*{WHY}"):
            ls.encode(object())  # type: ignore[call-overload]  # it would be refused otherwise
        with pytest.raises(ls.UnavailableError, match=WHY):
            inspect(io.BytesIO(b""), max_vertices=1)


def test_plain_python_takes_more_memory_and_a_window_as_much_as_its_surface(monkeypatch: pytest.MonkeyPatch) -> None:
    data = (GOLDEN / "several-tiles.lode").read_bytes()
    window = Selection(((0, 9), (0, 9)))
    monkeypatch.setattr(capacity, "memory_limit", lambda: 2**30)
    usual = Capacity().bytes
    ls.Decoder(window, max_vertices=100_000).feed(data)
    with without_kernels():
        assert Capacity().bytes <= usual / 5
        with pytest.raises(ls.TooLargeError, match="100,000 vertices"):
            ls.Decoder(window, max_vertices=100_000).feed(data)
