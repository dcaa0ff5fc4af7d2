"""Surfaces of several blocks, and such that touch themselves, built by runs of grids: the bytes of one piece."""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor
from typing import Any
from unittest import mock

import numpy as np
import pytest
from hypothesis import assume, example, given, settings
from hypothesis import strategies as st

import lodestream as ls
from lodestream.bands import made
from lodestream.encoding.prepared import prepare
from lodestream.quality import Quality

from .block_surfaces import KINDS, block_surface
from .test_building import built

#: What a container does not keep is another matter, see test_losses.
pytestmark = pytest.mark.filterwarnings("ignore:values of attributes at:lodestream.FormatWarning")

lengths = st.integers(4, 20) | st.integers(4, 150)


@settings(max_examples=25, deadline=None)
@given(
    kind=st.sampled_from(KINDS),
    shape=st.tuples(lengths, lengths),
    count=st.integers(1, 4),
    dtype=st.sampled_from(["float32", "float64", "int32", "int64"]),
    more=st.sampled_from(["", "", "holes", "attributes", "holes and attributes"]),
    precision=st.sampled_from([None, "1e-3d", 0.02]),
    points=st.integers(1, 5_000),
    core=st.integers(1, 600),
    threads=st.integers(1, 3),
    seed=st.integers(0, 2**32 - 1),
)
@example("plates", (150, 140), 3, "float32", "holes and attributes", None, 1, 1, 2, 1)
@example("plates", (150, 140), 3, "float64", "", "1e-3d", 1, 1, 2, 2)
@example("cylinders", (130, 120), 3, "float32", "", None, 1, 1, 1, 3)
@example("sphere", (120, 130), 1, "float32", "attributes", None, 1, 1, 1, 4)
@example("seam", (60, 63), 1, "float32", "", "1e-3d", 1, 1, 1, 5)
@example("moebius", (24, 90), 3, "int32", "", None, 1, 1, 1, 6)
@example("heights", (120, 90), 3, "int64", "holes", None, 1, 1, 1, 7)
def test_any_blocks(
    kind: str,
    shape: tuple[int, int],
    count: int,
    dtype: str,
    more: str,
    precision: Any,
    points: int,
    core: int,
    threads: int,
    seed: int,
) -> None:
    surface = block_surface(kind, shape, count, dtype, more, np.random.default_rng(seed))
    quality = Quality.of(precision)
    try:
        whole = ls.encode(surface, precision)
    except ls.InputError:
        assume(False)  # this precision is too small for the values
    with ThreadPoolExecutor(threads) as executor, mock.patch.multiple(made, _FEWEST=1, _MOST=points):
        own = executor if seed % 2 else None
        assert ls.encode(surface, precision, memory=1 << 20, executor=own) == whole
    if prepare(surface, quality).arrangement is not None:
        container = built(surface, points, core, threads, precision=precision)
        # Of noise the shortest of several streams is kept, and this is the first.
        assert container == whole or (len(container) > len(whole) and precision is None)
