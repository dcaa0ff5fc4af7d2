from __future__ import annotations

import functools
import hashlib
import json
import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from tests.stranger.container import Container, DamagedError, Index, read_container, read_index
from tests.stranger.decoder import Decoder, decode, surface
from tests.stranger.picture import Points

GOLDEN = Path(__file__).parents[1] / "golden"
EXPECTED: dict[str, dict[str, Any]] = json.loads((GOLDEN / "expected.json").read_text())
MANY_POINTS = 50_000  # plain Python takes about a second for each picture of such a surface

golden = pytest.mark.parametrize("name", EXPECTED)
small = pytest.mark.parametrize("name", [name for name in EXPECTED if math.prod(EXPECTED[name]["shape"]) < MANY_POINTS])


@functools.cache
def file_of(name: str) -> bytes:
    return (GOLDEN / f"{name}.lode").read_bytes()


@functools.cache
def decoded(name: str) -> tuple[Container, Decoder]:
    container = read_container(file_of(name))
    return container, decode(container)


def index_of(name: str) -> Index:
    return read_index(file_of(name), decoded(name)[1].levels.last + 1)


def digest(points: Points) -> str:
    return hashlib.sha256(points.tobytes()).hexdigest()


@golden
def test_the_header_says_what_the_surface_is(name: str) -> None:
    container, decoder = decoded(name)
    points = surface(container, decoder)
    assert list(points.shape) == EXPECTED[name]["shape"]
    assert points.dtype == np.dtype(EXPECTED[name]["type"]).newbyteorder("<")
    assert list(container.header.closed) == EXPECTED[name]["closed"]
    assert (container.exactness is not None) == container.header.has_exactness
    assert container.metadata is not None


@golden
def test_every_layer_gives_its_picture(name: str) -> None:
    container, decoder = decoded(name)
    expected = EXPECTED[name]["layers"]
    assert len(container.layers) == container.header.layers == len(expected) - (container.exactness is not None)
    layers = list(range(1, len(container.layers) + 1))
    if math.prod(EXPECTED[name]["shape"]) >= MANY_POINTS:
        layers = [1, len(layers) // 2, len(layers)]
    for count in layers:
        layer, wanted = container.layers[count - 1], expected[count - 1]
        assert digest(decoder.picture(count)) == wanted["sha256"], f"layer {count}"
        assert (layer.end, layer.rms, layer.maximum) == (wanted["bytes"], wanted["rms"], wanted["max"])
    assert digest(surface(container, decoder)) == expected[-1]["sha256"]


@golden
def test_every_level_gives_its_grid(name: str) -> None:
    container, decoder = decoded(name)
    *coarser, finest = EXPECTED[name]["levels"]
    assert len(coarser) == decoder.levels.last
    assert [digest(decoder.picture(level=level)) for level in range(len(coarser))] == coarser
    assert digest(surface(container, decoder)) == finest


@golden
def test_the_index_finds_every_segment_of_the_layers(name: str) -> None:
    container, index = decoded(name)[0], index_of(name)
    assert index.layer_errors == [(layer.rms, layer.maximum) for layer in container.layers]
    for layer, entries in zip(container.layers, index.entries, strict=True):
        for segment, entry in zip(layer.segments, entries, strict=True):
            found = entry.take(file_of(name))  # which checks the segment's CRC
            assert (found.unit, found.passes, found.data) == (segment.unit, segment.passes, segment.data)
            assert segment.top in (None, found.top)


@small
def test_the_index_alone_gives_the_levels_one_after_another(name: str) -> None:
    index = index_of(name)
    entries = [entry for layer in index.entries for entry in layer]
    container, complete = decoded(name)
    decoder = Decoder(container.header)
    for level, wanted in enumerate(EXPECTED[name]["levels"][:-1]):
        decoder.take(entry.take(file_of(name)) for entry in entries if decoder.units[entry.unit].level == level)
        assert digest(decoder.picture(level=level)) == digest(complete.picture(level=level)) == wanted


@pytest.mark.parametrize("name", ["cylinder-even", "planar-open"])
def test_the_beginning_of_a_file_gives_the_layers_that_it_holds(name: str) -> None:
    for count, wanted in enumerate(EXPECTED[name]["layers"][: len(decoded(name)[0].layers)], 1):
        for missing in (0, 1):
            container = read_container(file_of(name)[: wanted["bytes"] - missing])
            assert len(container.layers) == count - missing
            if not missing:
                assert digest(decode(container).picture()) == wanted["sha256"]


def test_a_damaged_layer_ends_what_is_taken_and_a_damaged_segment_is_refused() -> None:
    data = bytearray(file_of("cylinder-even"))
    entry = index_of("cylinder-even").entries[3][0]
    data[entry.start] ^= 1
    assert len(read_container(bytes(data)).layers) == 3
    with pytest.raises(DamagedError, match="segment"):
        entry.take(bytes(data))
