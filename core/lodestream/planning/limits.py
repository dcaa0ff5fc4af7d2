"""Error limits at which a stream of a surface stops: those that a target names, as numbers and channels."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Literal, NamedTuple

from ..container.model import Header
from ..errors import OptionError
from ..target import Target
from .selection import selection_of

__all__ = ["ErrorLimits", "Met", "NamedLimit"]

#: The error that a state meets: of the whole surface, or all those of channels.
Met = Literal["rms", "max", "channels"]


class NamedLimit(NamedTuple):
    """The largest error, RMS or maximum, of the channels of a name: several if they are components of an attribute."""

    name: str
    channels: tuple[int, ...]
    which: Literal["rms", "max"]
    most: float

    def error(self, errors: Sequence[tuple[float, float]]) -> float:
        """Return a bound of the error, given RMS and maximum of each channel; NaN where they are unknown."""
        if max(self.channels) >= len(errors):
            return math.nan
        channel_errors = [errors[channel][self.which == "max"] for channel in self.channels]
        largest = max(channel_errors)
        if len(channel_errors) == 1 or not 0 < largest < math.inf:
            return largest
        total = 0.0  # in this order, so that clients in other languages stop at the same layer
        for error in channel_errors:
            total += (error / largest) * (error / largest)
        return largest * math.sqrt(total)


@dataclass(frozen=True)
class ErrorLimits:
    """The errors at which to stop, in their units.

    Attributes
    ----------
    rms, max_error : float or None
        Of the whole surface; either is enough.
    channels : tuple of NamedLimit
        Of channels. All of them have to be met.
    """

    rms: float | None = None
    max_error: float | None = None
    channels: tuple[NamedLimit, ...] = ()

    @classmethod
    def of(cls, target: Target, header: Header) -> ErrorLimits:
        """Return the limits of a target, for a surface with this header.

        Raises
        ------
        OptionError
            If the surface has no channel or attribute of a name, or the target leaves it out.
        """
        rms, worst = (None if limit is None else limit.absolute(header.extent) for limit in target.whole)
        named = _named(target, header) if target.channels else {}
        channels: list[NamedLimit] = []
        for name, which, most in target.channels:
            if name not in named:
                raise OptionError(
                    f"expected an error of one of {', '.join(named)}, got one of {_missing(name, header)}"
                )
            channels += [NamedLimit(name, group, which, most) for group in named[name]]
        return cls(rms, worst, tuple(channels))

    def met(self, rms: float, max_error: float, channels: Sequence[tuple[float, float]]) -> Met | None:
        """Return the first limit that a state with these errors meets; unknown errors are NaN, or no channels."""
        if self.rms is not None and rms <= self.rms:
            return "rms"
        if self.max_error is not None and max_error <= self.max_error:
            return "max"
        # A surface of one channel has no separate errors of channels.
        by_channel = channels or ((rms, max_error),)
        if self.channels and all(limit.error(by_channel) <= limit.most for limit in self.channels):
            return "channels"
        return None

    def unmet(
        self, rms: float, max_error: float, channels: Sequence[tuple[float, float]]
    ) -> Iterator[tuple[Literal["rms", "max"], str | None, float]]:
        """Yield every error above its limit: which one, its name (None: the whole surface), and its value."""
        if self.rms is not None and rms > self.rms:
            yield "rms", None, rms
        if self.max_error is not None and max_error > self.max_error:
            yield "max", None, max_error
        by_channel = channels or ((rms, max_error),)
        for limit in self.channels:
            if limit.error(by_channel) > limit.most:
                yield limit.which, limit.name, limit.error(by_channel)


def _missing(name: str, header: Header) -> str:
    """Quote a name that is not selected or does not exist, with the reason if it exists."""
    kinds = {kind.name for kind in header.attributes}
    there = name in kinds or name in header.channel_names
    return f"{name[:80]!r}" + (", which is left out: it is not among the attributes asked for" if there else "")


def _named(target: Target, header: Header) -> dict[str, list[tuple[int, ...]]]:
    """Return the groups of channels of each name; a name that several groups have applies to each of them."""
    wanted = selection_of(target).channels(header)
    groups: list[tuple[str, tuple[int, ...]]] = [(name, (number,)) for number, name in enumerate(header.channel_names)]
    first = header.point_channels
    for kind in header.attributes:
        if kind.components:
            groups.append((kind.name, tuple(range(first, first + kind.channels))))
        first += kind.channels
    by_name: dict[str, list[tuple[int, ...]]] = {}
    for name, group in groups:
        if wanted[list(group)].all():
            by_name.setdefault(name, []).append(group)
    return by_name
