"""Plans of random containers for random targets, as JSON; ``python -m tests.web.plans SEED COUNT`` prints them.

The tests of `client/web` make the same plans.
"""

from __future__ import annotations

import base64
import json
import math
import sys
from random import Random
from typing import Any

import numpy as np

import lodestream as ls
from lodestream.container.model import ByteRange, Index
from lodestream.errors import OptionError
from lodestream.planning.byte_ranges import RangeSet
from lodestream.planning.plan import Plan
from lodestream.planning.planner import plan
from lodestream.planning.window_errors import WindowErrors, read_window_errors
from lodestream.target import Region, Target, Tolerance
from tests.core.surfaces import index_of, terrain

_TARGETS = 40


def container(random: Random) -> bytes:
    """A random surface: of one or two blocks, with holes, attributes, wrapping axes or a precision."""
    shape = random.choice([(2, 1), (9, 7), (33, 20), (70, 64), (150, 41), (240, 201), (20, 600), (300, 270)])
    seed = random.randrange(2**30)
    heights = terrain(shape, seed)
    kind = random.choice(["float", "integers", "holes", "attributes", "precision", "wraps", "blocks", "points"])
    closed = (False, False)
    attributes: dict[str, Any] = {}
    precision = None
    points: Any = heights.astype(np.float32)
    if kind == "integers":
        points = np.rint(heights).astype(np.int16)
    elif kind == "holes":
        points = np.where(np.random.default_rng(seed).random(shape) < 0.2, np.nan, np.rint(heights))
        points[0, 0] = 1.0
    elif kind == "attributes":
        attributes = {"a": heights * 2, "b": (heights > 0).astype(np.uint8)}
    elif kind == "precision":
        precision = 0.5
    elif kind == "wraps":
        closed = (random.random() < 0.5, random.random() < 0.5)
    elif kind == "points":
        rows, columns = np.mgrid[: shape[0], : shape[1]].astype(np.float64)
        points = np.stack([rows, columns, heights], axis=2)
    if kind == "blocks":
        rows, columns = np.mgrid[: shape[0], : shape[1]].astype(np.float64)
        left = np.stack([rows, columns, heights], axis=2)
        right = left.copy()
        right[..., 1] += shape[1] - 1
        right[:, 0] = left[:, -1]
        return ls.encode(ls.Surface(blocks=[ls.Block(left), ls.Block(right)]))
    return ls.encode(ls.Surface(points, closed, attributes=attributes), precision)


def target(random: Random, index: Index) -> Target:
    """A random target; some that the surface cannot meet."""
    header = index.header
    order = random.choice(["quality", "level"])
    options: dict[str, Any] = {"order": order}
    if random.random() < 0.3:
        options["first"] = _region(random, *header.blocks[0])
    kind = random.choice(["whole", "level", "rms", "max", "bytes", "both", "region", "attributes", "channels"])
    errors = [layer.rms for layer in index.layers] + [0.0, 1e9]
    if kind == "level":
        options["level"] = random.randrange(header.levels + 2)
    if kind in ("rms", "both"):
        options["until_rms"] = Tolerance(random.choice(errors) * random.choice([1, 1, 0.9, 1.1]))
    if kind == "max":
        options["until_max"] = Tolerance(10 ** random.uniform(-5, 0), relative=True)
    if kind in ("bytes", "both") or (kind == "region" and random.random() < 0.3):
        options["max_bytes"] = random.choice([1, 200, random.randrange(1, index.size + 100), index.surface_end])
    if kind == "region":
        options["region"] = _region(random, *header.blocks[0])
        if random.random() < 0.4 and "max_bytes" not in options:
            options["level"] = random.randrange(header.levels + 2)
        elif random.random() < 0.6:
            limit = Tolerance(10 ** random.uniform(-4, 0), relative=True)
            options[random.choice(["until_rms", "until_max"])] = limit
    if kind == "channels":
        names = [*header.channel_names, *(attribute.name for attribute in header.attributes)]
        for which in ("until_rms", "until_max"):
            wanted = [name for name in names if random.random() < 0.4]
            options[which] = {name: 10 ** random.uniform(-4, 2) for name in wanted}
        if random.random() < 0.1:
            options["until_rms"]["nothing"] = 1.0
    if kind == "attributes" or (kind in ("region", "level", "channels") and random.random() < 0.3):
        names = [attribute.name for attribute in header.attributes]
        options["attributes"] = tuple(name for name in [*names, "nothing"] if random.random() < 0.4)
    return Target(**options)


def case(random: Random, index: Index, windows: WindowErrors | None) -> dict[str, Any]:
    """A target, what is held, and the plan or the error; with the container's bounds of windows or without, or none."""
    mode = random.choice(["own", "own", "whole", "none"])
    asked = target(random, index)
    held = [
        (random.randrange(index.size), random.randrange(1, index.size)) for _ in range(random.choice([0, 0, 1, 3, 10]))
    ]
    if random.random() < 0.5:
        held = [(offset, max(length // 20, 1)) for offset, length in held]
    made: dict[str, Any]
    try:
        own = windows if mode == "own" else None
        made = {"plan": _told(plan(index, asked, RangeSet(held), windows=own, bounded=mode != "none"))}
    except OptionError as error:
        made = {"error": str(error)}
    return {"target": _options(asked), "held": held, "windows": mode, **made}


def _region(random: Random, shape: tuple[int, int], closed: tuple[bool, bool]) -> Region:
    spans = []
    for length, wraps in zip(shape, closed, strict=True):
        start = random.randrange(length)
        last = start + length if wraps and random.random() < 0.5 else length
        spans.append((start, random.randrange(start + 1, last + (2 if random.random() < 0.05 else 1))))
    return spans[0], spans[1]


def _options(asked: Target) -> dict[str, Any]:
    def limit(given: Any) -> Any:
        if isinstance(given, dict):
            return {name: limit(own) for name, own in given.items()}
        return None if given is None else {"value": given.value, "relative": given.relative}

    options = {
        "level": asked.level,
        "untilRms": limit(asked.until_rms),
        "untilMax": limit(asked.until_max),
        "maxBytes": asked.max_bytes,
        "order": asked.order,
        "region": asked.region,
        "attributes": asked.attributes,
        "first": asked.first,
    }
    return {name: value for name, value in options.items() if value is not None}


def _told(made: Plan) -> dict[str, Any]:
    def number(value: float) -> float | None:
        return None if math.isnan(value) else value

    def places(ranges: tuple[ByteRange, ...]) -> list[dict[str, int]]:
        return [{"offset": place.offset, "length": place.length} for place in ranges]

    return {
        "before": places(made.before),
        "ranges": places(made.ranges),
        "after": places(made.after),
        "marks": [
            {
                "sent": mark.sent,
                "number": mark.number,
                "level": mark.level,
                "bytes": mark.bytes,
                "rms": number(mark.rms),
                "maxError": number(mark.max_error),
                "channels": mark.channels,
            }
            for mark in made.marks
        ],
        "ended": made.ended,
        "prefix": made.prefix,
    }


def main(seed: int, count: int) -> None:
    """Print one line of JSON for each of so many containers."""
    random = Random(seed)
    for _ in range(count):
        made = container(random)
        index = index_of(made)
        windows = read_window_errors(index, lambda offset, length, made=made: made[offset : offset + length])  # type: ignore[misc]
        cases = [case(random, index, windows) for _ in range(_TARGETS)]
        print(json.dumps({"container": base64.b64encode(made).decode(), "cases": cases}))


if __name__ == "__main__":
    main(int(sys.argv[1]), int(sys.argv[2]))
