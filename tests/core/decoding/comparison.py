"""Two decoders that share nothing, held to each other: the compiled one and `tests.reference`."""

from __future__ import annotations

from typing import Any

import numpy as np
from hypothesis import assume
from hypothesis import strategies as st
from numpy.typing import NDArray

import lodestream as ls
from tests import reference

from ..grid.layouts import layouts, tubes

__all__ = ["agree_on", "assert_same", "assert_shown", "surfaces"]


def assert_same(found: ls.Surface, wanted: ls.Surface) -> None:
    """Two surfaces are the same, bit for bit."""
    for one, other in zip(found.blocks, wanted.blocks, strict=True):
        assert one.closed == other.closed
        assert _bits(one.mask) == _bits(other.mask)
        assert _bits(one.points) == _bits(other.points)
        assert {name: _bits(array) for name, array in one.attributes.items()} == {
            name: _bits(array) for name, array in other.attributes.items()
        }
    assert found.metadata == wanted.metadata


def _bits(array: NDArray[Any] | None) -> tuple[str, tuple[int, ...], bytes] | None:
    return None if array is None else (array.dtype.str, array.shape, array.tobytes())


def agree_on(data: bytes, layer: int, level: int) -> None:
    """Hold what both decoders show of a whole container to each other: after a layer, at a level, and at the end.

    Parameters
    ----------
    data : bytes
    layer, level : int
        Any; they are taken modulo how many there are.
    """
    decoder = ls.Decoder()
    decoder.feed(data)
    assert decoder.header is not None
    container = reference.read_container(data)
    other = reference.decode(container)
    assert (container.header.finest, len(container.layers)) == (decoder.header.levels, decoder.header.layer_count)
    layer, level = layer % len(container.layers), level % (container.header.finest + 1)
    assert_shown(decoder.layers[layer].surface(), other.shown(layer + 1))
    assert_shown(decoder.surface(), other.shown(residual=container.residual))
    if level < container.header.finest:
        # The page does not say what x and y of a coarser level of heights are.
        assert_shown(decoder.surface(level), other.shown(level=level), heights=container.header.plane is not None)


def assert_shown(surface: ls.Surface, blocks: list[reference.Shown], heights: bool = False) -> None:
    for found, wanted in zip(surface.blocks, blocks, strict=True):
        if not wanted.valid.any():
            continue  # so coarse a level shows what stands under its holes
        assert np.array_equal(np.ones(found.shape, bool) if found.mask is None else found.mask, wanted.valid)
        points, *attributes = wanted.arrays
        shown = found.points[..., 2:] if heights else found.points
        assert _bits(np.ascontiguousarray(shown)) == _bits(points)
        assert list(map(_bits, found.attributes.values())) == list(map(_bits, attributes))


@st.composite
def surfaces(draw: st.DrawFn) -> ls.Surface:
    """Small ones of every kind: types, channels, closed axes, holes, attributes, blocks that meet."""
    rng = np.random.default_rng(draw(st.integers(0, 2**32)))
    kind = np.dtype(draw(st.sampled_from(["int8", "uint16", "int32", "int64", "float32", "float64"])))
    if draw(st.integers(0, 3)) == 0:
        found = draw(st.one_of(layouts(largest=8), tubes()))
        try:
            return ls.Surface(
                blocks=[ls.Block(block.coordinates.astype("f8"), block.closed, mask=block.mask) for block in found]
            )
        except ls.InputError:
            assume(False)
    shape = draw(st.tuples(st.integers(1, 40), st.integers(2, 40)))
    channels = draw(st.sampled_from([0, 0, 2, 3, 5]))
    rough = draw(st.sampled_from([0.01, 1.0, 9.0]))
    points = np.cumsum(rng.normal(size=(*shape, channels) if channels else shape) * rough, axis=0)
    if kind.kind != "f":
        points = np.clip(np.rint(points), -100 if kind.kind == "i" else 0, 100)
    mask = rng.random(shape) < draw(st.sampled_from([0.5, 0.99]))
    mask[0, 0] = True
    attributes: dict[str, NDArray[Any]] = {}
    if draw(st.booleans()):
        attributes = {"k": rng.integers(-9, 9, shape).astype("i2"), "flow": rng.normal(size=(*shape, 2)).astype("f4")}
        attributes["k"][~mask], attributes["flow"][~mask] = 0, np.nan  # what holes have
    closed = draw(st.booleans()), draw(st.booleans())
    return ls.Surface(points.astype(kind), closed, mask=mask if draw(st.booleans()) else None, attributes=attributes)
