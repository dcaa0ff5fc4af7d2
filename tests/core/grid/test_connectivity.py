from __future__ import annotations

from pathlib import Path
from unittest.mock import patch

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from lodestream.grid.axis import axis_step
from lodestream.grid.connectivity import LatticeBlock, cuts
from lodestream.transform.lifting import forward_step, inverse_step
from tests.examples import examples

from .arrangements import PREDICTORS, checked
from .layouts import cube, layouts, overlapping, tubes

DATA = Path(__file__).parents[4] / "shared" / "data"


@examples(50)
@given(layouts())
def test_any_layout_is_watertight_at_every_level(blocks: list[LatticeBlock]) -> None:
    arrangement = checked(blocks)
    assert {patch.block for patch in arrangement.patches} == set(range(len(blocks)))


@given(st.integers(1, 20), st.integers(0, 2**32))
def test_a_sphere_of_six_blocks_has_twelve_interfaces(faces: int, seed: int) -> None:
    arrangement = checked(cube(np.random.default_rng(seed), faces))
    assert len(arrangement.patches) == 6
    assert len(arrangement.interfaces) == 12
    assert all(all(patch.sides) for patch in arrangement.patches)


@given(overlapping())
def test_blocks_may_overlap(blocks: list[LatticeBlock]) -> None:
    assert len(checked(blocks).patches) >= len(blocks)


@given(tubes())
def test_rims_agree_or_are_cut_open(blocks: list[LatticeBlock]) -> None:
    assert len(checked(blocks).patches) >= len(blocks)


@given(layouts(), st.integers(1, 3))
def test_what_splits_too_much_is_given_up_and_the_rest_still_fits(blocks: list[LatticeBlock], limit: int) -> None:
    with patch.object(cuts, "PATCHES", 8 * limit), patch.object(cuts, "PATCHES_OF_BLOCK", 8):
        arrangement = checked(blocks, complete=False)
    assert len(arrangement.patches) <= 8 * (len(blocks) + limit)


@pytest.mark.parametrize(("name", "blocks", "interfaces"), [("m6_small", 9, 16), ("uneven_sphere_large", 6, 12)])
def test_real_files_share_as_many_sides_as_they_are_known_to(name: str, blocks: int, interfaces: int) -> None:
    path = DATA / f"{name}.fmt"
    if not path.exists():
        pytest.skip(f"{path.name} is not here")
    found = plot3d(path)
    arrangement = checked(found)
    assert (len(found), len(arrangement.patches), len(arrangement.interfaces)) == (blocks, blocks, interfaces)
    assert not any(interface.stops for interface in arrangement.interfaces)


def plot3d(path: Path) -> list[LatticeBlock]:
    words = path.read_text().split()
    count = int(words[0])
    sizes = np.array(words[1 : 1 + 3 * count], int).reshape(-1, 3)
    values = np.array(words[1 + 3 * count :], float)
    values *= 2**20 / np.abs(values).max()
    ends = np.cumsum(3 * sizes.prod(axis=1))
    pieces = np.split(np.rint(values).astype(np.int32), ends[:-1])
    return [
        LatticeBlock(piece.reshape(3, columns, rows).transpose(1, 2, 0), (False, False))
        for piece, (rows, columns, _) in zip(pieces, sizes, strict=True)
    ]


@pytest.mark.parametrize("predictor", PREDICTORS)
def test_steps_of_odd_lengths_between_clamped_ends_are_the_same_backwards(predictor: tuple[int, int]) -> None:
    """Nodes, details and what the inverse makes of any of them: why sides may be reversed where all lengths are odd."""
    rng = np.random.default_rng(1)
    for length in range(3, 70, 2):
        step = axis_step(length, False, (True, True))
        ahead = rng.integers(-(2**24), 2**24, (1, length), np.int32)
        back = ahead[:, ::-1].copy()
        for move in (forward_step, inverse_step):
            move(ahead, 1, step, predictor)
            move(back, 1, step, predictor)
            nodes, details = (step.coarse, length) if move is forward_step else (length, length)
            np.testing.assert_array_equal(ahead[:, :nodes], back[:, :nodes][:, ::-1])
            np.testing.assert_array_equal(ahead[:, nodes:details], back[:, nodes:details][:, ::-1])
            if move is forward_step:
                ahead[:, nodes:] //= 4
                back[:, nodes:] = ahead[:, nodes:][:, ::-1]
