"""Whether patches cover their blocks, as a header's reader asks before it believes anything."""

from __future__ import annotations

import random
import time

import pytest

from lodestream.container.fields import FieldReader, FieldWriter
from lodestream.container.shape import parse_arrangement, serialize_arrangement
from lodestream.grid.connectivity import Arrangement, Patch, whole_patch
from lodestream.grid.multiblock import covers

OPEN = (False, False)
SIDES = (None, None, None, None)
ENDS = (False, False, False, False)


def patch(rows: tuple[int, int], columns: tuple[int, int]) -> Patch:
    return Patch(0, rows, columns, OPEN, OPEN, SIDES, ENDS, OPEN)


@pytest.mark.parametrize("seed", range(60))
def test_patches_cover_a_block_where_each_cell_is_in_one(seed: int) -> None:
    chance = random.Random(seed)
    shape = chance.randint(2, 6), chance.randint(2, 6)
    for _ in range(200):
        patches = []
        for _ in range(chance.randint(1, 4)):
            windows = [sorted(chance.sample(range(n), 2)) for n in shape]
            patches.append(patch(*((first, last + 1) for first, last in windows)))
        cells = [
            (row, column)
            for own in patches
            for row in range(own.rows[0], own.rows[1] - 1)
            for column in range(own.columns[0], own.columns[1] - 1)
        ]
        whole = {(row, column) for row in range(shape[0] - 1) for column in range(shape[1] - 1)}
        assert covers(shape, OPEN, patches) == (sorted(cells) == sorted(whole))


def test_as_many_patches_and_blocks_as_there_may_be_are_read_at_once() -> None:
    """A header of half a megabyte must not keep a reader busy for minutes."""
    count = 1 << 14
    strips = Arrangement(tuple(patch((row, row + 2), (0, 3)) for row in range(count)), ())
    blocks = Arrangement(tuple(whole_patch(number, (3, 3), OPEN) for number in range(count)), ())
    for shapes, arrangement in (((((count + 1, 3), OPEN),), strips), ((((3, 3), OPEN),) * count, blocks)):
        out = FieldWriter()
        serialize_arrangement(out, shapes, arrangement)
        began = time.process_time()
        assert parse_arrangement(FieldReader(bytes(out.data), 0)) == (shapes, arrangement)
        assert time.process_time() - began < 90
