"""Containers whose checksums are right and whose fields are not: whatever reads them says what was expected, where."""

from __future__ import annotations

import io
import random
from collections.abc import Callable
from functools import cache
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

import lodestream as ls
from lodestream.container import sections
from lodestream.decoding.inspection import inspect
from lodestream.errors import CorruptStreamError, LodestreamError, TruncatedStreamError
from lodestream.planning.planner import plan
from lodestream.planning.selection import selection_of
from lodestream.planning.window_errors import read_window_errors
from lodestream.transfer.range_download import RangeDownload
from lodestream.transfer.receiver_state import ReceiverState
from tests.golden.generate import FOLDER

from ..surfaces import all_large, index_of, terrain
from ..transfer.test_range_download import File
from .forgery import with_dtypes
from .mutants import Anatomy, mutant

MOST = 20_000
REGION = (0, 5), (1, 4)
#: With masks, kept holes, attributes, parts and curves, indices, large units, chunks of every rule.
NAMES = (
    *("holes-closed", "infinite-plane", "cylinder-disc", "error-attributes", "large-sparse", "heights-decimal"),
    *("heights-noise", "heights-offsets", "residual-decimals"),
)


@cache
def containers() -> dict[str, tuple[bytes, int]]:
    """Small ones with everything that a container may have, and how many channels each has."""
    heights = terrain((9, 12), 4)
    attributes: dict[str, NDArray[Any]] = {"k": np.rint(heights).astype(np.int8), "t": heights.astype(np.float32)}
    with all_large():
        large = ls.encode(ls.Surface(np.rint(heights).astype(np.int16), attributes=attributes))
    found = {name: (FOLDER / f"{name}.lode").read_bytes() for name in NAMES}
    found |= {"attributes": large, "windows": ls.encode(terrain((70, 66)).astype(np.float32), 2.0)}
    return {name: (data, index_of(data).header.channels) for name, data in found.items()}


def read_whole(data: bytes) -> None:
    decoder = ls.Decoder(max_vertices=MOST)
    decoder.feed(data)
    decoder.finish()
    decoder.surface()


def read_in_chunks(data: bytes) -> None:
    decoder = ls.Decoder(max_vertices=MOST)
    for start in range(0, len(data), 97):
        decoder.feed(data[start : start + 97])


def read_index(data: bytes) -> None:
    index = index_of(data)
    for target in (ls.Target(), ls.Target(order="level"), ls.Target(level=1)):
        assert all(0 <= place.offset <= place.end <= len(data) for place in plan(index, target).ranges)
    errors = read_window_errors(index, lambda offset, length: data[offset : offset + length])
    assert errors is None or errors.cell


def read_by_ranges(data: bytes) -> None:
    File(data).serve(RangeDownload(ReceiverState(ls.Target(order="level"), max_vertices=MOST)))


def read_window(data: bytes) -> None:
    target = ls.Target(region=REGION)
    reception = ReceiverState(target, max_vertices=MOST)
    File(data).serve(RangeDownload(reception))
    decoder = ls.Decoder(selection_of(target), max_vertices=MOST)
    decoder.feed(data)
    decoder.surface()


TRANSPORTS: list[Callable[[bytes], Any]] = [
    read_whole,
    read_in_chunks,
    read_index,
    read_by_ranges,
    read_window,
    lambda data: inspect(io.BytesIO(data), max_vertices=MOST),
]


@pytest.mark.parametrize("name", containers())
def test_a_container_that_was_taken_apart_and_built_again_is_the_same(name: str) -> None:
    data, channels = containers()[name]
    assert Anatomy.of(data, channels).built() == data


@pytest.mark.parametrize("name", containers())
def test_every_fault_is_told(name: str) -> None:
    data, channels = containers()[name]
    chance, refused = random.Random(name), 0
    for number in range(120):
        changed = mutant(data, channels, chance)
        transport = TRANSPORTS[number % len(TRANSPORTS)]
        try:
            transport(changed)
        except LodestreamError as error:
            refused += 1
            told = str(error)
            assert "expected" in told
            assert not isinstance(error, CorruptStreamError | TruncatedStreamError) or " byte" in told  # noqa: PT017
    assert refused > 60


@pytest.mark.parametrize("name", containers())
def test_values_of_another_dtype_are_refused_or_have_it(name: str) -> None:
    """Bits of coefficients say nothing of dtypes; chunks of the residual fit some others too."""
    original, _ = containers()[name]
    refused = 0  # in our words
    for what, dtype, data in with_dtypes(original):
        for transport in TRANSPORTS:
            try:
                transport(data)
            except LodestreamError as error:
                refused += "expected" in str(error)
        try:
            block = ls.decode(data, max_vertices=MOST).blocks[0]
        except LodestreamError:
            continue
        assert (block.points if what is None else block.attributes[what]).dtype == dtype
    assert refused or not index_of(original).header.corrected


def test_nothing_stands_before_the_header() -> None:
    data = (FOLDER / "two-points.lode").read_bytes()
    changed = data[:8] + sections.section(200, b"anything") + data[8:]
    for transport in TRANSPORTS:
        with pytest.raises(LodestreamError, match="expected"):
            transport(changed)
    bytewise = ls.Decoder()
    bytewise.feed(changed[:8])
    with pytest.raises(CorruptStreamError, match="expected the header section first, got kind 200"):
        bytewise.feed(changed[8:])
