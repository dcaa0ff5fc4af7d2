"""What callers share: each may have as much as it leaves for the others."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import NamedTuple

from lodestream.errors import LodestreamError

from ..problems import BusyError, TooManyError
from .access import Caller

__all__ = ["Held", "Share"]


class Held(NamedTuple):
    """How much there is of something, and who has it.

    Attributes
    ----------
    most : int
        All that there is.
    taken : int
        What all callers have together.
    own : int
        What one of them has.
    """

    most: int
    taken: int
    own: int

    @property
    def left(self) -> int:
        """How much more that caller may take; negative if it has more than its share already.

        With it, the caller has at most one more than is left then. So one caller alone gets half of everything, the
        next one half of the rest, and one that has nothing yet finds a place, unless there are very many callers.
        """
        return (self.most - self.taken - self.own + 1) // 2


class Share:
    """Something that callers share; it counts what they have taken. Everything here runs in the event loop.

    Parameters
    ----------
    what : str
        What is counted, in the plural, for error messages.
    most : int
        How much there is.
    alone : callable
        Returns whether there is nobody to share with; one caller may then take everything.
    each : int or None
        What one caller may have, even alone; None: as much as it leaves for the others.
    full, beyond : exception class
        Raised where all is taken, and where a caller has its share.
    advice : str
        What to do then.
    """

    def __init__(
        self,
        what: str,
        most: int,
        alone: Callable[[], bool],
        *,
        each: int | None = None,
        full: type[LodestreamError] = BusyError,
        beyond: type[LodestreamError] = TooManyError,
        advice: str = "try again when some are done",
    ) -> None:
        self._what = what
        self._most = most
        self._alone = alone
        self._each = each
        self._full = full
        self._beyond = beyond
        self._advice = advice
        self._taken: Counter[str] = Counter()
        self._total = 0

    def of(self, key: str) -> int:
        """Return what the caller with this key has taken."""
        return self._taken[key]

    def held(self, key: str) -> Held:
        """Return how much there is, and what all callers and the one with this key have taken."""
        return Held(self._most, self._total, self._taken[key])

    def left(self, key: str) -> int:
        """Return how much the caller with this key may take."""
        held = self.held(key)
        return max(held.most - held.taken if self._alone() else held.left, 0)

    def check(self, caller: Caller, amount: int = 1, held: Held | None = None) -> None:
        """Check that a caller may take more.

        Parameters
        ----------
        caller : Caller
        amount : int
        held : Held or None
            How much is taken, where that is counted elsewhere; may then be called from any thread.

        Raises
        ------
        LodestreamError
            Of the class ``full`` if there is no more of it, or of the class ``beyond`` if the caller has its share.
        """
        most, taken, own = found = self.held(caller.key) if held is None else held
        more = f" and {amount} more" if amount > 1 else ""
        if self._each is not None:
            if own + amount > self._each:
                raise self._beyond(
                    f"{caller.name} may have at most {self._each} {self._what}, and has {own}{more}; {self._advice}"
                )
            return
        if taken + amount > most:
            raise self._full(
                f"This server has at most {most} {self._what}, and there are {taken} and {amount} more; {self._advice}"
            )
        if amount > found.left and not self._alone():
            raise self._beyond(
                f"{caller.name} may have no more {self._what} than are left for others: it has {own}{more}, and "
                f"{most - taken} of {most} are left; {self._advice}"
            )

    def add(self, key: str, amount: int = 1) -> None:
        """Count what the caller with this key has taken, or given back if it is negative; nothing is checked."""
        self._total += amount
        self._taken[key] += amount
        if not self._taken[key]:  # of strangers who are gone nothing is kept, not even a zero
            del self._taken[key]

    @contextmanager
    def take(self, caller: Caller, amount: int = 1) -> Iterator[None]:
        """Check that a caller may take more, and count it for the length of the block; raise as `check` does."""
        self.check(caller, amount)
        with self.counted(caller, amount):
            yield

    @contextmanager
    def counted(self, caller: Caller, amount: int) -> Iterator[None]:
        """Count what a caller takes for the length of the block; nothing is checked."""
        self.add(caller.key, amount)
        try:
            yield
        finally:
            self.add(caller.key, -amount)
