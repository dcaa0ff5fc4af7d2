"""The rule by which callers share what is limited."""

from __future__ import annotations

__all__ = ["exceeds_share"]


def exceeds_share(most: int, taken: int, by_caller: int) -> bool:
    """Return whether one more place is beyond the share of a caller.

    A caller may take as much as it leaves free for the others: one caller alone gets half of everything, the next one
    half of the rest. So a caller that has nothing yet finds a place, unless there are very many callers.

    Parameters
    ----------
    most : int
        Number of places.
    taken : int
        Places that all callers have taken.
    by_caller : int
        Places that this caller has taken.
    """
    return by_caller >= most - taken
