"""What does not fit is refused: calls as Lodestream makes them, with one number, length or element changed."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import numpy as np
import pytest

from lodestream.kernels import INTEGER, Kernel, Values

from .declared import declarations
from .scenes import SCENES

Values_ = tuple[Any, ...]

_OF_EACH = 4
_PLACES = 12
_WHOLE = (-1, 1, 2**31, 2**62, -(2**63))


@pytest.fixture(scope="module")
def calls() -> dict[str, list[tuple[Kernel, Values_]]]:
    """Some calls of each kernel: the first and the latest, with copies of their arrays."""
    found: dict[str, list[tuple[Kernel, Values_]]] = {name: [] for name in declarations()}
    call = Kernel.__call__

    def keep(self: Kernel, *values: Any) -> int:
        kept = found[self.name]
        copies = tuple(value.copy() if isinstance(value, np.ndarray) else value for value in values)
        kept[min(len(kept), _OF_EACH - 1) :] = [(self, copies)]
        return call(self, *values)

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(Kernel, "__call__", keep)
        for name in ("small surfaces", "meshes", "compressed scans", "decode heights-offsets", "encode plane-turned"):
            SCENES[name]()
    return found


def changed(kernel: Kernel, values: Values_) -> Iterator[Values_]:
    """The call with one thing changed, in every place."""
    for place, (argument, value) in enumerate(zip(kernel.arguments, values, strict=True)):
        others: list[Any] = []
        if argument is INTEGER:
            others = [value + 1, value - 1, *_WHOLE]
        elif isinstance(value, np.ndarray):
            others = [value[:-1].copy(), np.concatenate([value, value[:1]]), value[:0].copy()]
            if value.dtype.kind in "iu" and not isinstance(argument, Values):
                limits = np.iinfo(value.dtype)
                for at in range(min(value.size, _PLACES)):
                    for number in (limits.min, limits.max, value.size):
                        other = value.copy()
                        other.flat[at] = min(number, limits.max)
                        others.append(other)
                        other = value.copy()
                        other.flat[value.size - 1 - at] = min(number, limits.max)
                        others.append(other)
        for other in others:
            copies = (given.copy() if isinstance(given, np.ndarray) else given for given in values)
            yield tuple(other if at == place else given for at, given in enumerate(copies))


@pytest.mark.parametrize("name", list(declarations()))
def test_what_does_not_fit_is_refused(calls: dict[str, list[tuple[Kernel, Values_]]], name: str) -> None:
    assert calls[name]
    made = refused = 0
    for kernel, values in calls[name]:
        for given in changed(kernel, values):
            made += 1
            try:
                kernel(*given)
            except ValueError:
                refused += 1
    assert 0 < refused < made  # some changes still fit
