"""What does not fit is refused: calls as Lodestream makes them, with one number, length or element changed."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from lodestream import kernels
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
@pytest.mark.long
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


def ints(*numbers: int) -> NDArray[np.int32]:
    return np.array(numbers, np.int32)


def state(*numbers: int) -> NDArray[np.int64]:
    return np.array(numbers, np.int64)


ALONE = ints(-1, -1, -1, -1)  # the twins of a face that has no neighbour
QUAD = ints(0, 1, 2, 3)
#: Two quads and three that have a side in common with the first.
PAIR = ints(4, -1, -1, -1, 0, -1, -1, -1)
STAR = ints(4, 8, -1, -1, 0, -1, -1, -1, 1, -1, -1, -1)


@pytest.mark.parametrize(
    ("kernel", "values"),
    [
        # A face that no piece has, and a queue that is full of others; a face in the queue that there is not.
        (kernels.mesh_pieces, (ALONE, ints(-1), ints(0), state(0, 1, 1, 1), 9)),
        (kernels.mesh_pieces, (ALONE, ints(-1), ints(5), state(0, 0, 1, 1), 9)),
        # The same, of a neighbour and of a face to begin with; of a face to be turned round.
        (
            kernels.mesh_orient,
            (ints(*QUAD, 1, 0, 4, 5), PAIR, np.array([0, 2], np.uint8), ints(0, 0), state(0, 0, 0, 2, 0), 9),
        ),
        (kernels.mesh_orient, (QUAD, ALONE, np.array([2], np.uint8), ints(0), state(0, 1, 1, 1, 0), 9)),
        (kernels.mesh_orient, (QUAD, ALONE, np.array([0], np.uint8), ints(9), state(0, 0, 1, 1, -1), 9)),
        # The fan of a pole has a vertex that there is not, and it was looked at before.
        (
            kernels.mesh_poles,
            (
                *(QUAD, ALONE, ints(0, 9, 0, 0), ints(-2), ints(0), ints(0), 0),
                *(np.zeros(1, np.uint8), ints(0), state(0, 0, 0, 1), 9),
            ),
        ),
        # A stack that has room for one neighbour and not for two.
        (
            kernels.mesh_develop,
            (
                *(4, STAR, ints(0, -1, -1), np.zeros(6, np.int32), np.array([0, -1, -1], np.int8)),
                *(np.zeros(1, np.uint8), np.zeros(3, np.int64), np.zeros(3, np.int32), state(0, 3, 1), 9),
            ),
        ),
    ],
)
def test_states_that_no_call_has_left_behind_are_refused(kernel: Kernel, values: Values_) -> None:
    with pytest.raises(ValueError, match="do not fit"):
        kernel(*values)


def test_values_without_a_place_count_as_the_largest() -> None:
    """Values that are no numbers come from no decoder, but where a value leads the list of offsets must hold."""
    model, data = np.zeros(kernels.OFFSETS_MODEL, np.int32), np.zeros(1000, np.uint8)
    bases = np.array([0.0, np.inf, -np.inf, np.nan, 1e300, 1.0])
    places, restored = np.zeros(6, np.int64), np.zeros(6, np.int64)
    largest = int(np.finfo(np.float32).max.view(np.int32))
    places[1:5] = largest
    length = kernels.offsets(0, bases, restored, 34, places, model, data)
    read = np.zeros(6, np.int64)
    assert kernels.offsets(1, bases, restored, 34, read, model, data[:length].copy()) <= length + 4
    np.testing.assert_array_equal(read, places)
