"""Tables of some tiles: the same units as in the table of all."""

from __future__ import annotations

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from lodestream.encoding.pieces import Pieces
from lodestream.entropy.part_table import flat_span, part_of
from lodestream.entropy.tile_coder import Channel, TileCoder, planes_of
from lodestream.entropy.tiles import TileTable, gather
from lodestream.grid.layout import Layout

shapes = st.tuples(st.integers(1, 60), st.integers(1, 60))
closed = st.tuples(st.booleans(), st.booleans())


def _coded(table: TileTable, flat: np.ndarray, large: int) -> tuple[TileCoder, list[bytes]]:
    tops = np.array([planes_of(table, flat, tile) for tile in range(len(table.members))], np.int8)
    coder = TileCoder([table], [Channel(flat, np.ones(len(table.bands)), tops)], 1, None, large)
    return coder, [
        coder.code(tile, 0, 2 * int(top) - 1, 2 * int(top) - 1) if top else b"" for tile, top in enumerate(tops)
    ]


@given(shapes, closed, st.integers(1, 3), st.integers(1, 300), st.integers(0, 3), st.integers(0, 2**32 - 1))
def test_bands_with_their_parents_are_coded_as_in_the_table_of_all(
    shape: tuple[int, int], ends: tuple[bool, bool], exponent: int, points: int, large: int, seed: int
) -> None:
    layout = Layout([*Layout.single(shape, ends, (exponent, exponent)).grids], (exponent, exponent))
    table, bands = TileTable.of(layout), Pieces(layout, points, core_points=9)
    own = np.random.default_rng(seed).integers(-40, 40, shape).astype(np.int32)
    flat = gather(table, [own])
    whole, strings = _coded(table, flat, large)
    for level in bands.levels:
        for band in bands.of(level):
            parents = sorted({layout.parents[tile] for tile in band.tiles} - {-1})
            runs = [range(parents[0], parents[-1] + 1)] if parents else []
            part = part_of(table, [*runs, band.tiles])
            local = np.zeros(part.table.size, np.int32)
            for run, span in part.spans:
                local[span] = flat[flat_span(table, run)]
            coder, _ = _coded(part.table, local, large)
            for tile in band.tiles:
                number = part.local(tile)
                top = planes_of(part.table, local, number)
                assert not top or coder.strings.get((number, 0), (None,))[0] == whole.strings.get((tile, 0), (None,))[0]
                spans = [span for run, span in part.spans if tile in run]
                assert len(spans) == 1
            # The units of the band follow their parents, as in the table of all.
            again = _coded(part.table, local, large)[1]
            assert [again[part.local(tile)] for tile in band.tiles] == [strings[tile] for tile in band.tiles]
            early = coder.tiles[0].early[part.spans[-1][1]]
            assert np.array_equal(early, whole.tiles[0].early[flat_span(table, band.tiles)])
