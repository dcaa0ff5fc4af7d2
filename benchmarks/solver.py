"""The paper's truncated solver against a banded Cholesky solver."""

from __future__ import annotations

from functools import partial

import numpy as np
import scipy.linalg

from lodestream.transform import paper

from .measure import medians, table

SYSTEMS = ((2049, 2049), (100_001, 41), (100_001, 1))


def main() -> None:
    """Print the time for many right-hand sides, and how far the solutions are apart."""
    rows = []
    for order, sides in SYSTEMS:
        right = np.random.default_rng(2002).standard_normal((order, sides))
        banded = np.empty((2, order))
        banded[0], banded[1] = 1.0, 6.0
        banded[1, [0, -1]] = 5.0
        exact = scipy.linalg.solveh_banded(banded, right, check_finite=False)

        seconds = medians(
            {
                "k = 20": partial(paper.solve, right, 20),
                "k = 10": partial(paper.solve, right, 10),
                "solveh_banded": partial(scipy.linalg.solveh_banded, banded, right, check_finite=False),
            }
        )
        error = {
            f"k = {terms}": f"{np.abs(paper.solve(right, terms) - exact).max() / np.abs(right).max():.1e}"
            for terms in (20, 10)
        }
        rows += [
            [
                f"{order:,} x {sides:,}, {name}",
                f"{1e3 * spent:.1f}",
                f"{1e9 * spent / right.size:.2f}",
                f"{seconds['solveh_banded'] / spent:.1f}",
                error.get(name, ""),
            ]
            for name, spent in seconds.items()
        ]
    head = ["order x right-hand sides, method", "ms", "ns a value", "times as fast", "difference / max |b|"]
    table("The paper's solver against scipy.linalg.solveh_banded", head, rows)
