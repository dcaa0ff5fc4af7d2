from __future__ import annotations

import functools
import math

import pytest

from lodestream.errors import CorruptStreamError
from tests import reference
from tests.golden.comparison import EXPECTED, compared, digests, file_of, values_of
from tests.reference import Container, Decoder, Index, decode, read_container, read_index

AFFORDED = 5_000  # values that plain Python reconstructs in about a tenth of a second


def parameters(most: float = math.inf) -> list[str]:
    """Names of surfaces of fewer values."""
    return [name for name in EXPECTED if values_of(name) < most]


golden = pytest.mark.parametrize("name", parameters())
small = pytest.mark.parametrize("name", parameters(AFFORDED // 2))


@functools.cache
def decoded(name: str) -> tuple[Container, Decoder]:
    container = read_container(file_of(name))
    return container, decode(container)


def index_of(name: str) -> Index:
    return read_index(file_of(name), decoded(name)[0])


@pytest.mark.sweep(32)
@golden
def test_a_golden_file_gives_what_is_expected_of_it(name: str) -> None:
    for what, found, expected in compared(reference, name, max(2, AFFORDED // values_of(name))):
        assert found == expected, what


def test_the_files_have_chunks_of_every_rule() -> None:
    containers = [read_container(file_of(name)) for name in EXPECTED]
    chunks = [chunk for container in containers if container.residual for chunk in container.residual.chunks if chunk]
    assert {chunk[0] & 3 for chunk in chunks} == {0, 1, 2, 3}


@pytest.mark.sweep(16)
@small
@pytest.mark.long
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
