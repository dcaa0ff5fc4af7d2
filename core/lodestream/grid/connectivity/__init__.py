"""Sides that blocks share: where blocks are split, the direction of axes, and interfaces that are coded once.

Blocks that meet along points of their sides must have the same points there at every level. So a shared side becomes an
*interface*, coded once, and every block that has it is *clamped* at all its open ends (``docs/mathematics.md``, section
6): then a side's points at a coarser level depend on the side's points alone. For that, an interface must be the whole
side of every patch that uses it, and be coarsened the same way from all of them:

- `find_contacts` finds where sides run through the same points of the lattice;
- `find_cuts` splits blocks where a contact ends amid a side, as far as the cut goes;
- `arrange` finds the patches, matches their sides, and turns the patches round so that gaps lie at the same end.
"""

from __future__ import annotations

from .arrange import arrange
from .model import Arrangement, Interface, LatticeBlock, Patch, Side, assemble, stored, stored_side, whole_patch

__all__ = [
    "Arrangement",
    "Interface",
    "LatticeBlock",
    "Patch",
    "Side",
    "arrange",
    "assemble",
    "stored",
    "stored_side",
    "whole_patch",
]
