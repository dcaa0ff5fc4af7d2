"""The measurer of regions beside those before it: in one piece, by rows, by blocks."""

from __future__ import annotations

import warnings
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

import lodestream as ls
from lodestream.bands.grid_measuring import BlocksMeasurer
from lodestream.bands.measuring import RowsMeasurer
from lodestream.bands.windows import RowsGiven
from lodestream.decoding import measurer
from lodestream.decoding.measurer import Measurer
from lodestream.decoding.region import Region
from lodestream.decoding.values import region_of_blocks, values_of
from lodestream.encoding import encoder
from lodestream.encoding.allocated import Allocated
from lodestream.encoding.measured import _Measuring, _told, all_passes, level_states, shown_states
from lodestream.entropy.part_table import part_of
from lodestream.entropy.tiles import Tiles
from tests.unchanged.cases import random_case


def allocated_of(seed: int) -> Allocated | None:
    """What the encoder measures of a surface; None where it refuses it."""
    found: list[Allocated] = []

    def keep(allocated: Allocated, progress: Any) -> Any:
        found.append(allocated)
        raise ls.InputError("enough")

    case = random_case(seed)
    with pytest.MonkeyPatch.context() as patch, warnings.catch_warnings():
        warnings.simplefilter("ignore")
        patch.setattr(encoder, "measure", keep)
        with pytest.raises(ls.InputError):
            ls.encode(case.surface, **case.options)
    return found[0] if found else None


def part_tiles(tiles: Tiles, region: Region) -> Tiles:
    """What is known of the tiles of a region."""
    part = part_of(tiles.table, region.tiles)
    own = Tiles(part.table)
    starts = tiles.table.starts
    for run, span in part.spans:
        for name in ("known", "sign", "early"):
            getattr(own, name)[span] = getattr(tiles, name)[starts[run.start] : starts[run.stop]]
    return own


@settings(deadline=None, max_examples=60)
@given(seed=st.integers(0, 5000), side=st.sampled_from([100, 1024]), whole=st.sampled_from([1, 1 << 20]))
def test_figures_are_those_of_before(seed: int, side: int, whole: int) -> None:
    allocated = allocated_of(seed)
    if allocated is None:
        return
    quantized, header = allocated.quantized, allocated.header
    states = [
        *shown_states(header, allocated.states, all_passes([channel.top for channel in quantized.channels])),
        *level_states(header),
    ][:20]
    prepared = quantized.prepared
    region = Region.whole(header.layout, header.levels)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(measurer, "_WINDOW_SIDE", side)
        patch.setattr(measurer, "_WHOLE_POINTS", whole)
        found = Measurer(header, region, allocated.tiles, prepared.comparisons(region)).errors(states)
        before = _Measuring(allocated).every(states)
        for (errors, cells), (expected, others) in zip(found, before, strict=True):
            assert _told(errors) == expected
            if header.arrangement is None and errors.maximum:
                np.testing.assert_array_equal(cells, others)
        if quantized.prepared.rms is not None:
            return
        if header.arrangement is None:
            rows, columns = header.shape
            for span in ((0, min(128, rows)), (128, rows)):
                if span[0] < span[1]:
                    region = Region.window(header.layout, header.levels, span, (0, columns))
                    tiles = [part_tiles(own, region) for own in allocated.tiles]
                    old = RowsMeasurer(
                        RowsGiven.prepared(prepared, span),
                        header.lattices,
                        header.geometric,
                        np.array(header.predictors),
                        region,
                        tiles,
                    )
                    check(header, region, tiles, prepared, states, old.figures(states))
                    kinds = [(array.shape[2], array.dtype) for array in prepared.arrays[0]]
                    same(values_of(header, region, tiles, states[-1])[0], old.values(states[-1], kinds))
            return
        for blocks in (range(1), range(1, len(header.blocks)), range(len(header.blocks))):
            if blocks:
                region = region_of_blocks(header, header.levels, blocks)
                patches = measurer.patches_of(region)
                tiles = [part_tiles(own, region) for own in allocated.tiles]
                every = Region.of_grids(header.layout, header.levels, region.grids[-len(patches) :])
                assert list(every.grids) == list(region.grids)
                old_blocks = BlocksMeasurer(header, tiles, blocks, patches)
                others_ = prepared.others_of(patches) if header.channels > 1 else []
                figures = old_blocks.figures(states, prepared.originals_of(patches), others_)
                check(header, region, tiles, prepared, states, figures)
                new, old_values = values_of(header, region, tiles, states[-1]), old_blocks.values(states[-1])
                assert list(new) == list(old_values)
                for block in new:
                    same(new[block], old_values[block])


def check(header: Any, region: Region, tiles: list[Tiles], prepared: Any, states: Any, old: Any) -> None:
    figures = Measurer(header, region, tiles, prepared.comparisons(region)).figures(states)
    for name in ("squares", "equal", "counts"):
        np.testing.assert_array_equal(getattr(figures, name), getattr(old, name))


def same(values: Any, others: Any) -> None:
    for array, other in zip(values.arrays, others.arrays, strict=True):
        assert array.dtype == other.dtype
        assert array.tobytes() == other.tobytes()
