"""Measure for `small` with the code that ``PYTHONPATH`` names: requests on standard input, answers on output."""

from __future__ import annotations

import json
import sys
import time
from collections.abc import Callable

from .measure import Peak
from .small import surfaces, work_of


def main() -> None:
    """Answer requests until there are no more."""
    makers = surfaces()
    current, works, values = "", dict[str, Callable[[], object]](), 1
    for line in sys.stdin:
        action, name, *rest = json.loads(line)
        if name != current:
            surface = makers[name]()
            current, works = name, work_of(surface)
            values = sum(block.points.size for block in surface.blocks)
        answer: object
        if action == "works":
            answer = list(works)
        elif action == "memory":
            work = works[rest[0]]
            work()
            peak = Peak()
            peak.forget()
            kept = work()
            answer = (peak.above() or 0) / values
            del kept
        else:
            work, repeats = works[rest[0]], rest[1]
            start = time.process_time()
            for _ in range(repeats):
                work()
            answer = (time.process_time() - start) / repeats
        print(json.dumps(answer), flush=True)


if __name__ == "__main__":
    main()
