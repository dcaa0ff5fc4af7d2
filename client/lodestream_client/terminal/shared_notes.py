"""Notes of several surfaces, each said once: those of the steps of a series are mostly the same."""

from __future__ import annotations

import warnings
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Any

from lodestream.errors import FormatWarning

from .output import note

__all__ = ["SharedNotes"]


@dataclass
class _Held:
    """The surface that a note came from first, and last, and how many there are."""

    first: str
    last: int
    count: int = 1


class SharedNotes:
    """Collects notes of surfaces, and prints each once, at the end of the block, also after an error.

    Parameters
    ----------
    count : int
        Number of surfaces.
    kind : str
        What they are, in the plural: "steps".
    """

    def __init__(self, count: int, kind: str) -> None:
        self._count, self._kind = count, kind
        self._notes: dict[str, _Held] = {}
        self._surfaces = 0

    def __enter__(self) -> SharedNotes:
        return self

    def __exit__(self, *_: object) -> None:
        """Print the notes: behind its label what is of one surface, with their number what is of some."""
        for text, held in self._notes.items():
            if held.count == self._count:
                note(text)
            elif held.count == 1:
                note(f"{held.first}: {text}")
            else:
                note(f"{text} ({held.count} of {self._count} {self._kind})")

    @contextmanager
    def of(self, label: str) -> Iterator[Callable[[str], None]]:
        """Collect what is warned of lost data; yield a function that adds a note of this surface."""
        self._surfaces += 1
        number = self._surfaces

        def add(text: str) -> None:
            held = self._notes.setdefault(text, _Held(label, number))
            if held.last != number:
                held.last, held.count = number, held.count + 1

        with warnings.catch_warnings():
            show = warnings.showwarning

            def collected(message: Warning | str, category: type[Warning], *place: Any, **more: Any) -> None:
                if issubclass(category, FormatWarning):
                    add(str(message))
                else:
                    show(message, category, *place, **more)

            warnings.showwarning = collected
            yield add
