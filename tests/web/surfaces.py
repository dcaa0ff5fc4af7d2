"""Random surfaces and what they decode to, as JSON; ``python -m tests.web.surfaces SEED COUNT`` prints one a line.

The decoder of `client/web` must have the same bits at every layer and level, in windows, and on the way of a plan.
"""

from __future__ import annotations

import base64
import json
import math
import sys
import warnings
from contextlib import nullcontext
from random import Random
from typing import Any

import numpy as np
from numpy.typing import NDArray

import lodestream as ls
from lodestream.errors import InputError, OptionError
from lodestream.planning.plan import Plan
from lodestream.planning.planner import plan
from lodestream.planning.selection import Selection, selection_of
from lodestream.planning.window_errors import read_window_errors
from lodestream.quality import EFFORTS
from lodestream.target import Order
from tests.core.decoding.test_every_state import unnamed_interface, unnamed_tile
from tests.core.surfaces import all_large, follow, index_of, terrain, torus
from tests.golden.generate import digests, expectations

_DTYPES = ("int8", "int16", "int32", "int64", "uint8", "uint16", "uint32", "uint64", "float32", "float64")
_Points = NDArray[Any]


def main(seed: int, count: int) -> None:
    """Surfaces ``seed``, ``seed`` + 1, ..."""
    warnings.simplefilter("ignore")  # that values under holes are not kept
    for number in range(seed, seed + count):
        print(json.dumps(case(Random(number), number)), flush=True)


def case(chance: Random, number: int) -> dict[str, Any]:
    """A container, what it holds at every layer and level, a window of a state, and the views of a plan."""
    container = encoded(chance, number)
    return {
        "container": base64.b64encode(container).decode(),
        "expected": expectations(container),
        "window": window(chance, container),
        "followed": followed(chance, container),
        "followed_window": followed_window(chance, container),
    }


def encoded(chance: Random, number: int) -> bytes:
    """A random surface, encoded in a random way that suits it; the first two have units that no layer names."""
    if number in (1, 2):
        return (unnamed_tile, unnamed_interface)[number - 1]().data
    while True:
        options: dict[str, Any] = {}
        if chance.random() < 0.25:
            options = chance.choice([{"precision": "0.1%"}, {"rms": "0.1%"}, {"rms": "1%"}, {"precision": "1%"}])
        options["effort"] = chance.choice(EFFORTS)
        try:
            made = surface(chance, number)
            with all_large() if chance.random() < 0.3 else nullcontext():
                container: bytes = ls.encode(made, **options)
                return container
        except InputError:  # as holes everywhere, or an error that integers cannot have
            number += 1_000_003


def surface(chance: Random, number: int) -> ls.Surface:
    """Of one block or several."""
    rng = np.random.default_rng(number)
    if chance.random() < 0.25:
        return ls.Surface(blocks=several(chance, rng, number))
    shape = chance.choice([(2, 1), (1, 9), (3, 3), (5, 4), (17, 6), (9, 33), (40, 25), (31, 64), (90, 70), (150, 131)])
    closed = chance.random() < 0.25, chance.random() < 0.25
    kind = chance.choice([heights, heights, heights, plane, points_of])
    points = kind(chance, rng, shape, number)
    places: list[dict[str, Any]] = [
        {},
        {"geotransform": [-5.0, 10.0, 0.0, 90.0, 0.0, -9.0]},
        {"axes": {"x": [0, 10], "y": [85.5, -9]}},
        {"axes": {"x": [*(float(column**2) for column in range(shape[1])), "values"], "y": [85.5, -9]}},
    ]
    metadata = chance.choice(places) if kind is heights else {}
    mask = None
    if chance.random() < 0.3:
        mask = holes(rng, shape)
    return ls.Surface(points, closed, mask=mask, attributes=attributes(chance, rng, shape, number), metadata=metadata)


def heights(chance: Random, rng: np.random.Generator, shape: tuple[int, int], number: int) -> _Points:
    """Of any type, smooth or rough, on a lattice or not."""
    values = terrain(shape, number)
    dtype = np.dtype(chance.choice(_DTYPES))
    kind = chance.randrange(6)
    if kind == 0:
        values = rng.normal(size=shape) * 10.0 ** chance.randrange(-12, 12)
    if dtype.kind == "f":
        if kind == 1:
            values = np.rint(values * 10) / 10
        elif kind == 2:
            values = np.rint(values / 0.3048) * 0.3048 + rng.normal(scale=1e-6, size=shape)
        made = values.astype(dtype)
        if kind == 3 and made.size > 4:
            special = np.array([np.nan, np.inf, -np.inf, -0.0, 5e-324, 1e38], dtype)
            made.flat[rng.integers(made.size, size=2)] = special[rng.integers(len(special), size=2)]
        return made
    limits = np.iinfo(dtype)
    if kind == 3:
        return rng.integers(limits.min, limits.max, shape, dtype, endpoint=True)
    room = float(limits.max) - float(limits.min)
    scaled = (
        (values - values.min()) / max(float(np.ptp(values)), 1e-9) * min(room, chance.choice([50.0, 3e4, 1e18])) / 2
    )
    inside: _Points = np.clip(np.rint(scaled + limits.min / 4), limits.min, limits.max / 2)
    return inside.astype(dtype)


def plane(chance: Random, rng: np.random.Generator, shape: tuple[int, int], number: int) -> _Points:
    """Heights with x and y that follow a rule."""
    rows, columns = np.mgrid[: shape[0], : shape[1]].astype(np.float64)
    step = chance.choice([1.0, 0.1, 30.0, 1 / 3600])
    x, y = columns * step + chance.choice([0.0, 7.5]), chance.choice([-1, 1]) * (rows + 0.5) * step
    if chance.random() < 0.2:
        x, y = x + 0.3 * y, y - 0.3 * x
    return np.stack([x, y, terrain(shape, number)], axis=2).astype(chance.choice(["float32", "float64"]))


def points_of(chance: Random, rng: np.random.Generator, shape: tuple[int, int], number: int) -> _Points:
    """x, y, perhaps z, perhaps more."""
    channels = chance.choice([2, 3, 3, 3, 4, 5])
    made = np.stack([terrain(shape, number + k) for k in range(channels)], axis=2)
    if channels == 3 and min(shape) > 3 and chance.random() < 0.5:
        made = torus(*shape).astype(np.float64)
    if chance.random() < 0.5:
        return np.rint(made * 7).astype(chance.choice(["int16", "int32", "int64"]))
    return made.astype(chance.choice(["float32", "float64"]))


def holes(rng: np.random.Generator, shape: tuple[int, int]) -> NDArray[np.bool_]:
    """A mask with a round hole, or with many."""
    rows, columns = np.mgrid[: shape[0], : shape[1]]
    middle = rng.uniform(0, 1, 2) * shape
    round_hole = np.hypot(rows - middle[0], columns - middle[1]) < rng.uniform(0, max(shape) / 2)
    return ~round_hole if rng.random() < 0.6 else rng.random(shape) < rng.uniform(0.2, 0.95)


def attributes(chance: Random, rng: np.random.Generator, shape: tuple[int, int], number: int) -> dict[str, _Points]:
    """A few of any type."""
    found: dict[str, _Points] = {}
    while chance.random() < 0.3:
        values = heights(chance, rng, shape, number + 77 + len(found))
        several_numbers = np.stack([values, values[::-1]], axis=2)
        found[f"a{len(found)}"] = chance.choice([values, several_numbers])
    return found


def several(chance: Random, rng: np.random.Generator, number: int) -> list[ls.Block]:
    """Blocks that share sides, poles or nothing, some stored back to front, some with holes and attributes."""
    lines = chance.choice([(3, 3, 2), (9, 8, 2), (17, 33, 2), (12, 9, 3), (26, 31, 2)])
    height, width, across = lines
    u, v = np.mgrid[: across * (height - 1) + 1, : across * (width - 1) + 1].astype(np.float64)
    whole = np.stack([u, v, terrain((u.shape[0], u.shape[1]), number)], axis=2)
    if chance.random() < 0.3:
        polar, around = np.pi * u / u.max(), 2 * np.pi * v / v.max()
        whole = np.stack([np.sin(polar) * np.cos(around), np.sin(polar) * np.sin(around), np.cos(polar)], axis=2)
        whole[:, -1], whole[0], whole[-1] = whole[:, 0], (0.0, 0.0, 1.0), (0.0, 0.0, -1.0)
    integers = chance.random() < 0.4
    dtype = chance.choice(["int16", "int32"]) if integers else chance.choice(["float32", "float64"])
    points = np.rint(whole * 30).astype(dtype) if integers else whole.astype(dtype)
    named = [chance.choice(_DTYPES) for _ in range(chance.randrange(3))]
    masked = chance.random() < 0.3
    blocks = []
    for i in range(across):
        for j in range(across):
            if i == j == across - 1 and chance.random() < 0.3:
                continue
            rows, columns = (slice(k * (n - 1), (k + 1) * (n - 1) + 1) for k, n in ((i, height), (j, width)))
            block = points[rows, columns]
            turn = slice(None, None, chance.choice([1, 1, -1])), slice(None, None, chance.choice([1, 1, -1]))
            own = {f"b{k}": (block[..., 2] * (k + 1) % 100).astype(name)[turn] for k, name in enumerate(named)}
            mask = holes(rng, (height, width)) if masked else None
            blocks.append(ls.Block(block[turn].copy(), mask=mask, attributes=own))
    return blocks


def window(chance: Random, container: bytes) -> dict[str, Any] | None:
    """A window of a random state; None where there are several blocks, or nothing valid is inside."""
    decoder = ls.Decoder()
    decoder.feed(container)
    header = decoder.header
    assert header is not None
    if len(header.blocks) > 1:
        return None
    spans = []
    for length, wraps in zip(*header.blocks[0], strict=True):
        start, stop = sorted(chance.sample(range(length + 1), 2))
        if wraps and chance.random() < 0.6:  # across the seam
            start, stop = stop % length, stop % length + chance.randint(1, length)
        spans.append((start, stop))
    region = spans[0], spans[1]
    number = chance.choice([len(decoder.layers) - 1, chance.randrange(len(decoder.layers))])
    level = chance.choice([header.levels, chance.randrange(header.levels + 1)])
    try:
        shown = decoder.layers[number].window(region, level)
    except (InputError, OptionError):  # nothing valid, or no point of the level
        return None
    return {"region": region, "level": level, "layer": number, "sha256": digests(shown), "metadata": placed(shown)}


def placed(shown: ls.Surface) -> dict[str, Any]:
    """Where heights lie, by their metadata."""
    return {key: shown.metadata[key] for key in ("geotransform", "axes", "nodes") if key in shown.metadata}


def followed(chance: Random, container: bytes) -> dict[str, Any]:
    """Slices of a random plan, and the views that they give."""
    index = index_of(container)
    orders: list[Order] = ["quality", "level"]
    order = chance.choice(orders)
    target = ls.Target(order=order)
    if chance.random() < 0.3:
        target = ls.Target(order=order, level=chance.randrange(index.header.levels + 1))
    return _views(container, plan(index, target), chance.choice([37, 1000, 2**62]), None)


def followed_window(chance: Random, container: bytes) -> dict[str, Any] | None:
    """As `followed`, of a window, with the bounds of its errors; None where `window` is."""
    shown = window(chance, container)
    if shown is None:
        return None
    orders: list[Order] = ["quality", "quality", "level"]
    index = index_of(container)
    target = ls.Target(region=shown["region"], level=shown["level"], order=chance.choice(orders))
    windows = read_window_errors(index, lambda offset, length: container[offset : offset + length])
    made = plan(index, target, windows=windows)
    views = _views(container, made, chance.choice([37, 1000, 2**62]), selection_of(target))
    return {"region": shown["region"], "level": shown["level"], **views}


def _views(container: bytes, made: Plan, pieces: int, selection: Selection | None) -> dict[str, Any]:
    decoder, views = follow(container, made, pieces, selection)
    return {
        "slices": [[place.offset, place.length] for place in (*made.before, *made.ranges, *made.after)],
        "pieces": min(pieces, 2**31),
        "views": [
            [view.number, view.level, view.bytes, *(None if math.isnan(x) else x for x in (view.rms, view.max_error))]
            for view in views
        ],
        "complete": decoder.complete,
        "sha256": [digests(view.surface()) for view in views[:: max(1, len(views) // 4)]],
    }


if __name__ == "__main__":
    main(int(sys.argv[1]), int(sys.argv[2]))
