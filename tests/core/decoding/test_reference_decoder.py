from __future__ import annotations

import functools
import hashlib
import json
import math
from pathlib import Path
from typing import Any

import pytest
from numpy.typing import NDArray

from lodestream.errors import CorruptStreamError
from lodestream.reference import Container, Decoder, Index, Shown, decode, read_container, read_index

GOLDEN = Path(__file__).parents[2] / "golden"
EXPECTED: dict[str, dict[str, Any]] = json.loads((GOLDEN / "expected.json").read_text())
AFFORDED = 30_000  # values that plain Python reconstructs in about a second


def values_of(name: str) -> int:
    arrays = [array for block in EXPECTED[name]["blocks"] for array in (block["points"], *block["attributes"].values())]
    return sum(math.prod(array["shape"]) for array in arrays)


def parameters(most: float = math.inf) -> list[str]:
    """Names of surfaces of fewer values."""
    return [name for name in EXPECTED if values_of(name) < most]


golden = pytest.mark.parametrize("name", parameters())
small = pytest.mark.parametrize("name", parameters(AFFORDED))


@functools.cache
def file_of(name: str) -> bytes:
    return (GOLDEN / f"{name}.lode").read_bytes()


@functools.cache
def decoded(name: str) -> tuple[Container, Decoder]:
    container = read_container(file_of(name))
    return container, decode(container)


@functools.cache
def surface_of(name: str) -> list[Shown]:
    container, decoder = decoded(name)
    return decoder.shown(residual=container.residual)


def index_of(name: str) -> Index:
    return read_index(file_of(name), decoded(name)[0])


def digests(blocks: list[Shown]) -> list[str]:
    return [hashlib.sha256(b"".join(array.tobytes() for array in block.arrays)).hexdigest()[:20] for block in blocks]


def kind(array: NDArray[Any]) -> dict[str, Any]:
    return {"type": array.dtype.name, "shape": list(array.shape)}


@golden
def test_the_header_says_what_the_surface_is(name: str) -> None:
    container, _ = decoded(name)
    header = container.header
    names = [attribute.name for attribute in header.attributes]
    for block, shown, expected in zip(header.blocks, surface_of(name), EXPECTED[name]["blocks"], strict=True):
        points, *attributes = shown.arrays
        assert kind(points) == expected["points"]
        assert dict(zip(names, map(kind, attributes), strict=True)) == expected["attributes"]
        assert list(block.closed) == expected["closed"]
        assert int((~shown.valid).sum()) == expected["holes"]
    assert (container.residual is not None) == header.has_residual
    assert any((~mask).any() for mask in container.masks.valid) == header.has_masks


@golden
def test_the_values_have_the_digest_of_the_metadata(name: str) -> None:
    container, _ = decoded(name)
    assert container.metadata is not None
    found = hashlib.sha256(b"".join(array.tobytes() for block in surface_of(name) for array in block.arrays))
    assert container.metadata.get("values_sha256") == (found.hexdigest() if container.header.exact else None)


@golden
def test_every_layer_gives_its_reconstruction(name: str) -> None:
    container, decoder = decoded(name)
    expected = EXPECTED[name]["layers"]
    last = len(container.layers)
    assert last == container.header.layers == len(expected) - (container.residual is not None)
    for layer, wanted in zip(container.layers, expected, strict=False):
        assert (layer.end, layer.errors.rms, layer.errors.maximum) == (wanted["bytes"], wanted["rms"], wanted["max"])
    afforded = max(2, AFFORDED // values_of(name))
    for count in sorted({round(1 + k * (last - 1) / (afforded - 1)) for k in range(afforded)}):
        shown = decoder.shown(count) if count < last or container.residual else surface_of(name)
        assert digests(shown) == expected[count - 1]["sha256"], f"layer {count}"
    assert digests(surface_of(name)) == expected[-1]["sha256"]
    if container.residual is not None:
        assert container.residual.errors[:2] == (expected[-1]["rms"], expected[-1]["max"])


@golden
def test_every_level_gives_its_grids(name: str) -> None:
    container, decoder = decoded(name)
    *coarser, finest = EXPECTED[name]["levels"]
    assert len(coarser) == container.header.finest
    assert [digests(decoder.shown(level=level)) for level in range(len(coarser))] == coarser
    assert digests(surface_of(name)) == finest


@golden
def test_the_index_finds_every_segment_of_the_layers(name: str) -> None:
    container, index = decoded(name)[0], index_of(name)
    assert index.layer_errors == [layer.errors for layer in container.layers]
    complete = container.residual or container.layers[-1]
    assert index.level_errors[-1] == complete.errors
    for layer, entries in zip(container.layers, index.segments, strict=True):
        for segment, entry in zip(layer.segments, entries, strict=True):
            found = entry.take(file_of(name))  # which checks the segment's CRC
            assert (found.unit, found.passes, found.data) == (segment.unit, segment.passes, segment.data)
            assert segment.top in (None, found.top)
    chunks = [chunk.take(file_of(name)).data for chunk in index.chunks]
    assert chunks == ([] if container.residual is None else container.residual.chunks)


def test_the_files_have_chunks_of_every_rule() -> None:
    containers = [read_container(file_of(name)) for name in EXPECTED]
    chunks = [chunk for container in containers if container.residual for chunk in container.residual.chunks if chunk]
    assert {chunk[0] & 3 for chunk in chunks} == {0, 1, 2, 3}


@small
def test_the_index_alone_gives_the_levels_one_after_another(name: str) -> None:
    index = index_of(name)
    entries = [entry for layer in index.segments for entry in layer]
    decoder = Decoder(decoded(name)[0].header, decoded(name)[0].masks)
    for level, wanted in enumerate(EXPECTED[name]["levels"][:-1]):
        own = [entry for entry in entries if decoder.tile(entry.unit).level == level]
        decoder.take([entry.take(file_of(name)) for entry in own], level)
        assert digests(decoder.shown(level=level)) == wanted


@pytest.mark.parametrize("name", ["cylinder-even", "planar-open", "holes-float32"])
def test_the_beginning_of_a_file_gives_the_layers_that_it_holds(name: str) -> None:
    for count, wanted in enumerate(EXPECTED[name]["layers"][: len(decoded(name)[0].layers)], 1):
        for missing in (0, 1):
            container = read_container(file_of(name)[: wanted["bytes"] - missing])
            assert len(container.layers) == count - missing
            if not missing:
                assert digests(decode(container).shown()) == wanted["sha256"]


def test_a_damaged_layer_ends_what_is_taken_and_a_damaged_segment_is_refused() -> None:
    data = bytearray(file_of("cylinder-even"))
    entry = index_of("cylinder-even").segments[3][0]
    data[entry.start] ^= 1
    assert len(read_container(bytes(data)).layers) == 3
    with pytest.raises(CorruptStreamError, match="CRC"):
        entry.take(bytes(data))
