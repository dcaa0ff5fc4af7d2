"""Two decoders that share nothing, on many random surfaces: the compiled one and `tests.reference`."""

from __future__ import annotations

import time
from dataclasses import dataclass

import numpy as np
from hypothesis import HealthCheck, Phase, given, settings
from hypothesis import strategies as st

import lodestream as ls
from tests import reference
from tests.core.decoding.comparison import agree_on, surfaces

__all__ = ["Compared", "run"]

_OPTIONS: tuple[dict[str, str], ...] = ({}, {}, {"precision": "0.1%"}, {"rms": "1%"}, {"rms": "0.01%"})


@dataclass
class Compared:
    """What a run did: surfaces that were compared, and how many of them had large units."""

    surfaces: int = 0
    large: int = 0


@st.composite
def _wide(draw: st.DrawFn) -> ls.Surface:
    """Ones that have large units, some of them of several tiles or blocks."""
    rng = np.random.default_rng(draw(st.integers(0, 2**32)))
    rows, columns = draw(st.tuples(st.integers(90, 420), st.integers(90, 420)))
    heights = np.cumsum(rng.normal(size=(rows, columns)), axis=0) + rng.normal(size=columns)
    heights *= draw(st.sampled_from([0.01, 1.0, 100.0]))
    closed = draw(st.booleans()), draw(st.booleans())
    kind = draw(st.sampled_from(["heights", "integers", "holes", "points", "blocks"]))
    if kind == "integers":
        return ls.Surface(np.rint(heights).astype(np.int32), closed)
    if kind == "holes":
        return ls.Surface(heights.astype(np.float32), closed, mask=rng.random(heights.shape) < 0.9)
    if kind == "heights":
        return ls.Surface(heights.astype(np.float32), closed)
    y, x = np.indices(heights.shape)
    points = np.stack([x + 0.1 * heights, y, heights], axis=-1)[:300, :200].astype(np.float32)
    if kind == "points":
        return ls.Surface(points, closed)
    middle = rows // 4
    return ls.Surface(blocks=[ls.Block(points[: middle + 1]), ls.Block(points[middle:])])


def run(count: int, most: float | None = None) -> Compared:
    """Compare what both show after a random layer, at a random level, and at the end.

    Parameters
    ----------
    count : int
        How many surfaces.
    most : float or None
        Most seconds; what is left then is not done.

    Raises
    ------
    AssertionError
        They differ; hypothesis prints the surface.
    """
    done, end = Compared(), time.monotonic() + (float("inf") if most is None else most)

    @settings(
        max_examples=count,
        deadline=None,
        database=None,
        phases=[Phase.generate],
        suppress_health_check=list(HealthCheck),
    )
    @given(
        st.integers(0, 7).flatmap(lambda turn: _wide() if turn == 0 else surfaces()),
        st.sampled_from(_OPTIONS),
        st.integers(0, 10_000),
        st.integers(0, 10_000),
    )
    def compare(surface: ls.Surface, options: dict[str, str], layer: int, level: int) -> None:
        if time.monotonic() < end:
            data = ls.encode(surface, **options)  # type: ignore[call-overload]
            agree_on(data, layer, level)
            done.surfaces += 1
            done.large += reference.read_container(data).header.large > 0

    compare()
    return done
