"""Precisions of single channels: coordinates by their letter, components of attributes by their number."""

from __future__ import annotations

from collections.abc import Sequence

from ..errors import OptionError
from ..quality import Quality
from ..surface import Block, Surface
from .holes import Arrays

__all__ = ["check_names", "named_errors"]


def check_names(surface: Surface, quality: Quality) -> None:
    """Refuse a precision for a channel that the surface does not have.

    Raises
    ------
    OptionError
        If there is no attribute, coordinate or component of a name; or if there are an error of the whole and one of a
        coordinate.
    """
    block = surface.blocks[0]
    channels = _channels(block)
    for name in quality.attributes:
        if name in block.attributes:
            continue
        if name not in channels:
            known = ", ".join([*block.attributes, *channels])
            raise OptionError(f"there is no {name!r} that could have a precision; there are {known}")
        if quality.rms is not None and channels[name] < _width(block):
            raise OptionError(f"expected either a root mean square error or a precision of {name}, got both")


def named_errors(surface: Surface, arrays: Sequence[Arrays], quality: Quality) -> dict[int, float]:
    """Return the largest allowed error of each channel that has a precision of its own, in the channel's unit.

    Parameters
    ----------
    surface : Surface
        As it is coded: heights alone where x and y follow a rule, which is exact.
    arrays : sequence, one for each block, of lists of arrays, shape (row, column, channel)
        Its points, then each attribute; finite.
    quality : Quality
        Relative errors are shares of the channel's range; of a channel without one they say nothing.
    """
    errors: dict[int, float] = {}
    block = surface.blocks[0]
    for name, channel in _channels(block).items():
        tolerance = quality.attributes.get(name)
        if tolerance is None:
            continue
        spans = [_span(block_arrays, channel) for block_arrays in arrays]
        span = max(high for _, high in spans) - min(low for low, _ in spans)
        if span or not tolerance.relative:
            errors[channel] = tolerance.absolute(span)
    return errors


def _width(block: Block) -> int:
    return block.points.shape[2] if block.points.ndim == 3 else 1


def _channels(block: Block) -> dict[str, int]:
    """Return the number of each channel by its name; whole attributes are not among them."""
    width = _width(block)
    names = ["z"] if width == 1 else list("xyz")[:width]
    names += [f"attribute_{number}" for number in range(width - len(names))]
    for name, values in block.attributes.items():
        names += [f"{name}_{part}" for part in range(values.shape[2])] if values.ndim == 3 else [name]
    return {name: channel for channel, name in enumerate(names) if name not in block.attributes}


def _span(arrays: Arrays, channel: int) -> tuple[float, float]:
    """Return the lowest and the highest value of a channel of a block."""
    for array in arrays:
        if channel < array.shape[2]:
            values = array[..., channel]
            return float(values.min()), float(values.max())
        channel -= array.shape[2]
    raise IndexError(channel)
