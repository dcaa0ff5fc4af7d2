"""Containers that are checked by bands of rows: what is found in one piece is found here."""

from __future__ import annotations

import io

import numpy as np
import pytest

import lodestream as ls
from lodestream.decoding.inspection import Inspection, _Part, inspect

from ..container.forgery import index_of, with_layer_errors
from ..encoding.grid_surfaces import SURFACES, container_of

MOST = 1 << 20


def _inspected(data: bytes, memory: int = 1, told: list[float] | None = None) -> Inspection:
    told = [] if told is None else told
    return inspect(io.BytesIO(data), max_vertices=MOST, memory=memory, progress=told.append)


@pytest.mark.sweep(8)
@pytest.mark.parametrize("name", SURFACES)
def test_sound_containers_pass(name: str) -> None:
    data, told = container_of(name), list[float]()
    found = _inspected(data, told=told)
    wanted = _inspected(data, 1 << 30)
    assert found.errors_checked is wanted.errors_checked
    assert found.index.layers == wanted.index.layers
    assert told == sorted(told)
    assert told[-1] == 1.0


@pytest.mark.sweep(6)
@pytest.mark.parametrize("name", ["integers", "holes", "attributes", "torus"])
@pytest.mark.parametrize("part", [0.0, 0.2])
@pytest.mark.parametrize("place", [0, 1])
@pytest.mark.long
def test_wrong_errors_are_found(name: str, part: float, place: int) -> None:
    data = container_of(name)
    number = round(part * (len(index_of(data).layers) - 1))
    with pytest.raises(ls.CorruptStreamError, match=f"RMS and maximum error of layer {number}"):
        _inspected(with_layer_errors(data, number, 0.99, place))


def test_a_flipped_bit_is_found() -> None:
    data = bytearray(container_of("integers"))
    for place in range(20, len(data), len(data) // 40):
        data[place] ^= 4
        with pytest.raises(ls.LodestreamError):
            _inspected(bytes(data))
        data[place] ^= 4


def test_what_cannot_be_decoded_by_bands_takes_its_memory() -> None:
    rows, columns = np.mgrid[:300, :200].astype(float)
    data = ls.encode(np.stack([columns, rows, np.hypot(rows, columns)], axis=-1))
    with pytest.raises(ls.TooLargeError, match=r"at most 0 MiB to check, got one that takes about 1 MiB .*rules"):
        _inspected(data)
    assert _inspected(data, 1 << 30).errors_checked


def test_more_vertices_than_allowed_are_refused() -> None:
    data = ls.encode(np.zeros((1025, 1025), np.int16))
    with pytest.raises(ls.TooLargeError, match="expected at most 1,048,576 vertices, got 1,050,625"):
        _inspected(data)


def test_holes_are_what_is_not_valid_and_what_is_not_finite() -> None:
    points, mask = np.zeros((4, 5, 3), np.float32), np.ones((4, 5), np.bool_)
    points[0, 0, 1] = points[1, 3, 2] = np.nan
    points[2, 2, 0] = np.inf
    mask[0, 0] = mask[3, 4] = False
    assert _Part([points], None).holes == 3
    assert _Part([points], mask).holes == 4
    assert _Part([np.zeros((4, 5, 3), np.int16)], mask).holes == 2
