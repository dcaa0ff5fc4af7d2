"""Time to read files of very many small patches, and four times as many: it is to grow with them, not their square."""

from __future__ import annotations

import os
import tempfile
import warnings
from pathlib import Path

from lodestream import formats
from tests.core.grid.many_patches import MORE, READ

from .measure import Gate, keep, note, table

#: Of what takes longer than this, seconds, the ratio says something.
LEAST = 0.1

#: In proportion the ratio is `MORE`, and with the square 16.
MOST = 8.0


def main() -> None:
    """Print the table, and keep the largest ratio."""
    rows, largest = [], 0.0
    for maker, count in READ:
        with tempfile.TemporaryDirectory() as folder:
            times = []
            for patches in (count // 10, count, MORE * count):  # the first loads libraries
                inside = Path(folder) / str(patches)
                inside.mkdir()
                path = maker(inside, patches)
                times.append(min(_seconds(path) for _ in range(3)))
        _, few, many = times
        ratio = many / max(few, LEAST)
        largest = max(largest, ratio)
        rows.append(
            [maker.__name__.replace("_", " "), f"{MORE * count:,}", f"{few:.2f} s", f"{many:.2f} s", f"{ratio:.1f}"]
        )
    table("Files of many patches", ["kind", "patches", "a quarter of them", "all", "ratio"], rows)
    note(
        f"Processor times of this process and those that it starts, the least of three. Times below {LEAST} s count as "
        f"that in the ratio. {MORE} times the patches take about {MORE} times as long."
    )
    keep(Gate("largest ratio of times for four times the patches", largest, MOST, least=False))


def _seconds(path: Path) -> float:
    """The processor's time that reading a file takes, in this process and those that it starts."""
    before = os.times()
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # of what is left out
        formats.read(path)
    after = os.times()
    return sum(after[:4]) - sum(before[:4])
