"""Containers that tell errors of windows, and what these are, as JSON; ``python -m tests.web.window_errors``."""

from __future__ import annotations

import base64
import json
import random
from functools import partial
from typing import Any

import numpy as np

import lodestream as ls
from lodestream.planning.window_errors import read_window_errors
from tests.core.surfaces import index_of, terrain

_SHAPE = (300, 530)


def read(container: bytes, offset: int, length: int) -> bytes:
    """A slice of a container."""
    return container[offset : offset + length]


def main() -> None:
    """Of heights, and of heights with holes."""
    heights = (terrain(_SHAPE, 3) / 3).astype(np.float32)
    holes = np.hypot(*(np.indices(_SHAPE) - np.array([[[120]], [[260]]]))) > 90
    chance = random.Random(1)
    for mask in (None, holes):
        container = ls.encode(ls.Surface(heights, (False, True), mask=mask))
        index = index_of(container)
        errors = read_window_errors(index, partial(read, container))
        assert errors is not None
        cases: list[dict[str, Any]] = []
        for _ in range(60):
            (top, bottom), (left, right) = (sorted(chance.sample(range(n + 1), 2)) for n in _SHAPE)
            if chance.random() < 0.5:  # across the seam
                left = chance.randrange(_SHAPE[1])
                right = left + chance.randint(1, _SHAPE[1])
            region, layer = ((top, bottom), (left, right)), chance.randrange(len(index.layers))
            cases.append({"region": region, "layer": layer, "bounds": errors.bounds(region, layer)})
        valid = None if mask is None else base64.b64encode(mask.tobytes()).decode()
        told = {"container": base64.b64encode(container).decode(), "mask": valid, "cases": cases}
        print(json.dumps(told))


if __name__ == "__main__":
    main()
