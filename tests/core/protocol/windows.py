"""Windows on links of all kinds, for other implementations: ``python -m tests.core.protocol.windows COUNT``.

A line of JSON for each has the credit that the server keeps, the first round trip, the bytes that were granted and that
arrived with their times, and after each step the window's size and what is due.
"""

from __future__ import annotations

import json
import sys
from random import Random

from lodestream.protocol.flow_control import FlowWindow
from lodestream.protocol.messages import BASE_CREDIT, MAX_CREDIT, MAX_DATA


def record(random: Random) -> dict[str, object]:
    """One window, with whatever comes."""
    window, now = FlowWindow(), 0.0
    most = random.choice((BASE_CREDIT, MAX_CREDIT))
    heard = random.choice((0.0005, 0.01, 0.1, 0.7)) * random.uniform(0.5, 2.0)
    rate = 10 ** random.uniform(3, 8)
    window.allow(most)
    window.heard(heard)
    begun = random.random() < 0.5
    if begun:
        window.began(0.0, heard)
        now = heard
    steps, sizes = [], []
    for _ in range(300):
        size = random.choice((random.randint(1, 4096), MAX_DATA))
        granted = random.choice((0, size, 2 * size))
        now += random.choice((0.0, size / rate, size / rate, random.uniform(0, heard)))
        if granted:
            window.grant(granted, now)
        waited = random.choice((0.0, size / rate, heard))
        window.waited(waited)
        window.arrive(size, now)
        steps.append((granted, size, now, waited))
        sizes.append((window.size, window.due(window.size - size)))
    return {"most": most, "heard": heard, "begun": begun, "steps": steps, "sizes": sizes}


def main() -> None:
    """Print as many as asked for."""
    random = Random(20)
    for _ in range(int(sys.argv[1])):
        print(json.dumps(record(random)))


if __name__ == "__main__":
    main()
