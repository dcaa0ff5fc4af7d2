from __future__ import annotations

import json
import random
from typing import Any

import numpy as np
import pytest

import lodestream as ls
from tests import reference
from tests.golden.generate import FOLDER, digests, expectations, lines, originals

EXPECTED: dict[str, Any] = json.loads((FOLDER / "expected.json").read_text())
NAMES = sorted(EXPECTED)


def container_of(name: str) -> bytes:
    return (FOLDER / f"{name}.lode").read_bytes()


def test_every_golden_file_is_expected_and_the_other_way_round() -> None:
    assert sorted(path.stem for path in FOLDER.glob("*.lode")) == NAMES == sorted(originals())


@pytest.mark.parametrize("name", NAMES)
def test_golden_containers_decode_to_what_they_held(name: str) -> None:
    found = expectations(container_of(name), originals()[name].detailed)
    assert found == EXPECTED[name]


@pytest.mark.parametrize("name", NAMES)
def test_golden_containers_hold_their_originals(name: str) -> None:
    original = originals()[name]
    decoded = ls.decode(container_of(name))
    assert decoded.metadata == original.surface.metadata
    for found, block in zip(decoded.blocks, original.surface.blocks, strict=True):
        assert found.closed == block.closed
        valid = np.ones(block.shape, bool) if block.mask is None else block.mask
        assert np.array_equal(valid, np.ones(block.shape, bool) if found.mask is None else found.mask)
        if block.kept is not None:
            assert found.points[block.kept].tobytes() == block.points[block.kept].tobytes()
        assert (found.points.dtype, found.points.shape) == (block.points.dtype, block.points.shape)
        if original.rewritten is not None:
            continue
        if original.precision is None and original.rms is None:
            assert found.points[valid].tobytes() == block.points[valid].tobytes()
        assert list(found.attributes) == list(block.attributes)
        for key, array in block.attributes.items():
            assert (found.attributes[key].dtype, found.attributes[key].shape) == (array.dtype, array.shape)
            if key not in original.attribute_precision:
                assert found.attributes[key][valid].tobytes() == array[valid].tobytes()
    if original.precision is not None:
        assert EXPECTED[name]["layers"][-1]["max"] > 0
    if original.rms is not None:
        pairs = zip(decoded.blocks, original.surface.blocks, strict=True)
        same = all(np.array_equal(found.points, block.points) for found, block in pairs)
        assert same == (EXPECTED[name]["layers"][-1]["max"] == 0)


def test_all_that_is_expected_is_small_and_written_alike() -> None:
    text = (FOLDER / "expected.json").read_text()
    assert text == lines(EXPECTED)
    sizes = [path.stat().st_size for path in FOLDER.iterdir() if path.is_file()]
    assert max(sizes) < 180_000
    assert sum(sizes) < 1_000_000


@pytest.mark.parametrize("name", NAMES)
def test_a_layer_without_segments_is_the_only_one(name: str) -> None:
    layers = reference.read_container(container_of(name)).layers
    assert len(layers) == 1 or all(layer.segments for layer in layers)


@pytest.mark.parametrize("name", NAMES)
def test_every_prefix_shows_the_last_whole_layer(name: str) -> None:
    container, layers = container_of(name), EXPECTED[name]["layers"]
    seen = -1
    decoder = ls.Decoder()
    for place in range(len(container)):
        decoder.feed(container[place : place + 1])
        if len(decoder.layers) - 1 != seen:
            seen = len(decoder.layers) - 1
            assert decoder.bytes == layers[seen]["bytes"] == place + 1
            assert digests(decoder.surface()) == layers[seen]["sha256"]
    assert seen == len(layers) - 1


@pytest.mark.parametrize("name", NAMES)
@pytest.mark.long
def test_a_flipped_bit_leaves_the_layers_before_it_and_a_clear_error(name: str) -> None:
    container, layers = container_of(name), EXPECTED[name]["layers"]
    shuffle = random.Random(name)
    for _ in range(12 if len(container) < 5000 else 6):
        place, bit = shuffle.randrange(len(container)), shuffle.randrange(8)
        damaged = bytearray(container)
        damaged[place] ^= 1 << bit
        decoder = ls.Decoder()
        try:
            decoder.feed(bytes(damaged))
            decoder.finish()
        except (ls.CorruptStreamError, ls.UnsupportedVersionError, ls.TruncatedStreamError):
            pass
        whole = [layer for layer in layers if layer["bytes"] <= place]
        assert len(decoder.layers) >= len(whole)
        for view, layer in zip(decoder.layers, layers, strict=False):
            assert (view.bytes, view.rms, view.max_error) == (layer["bytes"], layer["rms"], layer["max"])
        if decoder.layers:
            assert digests(decoder.surface()) == layers[len(decoder.layers) - 1]["sha256"]


def test_golden_values_reach_the_corners_of_their_types() -> None:
    hostile = ls.decode(container_of("heights-float64-hostile")).points
    assert np.signbit(hostile[0, 0])
    assert 0 < hostile[0, 1] < 1e-300
