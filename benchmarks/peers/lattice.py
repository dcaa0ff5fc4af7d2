"""Whole numbers behind a surface's values, found for the peers' sake: coders of integers need them to be lossless."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

__all__ = ["Lattice", "lattice_of"]

_LONGEST = 1 << 24


@dataclass(frozen=True)
class Lattice:
    """Values are ``restore(numbers + low)``; ``numbers`` has rows, columns, channels, and each channel starts at 0."""

    numbers: NDArray[np.int64]
    low: NDArray[np.int64]
    step: float
    restore: Callable[[NDArray[np.int64]], NDArray[Any]]

    @property
    def longest(self) -> int:
        """Largest number."""
        return int(self.numbers.max())

    def points(self, numbers: NDArray[Any]) -> NDArray[Any]:
        """The surface of such numbers."""
        return self.restore(numbers.reshape(self.numbers.shape).astype(np.int64) + self.low)


def lattice_of(points: NDArray[Any]) -> Lattice | None:
    """Whole numbers, scaled powers of two, decimals, or terrain-RGB; None where no rule gives every bit back."""
    values = (points[..., None] if points.ndim == 2 else points).astype(np.float64)
    rules: list[tuple[float, Callable[[NDArray[Any]], NDArray[Any]], Callable[[NDArray[Any]], NDArray[Any]]]] = []
    for power in range(-8, 31):
        scale = 2.0**power
        rules.append((1 / scale, lambda x, s=scale: x * s, lambda k, s=scale: k / s))  # type: ignore[misc]
    for decimals in range(1, 6):
        scale = 10.0**decimals
        rules.append((1 / scale, lambda x, s=scale: x * s, lambda k, s=scale: k / s))  # type: ignore[misc]
    rules.append((0.1, lambda x: (x + 10000) * 10, lambda k: -10000 + 0.1 * k))
    for step, into, back in rules:
        if float(np.ptp(values, (0, 1)).max()) / step >= _LONGEST:
            continue
        numbers = np.rint(into(values)).astype(np.int64)
        if np.array_equal(back(numbers).astype(points.dtype).reshape(points.shape), points):
            low = numbers.min((0, 1))

            def restore(k: NDArray[np.int64], back: Callable[[NDArray[Any]], NDArray[Any]] = back) -> NDArray[Any]:
                return back(k).astype(points.dtype)

            return Lattice(numbers - low, low, step, restore)
    return None
