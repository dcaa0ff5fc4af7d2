"""Containers of which nothing is believed: sound ones of every kind pass, and whatever is wrong is found."""

from __future__ import annotations

import io
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import lodestream as ls
from lodestream.container import Index, sections
from lodestream.container.digest import DIGEST
from lodestream.decoding.inspection import Inspection, inspect
from lodestream.entropy.mask import encode_mask

from ..container.forgery import (
    index_of,
    rewritten,
    sections_of,
    unchanged,
    with_header,
    with_layer_errors,
    with_metadata,
)

#: What a container does not keep is another matter, see test_losses.
pytestmark = pytest.mark.filterwarnings("ignore:values of attributes at:lodestream.FormatWarning")

GOLDEN = sorted((Path(__file__).parents[2] / "golden").glob("*.lode"))
MOST = 1 << 20


def inspected(data: bytes, most: int = MOST) -> Inspection:
    return inspect(io.BytesIO(data), max_vertices=most)


def hills(rows: int = 33, columns: int = 40) -> ls.Surface:
    r, c = np.mgrid[0:rows, 0:columns].astype(float)
    z = np.round(9 * np.sin(r / 5) * np.cos(c / 7), 2)
    mask = np.ones((rows, columns), bool)
    mask[4:9, 6:11] = False
    kind = (r % 4).astype(np.uint8)
    return ls.Surface(z.astype(np.float32), mask=mask, attributes={"kind": kind}, metadata={"name": "hills"})


@pytest.fixture(scope="module")
def exact() -> bytes:
    return ls.encode(hills())


@pytest.fixture(scope="module")
def near() -> bytes:
    return ls.encode(hills(), 0.05)


@pytest.mark.sweep(36)
@pytest.mark.parametrize("path", GOLDEN, ids=lambda path: path.stem)
def test_golden_containers_are_sound(path: Path) -> None:
    data = path.read_bytes()
    told: list[float] = []
    found = inspect(io.BytesIO(data), max_vertices=MOST, progress=told.append)
    known = index_of(data)
    assert replace(found.index, header=known.header) == known
    assert found.index.header.length == known.header.length
    assert found.errors_checked is found.index.header.exact
    assert told == sorted(told)
    assert told[-1] == 1.0


def test_every_prefix_is_cut_short(exact: bytes) -> None:
    for length in range(len(exact)):
        with pytest.raises(ls.TruncatedStreamError, match=r"\(at byte \d+\)"):
            inspected(exact[:length])


@pytest.mark.parametrize("rest", [b"\0", b"x" * 100, "itself"])
def test_nothing_follows_the_end(exact: bytes, rest: bytes | str) -> None:
    more = exact if rest == "itself" else rest
    assert isinstance(more, bytes)
    with pytest.raises(ls.CorruptStreamError, match=f"{len(more)} bytes more .at byte {len(exact)}"):
        inspected(exact + more)


@pytest.mark.long
def test_every_flipped_bit_is_found(exact: bytes) -> None:
    for place in range(len(exact)):
        for bit in (0, 5) if place % 7 else range(8):
            data = bytearray(exact)
            data[place] ^= 1 << bit
            with pytest.raises((ls.StreamError, ls.TooLargeError)):
                inspected(bytes(data))


def test_the_limit_is_looked_at_first(exact: bytes) -> None:
    inspected(exact, 33 * 40)
    with pytest.raises(ls.TooLargeError, match="at most 1,319 vertices, got 1,320"):
        inspected(exact, 33 * 40 - 1)
    wide = ls.encode(ls.Surface(np.arange(2 * 65, dtype=np.float32).reshape(1, 2, 65)))
    with pytest.raises(ls.TooLargeError, match="at most 64 values"):
        inspected(wide, 2)


def test_another_version(exact: bytes) -> None:
    for start in (sections.MAGIC + bytes([sections.VERSION + 1]), sections.MAGIC + b"\xff", b"\x89LODE\r\n\x03"):
        with pytest.raises(ls.UnsupportedVersionError, match=f"version {sections.VERSION}, .* got version {start[7]}"):
            inspected(start + exact[8:])


def test_what_is_rewritten_without_a_change_is_the_same(exact: bytes, near: bytes) -> None:
    for data in (exact, near):
        assert rewritten(data, unchanged) == data
        assert rewritten(data, unchanged, index_of(data)) == data


@pytest.mark.parametrize("place", [0, 1])
def test_forged_errors_of_layers_of_an_exact_container(exact: bytes, place: int) -> None:
    for number in range(len(index_of(exact).layers)):
        for factor in (0.5, 1 - 2e-6):
            with pytest.raises(ls.CorruptStreamError, match=f"error of layer {number}|that of the layer before"):
                inspected(with_layer_errors(exact, number, factor, place))
        inspected(with_layer_errors(exact, 0, 1 - 1e-13, place))  # another order of adding up


def test_forged_errors_of_levels_of_an_exact_container(exact: bytes) -> None:
    index = index_of(exact)
    for number, level in enumerate(index.levels):
        for changed in (
            replace(level, rms=level.rms / 2 or 1e-9),
            replace(level, max_error=level.max_error / 2 or 1.0),
        ):
            levels = list(index.levels)
            levels[number] = changed
            with pytest.raises(
                ls.CorruptStreamError, match=f"error of level {number}|errors .* of the complete surface"
            ):
                inspected(rewritten(exact, unchanged, replace(index, levels=tuple(levels))))


def test_forged_errors_of_others_are_told(near: bytes) -> None:
    forged = with_layer_errors(near, 0, 2.0, 1)
    assert inspected(forged).errors_checked is False
    assert inspected(forged).index.layers[0].max_error == 2 * index_of(near).layers[0].max_error
    with pytest.raises(ls.CorruptStreamError, match="that of the layer before"):
        inspected(with_layer_errors(near, 1, 1e9, 0))


def test_an_index_that_says_something_else(exact: bytes, near: bytes) -> None:
    for data in (exact, near):
        index = index_of(data)
        first = index.segments[0]
        others: list[Index] = [
            replace(index, layers=(replace(index.layers[0], rms=1e6), *index.layers[1:])),
            replace(index, segments=(first._replace(check=first.check ^ 1), *index.segments[1:])),
            replace(index, segments=(first._replace(top=first.top + 1), *index.segments[1:])),
            replace(index, segments=index.segments[1:]),
        ]
        if index.chunks:
            number = next(k for k, chunk in enumerate(index.chunks) if chunk.range.length)
            chunks = list(index.chunks)
            chunks[number] = chunks[number]._replace(check=chunks[number].check ^ 1)
            others.append(replace(index, chunks=tuple(chunks)))
        for other in others:
            with pytest.raises(ls.CorruptStreamError, match=f"at byte {index.index.offset}|expected"):
                inspected(rewritten(data, unchanged, other))


def test_a_forged_or_missing_digest(exact: bytes, near: bytes) -> None:
    def set_to(value: object) -> Callable[[dict[str, Any]], None]:
        return lambda values: values.update({DIGEST: value})

    inspected(with_metadata(exact, lambda values: values.pop(DIGEST)))  # nobody has to tell it
    for change in (set_to("0" * 64), set_to(7), set_to(["a"])):
        with pytest.raises(ls.CorruptStreamError, match="SHA-256"):
            inspected(with_metadata(exact, change))
    with pytest.raises(ls.CorruptStreamError, match="no SHA-256 of values that are not exact"):
        inspected(with_metadata(near, set_to("0" * 64)))
    inspected(with_metadata(exact, lambda values: values.update(name="another")))


@pytest.mark.parametrize(
    "values",
    [
        {"seam": 5},
        {"dtype": "no type"},
        {"dtype": "U40000000"},
        {"geotransform": "near the river"},
        {"geotransform": [1, 2]},
        {"angles": 4},
        {"angles": [{"channel": 0}]},
        {"axes": {"x": "a", "y": "b"}},
    ],
    ids=repr,
)
def test_metadata_that_would_upset_a_writer(exact: bytes, values: dict[str, Any]) -> None:
    index = index_of(exact)
    with pytest.raises(ls.CorruptStreamError, match=rf"metadata .*at byte {index.metadata.offset}"):
        inspected(with_metadata(exact, lambda known: known.update(values)))


def test_a_forged_extent_or_number_of_holes(exact: bytes, near: bytes) -> None:
    assert with_header(exact) == exact
    with pytest.raises(ls.CorruptStreamError, match="extent"):
        inspected(with_header(exact, extent=1e9))
    for data in (exact, near):
        with pytest.raises(ls.CorruptStreamError, match="holes"):
            inspected(with_header(data, holes=(24,)))


def test_a_block_without_a_valid_point(near: bytes) -> None:
    nothing = encode_mask(np.zeros((33, 40), np.bool_))
    with pytest.raises(ls.CorruptStreamError, match="a valid point in each block"):
        inspected(with_header(near, holes=(33 * 40,), mask_data=(nothing,)))


def test_sections_in_another_order_or_twice(exact: bytes) -> None:
    index = index_of(exact)
    patches = [exact[a:b] for a, b in sections_of(exact)]
    footer = exact[index.index.end :]
    for order in (
        [0, 1, *range(3, len(patches)), 2],
        [0, 0, *range(1, len(patches))],
        [0, 1, 2, *range(2, len(patches))],
        [*range(len(patches) - 2), len(patches) - 2, len(patches) - 2, len(patches) - 1],
        [1, 0, *range(2, len(patches))],
    ):
        data = exact[:8] + b"".join(patches[k] for k in order) + footer
        with pytest.raises(ls.StreamError):
            inspected(data)
    optional = sections.section(200, b"more")
    data = exact[: index.metadata.offset] + optional + exact[index.metadata.offset :]
    with pytest.raises(ls.CorruptStreamError):
        inspected(data)
