"""Random calls of the kernels that read, as JSON; ``python -m tests.web.kernels SEED COUNT`` prints one a line.

The kernels as WebAssembly must give the same bits. Numbers are base64 of little-endian bytes.
"""

from __future__ import annotations

import base64
import json
import random
import sys
from typing import Any

import numpy as np
from numpy.typing import NDArray

from lodestream.entropy.mask import encode_mask
from lodestream.grid.axis import axis_step
from lodestream.grid.layout import Layout
from lodestream.residual.chunk_coder import encode_chunk
from lodestream.transform.lifting import forward_step, inverse_step
from tests.core.entropy.coding import decode_runs, encode_runs, passes_of


def main(seed: int, count: int) -> None:
    """Steps, tiles, masks and chunks by turns."""
    for number in range(seed, seed + count):
        chance, rng = random.Random(number), np.random.default_rng(number)
        for kind, make in (("step", step), ("tiles", tiles), ("mask", mask), ("chunk", chunk)):
            print(json.dumps({"kind": kind, "number": number, **make(chance, rng)}), flush=True)


def packed(array: NDArray[Any]) -> str:
    """The bytes of an array."""
    return base64.b64encode(np.ascontiguousarray(array).tobytes()).decode()


def step(chance: random.Random, rng: np.random.Generator) -> dict[str, Any]:
    """A step along an axis of a plane, undone; and one of a line."""
    axis, closed = chance.randrange(2), chance.random() < 0.3
    length = chance.choice([3, 4, 5, 6, 7, 8, 11, 24, 47, 48, 200, 2501])
    clamped, stops = (chance.random() < 0.4, chance.random() < 0.4), chance.random() < 0.2
    made = axis_step(length, closed, clamped, stops)
    across = chance.choice([1, 3, 15, 16, 17, 64, 65, 200]) if length < 2500 else 3
    a, b = chance.choice([(0, 0), (16, 0), (-127, 127), (chance.randrange(-127, 128), chance.randrange(-127, 128))])
    size = 2 ** chance.choice([3, 15, 18, 24, 27, 28])
    shape = (length, across) if axis == 0 else (across, length)
    coefficients = rng.integers(-size, size, shape, np.int32)
    samples = coefficients.copy()
    inverse_step(samples, axis, made, (a, b))
    line = rng.integers(-min(size, 2**27), min(size, 2**27), (1, length), np.int32)
    stepped = line.copy()
    forward_step(stepped, 1, made, (a, b))
    return {
        "axis": axis,
        "length": length,
        "closed": closed,
        "clamped": clamped,
        "stops": stops,
        "shape": shape,
        "predictor": [a, b],
        "coefficients": packed(coefficients),
        "samples": packed(samples),
        "line": packed(line),
        "stepped": packed(stepped),
    }


def tiles(chance: random.Random, rng: np.random.Generator) -> dict[str, Any]:
    """Random coefficients of a channel, large units or small, and what is known of them when some passes are read."""
    shape = chance.choice([(9, 7), (33, 40), (70, 64), (101, 20), (130, 90)])
    closed = chance.random() < 0.3, chance.random() < 0.3
    layout = Layout.single(shape, closed, chance.choice([(4, 4), (5, 4), (6, 6)]))
    large = chance.choice([0, 0, 1, 2])
    spread = rng.standard_cauchy(shape) * 10.0 ** chance.uniform(-1, 5)
    true = np.clip(np.rint(spread), -(2**28) + 1, 2**28 - 1).astype(np.int32)
    counts = passes_of(layout, true)
    first, last, state = [], [], []
    for number, passes in enumerate(counts):
        cut = chance.randrange(passes + 1)
        stop = chance.randrange(passes - cut + 1)
        if cut:
            first.append((number, 0, passes - 1, cut))
        if passes - cut - stop:
            last.append((number, 0, passes - cut - 1, passes - cut - stop))
        state.append([stop])
    coded = encode_runs(layout, [true], [*first, *last], large)
    return {
        "shape": shape,
        "closed": closed,
        "tile": layout.tile,
        "large": large,
        "runs": [[c.tile, c.first, c.passes, base64.b64encode(c.data).decode()] for c in coded],
        "state": [own for (own,) in state],
        "known": packed(decode_runs(layout, 1, coded, state, large)[0]),
    }


def mask(chance: random.Random, rng: np.random.Generator) -> dict[str, Any]:
    """A mask, coded."""
    shape = chance.choice([(1, 2), (5, 16), (33, 17), (64, 130), (200, 3)])
    rows, columns = np.mgrid[: shape[0], : shape[1]]
    round_hole = np.hypot(rows - shape[0] / 2, columns - shape[1] / 3) < chance.uniform(0, max(shape))
    values = round_hole if chance.random() < 0.5 else rng.random(shape) < chance.random()
    return {"shape": shape, "mask": packed(values), "data": base64.b64encode(encode_mask(values)).decode()}


def chunk(chance: random.Random, rng: np.random.Generator) -> dict[str, Any]:
    """Values, and what restores them from others."""
    dtype = np.dtype(chance.choice(["i1", "i2", "i4", "i8", "u1", "u2", "u4", "u8", "f4", "f4", "f4", "f8", "f8"]))
    count = chance.choice([1, 2, 50, 1000])
    step = None
    if dtype.kind == "f":
        restored = (rng.normal(size=count) * 10.0 ** chance.randrange(-30, 30)).astype(dtype)
        original = (restored * (1 + rng.normal(size=count) * 10.0 ** chance.randrange(-8, 0))).astype(dtype)
        kind = chance.randrange(4)
        if kind == 0:
            restored = rng.normal(size=count, scale=1000).astype(dtype)
            original = np.round(restored.astype(np.float64), chance.randrange(6)).astype(dtype)
        elif kind == 1:
            places = rng.integers(count, size=3)
            original[places] = np.array([np.nan, np.inf, -np.inf], dtype)
        elif kind == 2 and dtype == np.float32 and count > 2:
            step = 0.3048
            whole = rng.integers(-3000, 3000, count)
            restored = (whole * step).astype(dtype)
            original = (whole * step + np.repeat(rng.normal(size=count), 9)[:count] / 50).astype(dtype)
    else:
        limits = np.iinfo(dtype)
        restored = rng.integers(limits.min, limits.max, count, dtype, endpoint=True)
        near = rng.integers(-9, 10, count) * 2 ** chance.randrange(4)
        original = (restored.astype(np.int64) + near).astype(dtype)
        if chance.random() < 0.2:
            original = rng.integers(limits.min, limits.max, count, dtype, endpoint=True)
    data = encode_chunk(original, restored, step)
    return {
        "dtype": dtype.name,
        "restored": packed(restored),
        "original": packed(original),
        "data": base64.b64encode(data).decode(),
    }


if __name__ == "__main__":
    main(int(sys.argv[1]), int(sys.argv[2]))
