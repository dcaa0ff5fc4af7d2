"""The parts of a plan."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Literal

from ..container.model import ByteRange

__all__ = ["Mark", "Plan", "Reason"]

#: Why a stream ends; `plan` knows the first six, the others happen on the way.
Reason = Literal["complete", "level", "rms", "max", "channels", "bytes", "seconds", "stopped", "truncated"]


@dataclass(frozen=True)
class Mark:
    """A state that the receiver reaches when it has received ``sent`` bytes of the plan's ranges.

    ``number`` is that of the layer (quality order) or level (level order). ``bytes`` counts what the receiver then has
    of the container. ``channels`` are RMS and maximum of each channel by itself, empty where there is one, or where
    they are not known.
    """

    sent: int
    number: int
    level: int
    bytes: int
    rms: float
    max_error: float
    channels: tuple[tuple[float, float], ...] = ()


@dataclass(frozen=True)
class Plan:
    """Slices of a container in sending order, without what is cached.

    Attributes
    ----------
    before : tuple of ByteRange
        Service slices that must come first: the index, if segments are sent without the tables of their layers.
    ranges : tuple of ByteRange
        Slices of the surface. Together with what is cached of them they are the state's ``bytes``.
    after : tuple of ByteRange
        The metadata.
    marks : tuple of Mark
        States on the way, the last one at the end; states with a ``sent`` of 0 are cached already.
    ended : str
        Why the plan ends.
    prefix : bool
        Whether all ``ranges`` together are a prefix of the file, which needs no index.
    """

    before: tuple[ByteRange, ...]
    ranges: tuple[ByteRange, ...]
    after: tuple[ByteRange, ...]
    marks: tuple[Mark, ...]
    ended: Reason
    prefix: bool = False

    @property
    def slices(self) -> tuple[ByteRange, ...]:
        """All slices, in order."""
        return (*self.before, *self.ranges, *self.after)

    @property
    def bytes(self) -> int:
        """Bytes of the surface's slices, sent or cached."""
        return self.marks[-1].bytes

    @property
    def level(self) -> int:
        """Finest level with a decoded segment at the end."""
        return self.marks[-1].level

    @property
    def rms(self) -> float:
        """RMS error at the end."""
        return self.marks[-1].rms

    @property
    def max_error(self) -> float:
        """Maximum error at the end."""
        return self.marks[-1].max_error

    def steps(self) -> Iterator[tuple[Mark, list[ByteRange]]]:
        """Yield each mark with the slices between the previous mark and itself."""
        todo = list(reversed(self.ranges))
        sent = 0
        for mark in self.marks:
            places = []
            while sent < mark.sent:
                place = todo.pop()
                size = min(place.length, mark.sent - sent)  # slices were put together: a state may end inside one
                places.append(ByteRange(place.offset, size))
                if size < place.length:
                    todo.append(ByteRange(place.offset + size, place.length - size))
                sent += size
            yield mark, places
