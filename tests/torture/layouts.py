"""Random cells of the generated meshes, each laid out in blocks."""

from __future__ import annotations

import time
from dataclasses import dataclass

import numpy as np

from tests.core.remesh import scenes
from tests.core.remesh.layouts import check_pairs, cut

__all__ = ["LaidOut", "run"]


@dataclass
class LaidOut:
    """What a run did: layouts, those of open meshes among them, cells and blocks of all together."""

    layouts: int = 0
    open: int = 0
    cells: int = 0
    blocks: int = 0


def run(count: int, most: float | None = None, first: int = 0) -> LaidOut:
    """Lay out random cells, a mesh after the other; see `check_pairs`.

    Parameters
    ----------
    count : int
        How many layouts.
    most : float or None
        Most seconds; what is left then is not done.
    first : int
        The seed of the first one.

    Raises
    ------
    AssertionError
        A layout has a triangle without partner, or blocks that are not watertight; the message names it.
    """
    done, end = LaidOut(), time.monotonic() + (float("inf") if most is None else most)
    meshes = {**scenes.CLOSED, **scenes.OPEN}
    for seed in range(first, first + count):
        if time.monotonic() >= end:
            break
        name = [*meshes][seed % len(meshes)]
        cells = cut(*meshes[name](), int(np.random.default_rng(seed).integers(4, 61)), seed)
        try:
            done.blocks += check_pairs(cells, name in scenes.CLOSED)
        except AssertionError as error:
            raise AssertionError(f"{name}, seed {seed}: {error}") from error
        done.layouts += 1
        done.open += name in scenes.OPEN
        done.cells += cells.count
    return done
