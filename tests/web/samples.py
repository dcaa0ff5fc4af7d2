"""Containers of a few kinds of surface, as JSON; ``python -m tests.web.samples`` prints one a line."""

from __future__ import annotations

import base64
import json
from typing import Any

import numpy as np

import lodestream as ls
from tests.core.surfaces import terrain

_SHAPE = (181, 140)


def main() -> None:
    """Integers, floats with exactness, and integers with a hole."""
    rows, columns = np.mgrid[: _SHAPE[0], : _SHAPE[1]]
    heights = np.rint(10 * terrain(_SHAPE, 4))
    surfaces: dict[str, Any] = {
        "integers": heights.astype(np.int16),
        "floats": (terrain(_SHAPE, 5) / 3).astype(np.float32),
        "holes": np.where(np.hypot(rows - 90, columns - 70) < 30, np.nan, heights),
    }
    for name, points in surfaces.items():
        container = ls.encode(ls.Surface(points, metadata={"name": name}))
        print(json.dumps({"name": name, "container": base64.b64encode(container).decode()}))


if __name__ == "__main__":
    main()
