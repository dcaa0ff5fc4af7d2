"""Section 8 of the page: a step of one line, and the way back."""

from __future__ import annotations

from tests.stranger.coder import clamp
from tests.stranger.layout import Predictor, Step
from tests.stranger.tables import TAPS

DETAIL = 2**28
SAMPLE = 2**27


def _surplus(nodes: list[int], step: Step, predictor: Predictor) -> list[int]:
    """What the nodes foretell of each detail: floor((v_k + 128) / 256)."""
    run, (a, b) = step.run, predictor
    if run < 3 or predictor == (0, 0):
        return [0] * step.midpoints
    c = {k: nodes[k] for k in range(run)}
    if step.periodic:
        for k in (-2, -1, run, run + 1, run + 2):
            c[k] = nodes[k % run]
    else:
        for k in (-1, -2):
            c[k] = 3 * c[k + 1] - 3 * c[k + 2] + c[k + 3]
        for k in (run, run + 1):
            c[k] = 3 * c[k - 1] - 3 * c[k - 2] + c[k - 3]
    return [
        (a * (-c[k + 2] + c[k + 1] + c[k] - c[k - 1]) + b * (-c[k + 3] + c[k + 1] + c[k] - c[k - 2]) + 128) // 256
        for k in range(step.midpoints)
    ]


def _beyond(d: list[int], step: Step, index: int) -> int:
    """The detail at any index."""
    if step.periodic:
        return d[index % len(d)]
    count, (first, last) = len(d), step.clamped_run
    sign = 1
    while not 0 <= index < count:
        is_clamped = first if index < 0 else last
        if index in (-1, count) and not is_clamped:
            return 0
        sign = -sign
        if index < 0:
            index = -1 - index if is_clamped else -2 - index
        else:
            index = 2 * count - 1 - index + (0 if is_clamped else 1)
    return sign * d[index]


def _update(d: list[int], step: Step) -> list[int]:
    """floor((s_k + 3 2^21) / 2^24) for every node of the run."""
    wide = [_beyond(d, step, index) for index in range(-10, step.run + 9)]  # wide[10 + k] is d_k
    sums = (sum(tap * (wide[10 + k + j] + wide[9 + k - j]) for j, tap in enumerate(TAPS)) for k in range(step.run))
    return [(s + 3 * 2**21) >> 24 for s in sums]


def undo(line: list[int], step: Step, predictor: Predictor) -> list[int]:
    """Undoes a step on one line of nodes and then details."""
    surplus = _surplus(line, step, predictor)
    d = [clamp(e + more, -DETAIL, DETAIL) for e, more in zip(line[step.nodes :], surplus, strict=True)]
    nodes = [c - update for c, update in zip(line, _update(d, step), strict=False)]
    samples = [0] * step.samples
    samples[0 : 2 * step.run : 2] = nodes
    for k in range(step.midpoints):
        samples[2 * k + 1] = d[k] + ((nodes[k] + nodes[(k + 1) % step.run]) >> 1)
    if step.nodes > step.run:
        samples[-1] = line[step.run]
    return [clamp(number, -SAMPLE, SAMPLE) for number in samples]


def details(samples: list[int], step: Step, predictor: Predictor) -> list[int]:
    """The details of a step on one line of samples."""
    x = [*samples[: 2 * step.run], samples[0]]
    d = [x[2 * k + 1] - ((x[2 * k] + x[2 * k + 2]) >> 1) for k in range(step.midpoints)]
    nodes = [x[2 * k] + update for k, update in enumerate(_update(d, step))]
    return [number - more for number, more in zip(d, _surplus(nodes, step, predictor), strict=True)]
