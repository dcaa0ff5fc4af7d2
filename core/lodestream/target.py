"""The part of a surface that a receiver requests: how far to refine it, and in which order."""

from __future__ import annotations

import math
import operator
from collections import Counter
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from functools import wraps
from typing import Any, Literal, TypeAlias

from .errors import OptionError
from .text import names_in

__all__ = [
    "ChannelLimit",
    "Limit",
    "Limits",
    "Order",
    "Region",
    "Target",
    "Tolerance",
    "check_integer",
    "check_spans",
    "check_target",
    "target_keyword",
]

Order = Literal["quality", "level"]
#: Rows and columns, half-open, in full-resolution indices.
Region = tuple[tuple[int, int], tuple[int, int]]


def check_integer(what: str, value: Any) -> int:
    """Return the number of a level or the like as int, whichever library's integer it is.

    Parameters
    ----------
    what : str
        What the number is of, with its article.
    value : object

    Raises
    ------
    OptionError
        If it is no integer; a bool is none.
    """
    try:
        if not isinstance(value, bool):  # True is 1, which nobody means
            return operator.index(value)
    except TypeError:
        pass
    raise OptionError(f"expected {what} as an integer such as 1, got {value!r}")


#: Words of other calls, such as `Container.view`, for the keywords of a target.
_KEYWORDS = {"rms": "until_rms", "max_error": "until_max", "bytes": "max_bytes"}


def target_keyword(word: str) -> str | None:
    """Return the keyword of `Target` that a word stands for, which it may be itself; None if it is none of them."""
    keyword = _KEYWORDS.get(word, word)
    return keyword if keyword in Target.__dataclass_fields__ else None


def check_target(target: object) -> None:
    """Refuse what is given in place of a target.

    Raises
    ------
    OptionError
    """
    if not isinstance(target, Target):
        raise OptionError(f"expected a target such as lodestream.Target(until_rms=5), got {str(target)[:80]!a}")


def check_spans(region: Region) -> None:
    """Refuse a region that is no pair of pairs, or contains no point, whatever the surface.

    Raises
    ------
    OptionError
    """
    try:
        (_, _), (_, _) = region
    except (TypeError, ValueError):
        raise OptionError(f"expected a region as ((row, end), (column, end)), got {region!r}") from None
    for start, stop in region:
        for line in (start, stop):
            check_integer("a row or column", line)
        if not 0 <= start < stop:
            raise OptionError(f"expected a region of at least one row and column, counted from 0, got {start}:{stop}")


@dataclass(frozen=True)
class Tolerance:
    """An error in the surface's unit, or relative to its extent.

    The extent is the range of the heights, or the diagonal of the bounding box of other points.

    Examples
    --------
    >>> import lodestream
    >>> lodestream.Tolerance.of("0.1%").absolute(extent=2000.0)
    2.0
    """

    value: float
    relative: bool = False

    def __post_init__(self) -> None:
        if not (math.isfinite(self.value) and self.value >= 0):
            raise OptionError(f"expected an error of 0 or more, got {self.value}")

    @classmethod
    def of(cls, error: Tolerance | float | str) -> Tolerance:
        """Convert an error: a tolerance, a number in the surface's unit, or a text for `parse`.

        >>> Tolerance.of("0.1%")
        Tolerance(value=0.001, relative=True)

        Raises
        ------
        OptionError
            If it is neither, or no number of 0 or more.
        """
        if isinstance(error, str):
            return cls.parse(error)
        if isinstance(error, Tolerance):
            return error
        try:
            return cls(float(error))
        except TypeError:
            raise OptionError(f"expected a number such as 0.5, a text or a Tolerance, got {error!r}") from None

    @classmethod
    def parse(cls, text: str) -> Tolerance:
        """Parse ``0.5`` (in the surface's unit) or ``0.1%`` (of the extent).

        Raises
        ------
        OptionError
            If the text is neither.
        """
        number, relative = (text[:-1].rstrip(), True) if text.endswith("%") else (text, False)
        mantissa, exponential, exponent = number.lower().partition("e")
        try:
            if relative:  # by the exponent, so that the number is that of the decimals without rounding twice
                number = f"{mantissa}e{int(exponent if exponential else 0) - 2}"
            return cls(float(number), relative)
        except ValueError:
            raise OptionError(
                f"{text[:80]!a} is not an error bound: write 0 or more, such as 0.5, or 0.1% of the extent"
            ) from None

    def __str__(self) -> str:
        """Return the canonical text of this tolerance, which `parse` reads."""
        if not self.relative:
            return f"{float(self.value)!r}"
        from decimal import Decimal

        percent = Decimal(repr(float(self.value))).scaleb(2).normalize()  # exact, as the exponent alone changes
        return f"{percent:f}%" if -7 < percent.adjusted() < 17 else f"{percent:e}%"

    def absolute(self, extent: float) -> float:
        """Return the tolerance in the unit of a surface with this extent."""
        return self.value * extent if self.relative else self.value


#: What stands for a tolerance where people write one: a number in the surface's unit, or a text for `Tolerance.parse`.
Limit: TypeAlias = Tolerance | float | str
#: An error of the whole surface, or errors of channels by name.
Limits: TypeAlias = Limit | Mapping[str, Limit]
#: A channel or an attribute by name, which of its errors is meant, and the largest that is allowed, in its unit.
ChannelLimit: TypeAlias = tuple[str, Literal["rms", "max"], float]


@dataclass(frozen=True, kw_only=True)
class Target:
    """What to decode or receive, where to stop, and in which order; by default the whole surface.

    Parameters
    ----------
    level : int or None
        Levels up to this one and nothing finer; cannot be combined with the other limits.
    until_rms, until_max : Tolerance, number, text, mapping or None
        Stop at the first layer with an error of at most this; a number or a text is taken by `Tolerance.of`. With a
        region, the bound of the error inside counts (`View.bound`). A mapping has errors of single channels: of
        coordinates (x, y, z), of attributes, and of their components (``wind_0``), in their units. Then the stream
        stops where all of them are met. The error of an attribute with components is that of the distance; for its
        maximum the root of the sum of the squares of the components' maxima is used, which is an upper bound.
    max_bytes : int or None
        Stop at the last layer that ends within so many bytes of the container.
    seconds : float or None
        Stop after so much time. The receiver takes care of this; `plan` ignores it.
    order : "quality" or "level"
        Quality order: the data that reduce the error most come first. Level order: level by level; limits then stop at
        the end of a level.
    region : ((int, int), (int, int)) or None
        Only this window: rows and columns, half-open, in full-resolution indices. Along a closed axis it may go on
        across the seam: of 360 columns, 350:370 are the last ten and the first ten. With a level, the window consists
        of the points of the level that lie in the region. A region is the same place at every level.
    attributes : tuple of str or None
        Names of the attributes to include, also given as a list or a text with commas; None: all.
    first : ((int, int), (int, int)) or None
        The data of this region come first, then the rest; rows and columns as in `region`.

    Raises
    ------
    OptionError
        If a value is not allowed, an attribute is named twice, or two contradict each other: a level and other limits,
        errors of channels and a region, errors of channels and of the whole surface.

    Examples
    --------
    >>> import lodestream
    >>> print(lodestream.Target(until_rms=0.5).until_rms)
    0.5
    >>> lodestream.Target(region=((0, 40), (0, 40)), attributes=()).order
    'quality'
    >>> lodestream.Target(until_rms={"speed": 0.1}, until_max={"z": 2}).channels
    (('speed', 'rms', 0.1), ('z', 'max', 2.0))
    """

    level: int | None = None
    until_rms: Limits | None = field(default=None, hash=False)
    until_max: Limits | None = field(default=None, hash=False)
    max_bytes: int | None = None
    seconds: float | None = None
    order: Order = "quality"
    region: Region | None = None
    attributes: tuple[str, ...] | None = None
    first: Region | None = None

    def __post_init__(self) -> None:
        object.__setattr__(self, "until_rms", _limits(self.until_rms))
        object.__setattr__(self, "until_max", _limits(self.until_max))
        limits = (self.until_rms, self.until_max, self.max_bytes, self.seconds)
        if self.level is not None and any(limit is not None for limit in limits):
            raise OptionError("expected either a level or other limits, got both")
        if self.level is not None:
            object.__setattr__(self, "level", check_integer("a level", self.level))
        if self.level is not None and self.level < 0:
            raise OptionError(f"expected a level of 0 or more, got {self.level}")
        if self.max_bytes is not None:
            object.__setattr__(self, "max_bytes", check_integer("a limit of bytes", self.max_bytes))
        if self.max_bytes is not None and self.max_bytes < 1:
            raise OptionError(f"expected a limit of at least one byte, got {self.max_bytes}")
        if self.seconds is not None and not self.seconds > 0:
            raise OptionError(f"expected a positive number of seconds, got {self.seconds}")
        if self.order not in ("quality", "level"):
            raise OptionError(f"expected order quality or level, got {str(self.order)[:80]!a}")
        if self.region is not None:
            check_spans(self.region)
        if self.first is not None:
            check_spans(self.first)
        if self.attributes is not None:
            object.__setattr__(self, "attributes", tuple(names_in(self.attributes)))
        if self.attributes is not None and len(set(self.attributes)) < len(self.attributes):
            name = next(name for name, count in Counter(self.attributes).items() if count > 1)
            raise OptionError(f"expected each attribute once, got {name[:80]!a} twice")
        if self.channels and self.whole != (None, None):
            raise OptionError("expected either an error of the whole surface or errors of channels, got both")
        if self.channels and self.region is not None:
            raise OptionError("expected either errors of channels or a region, of which they are not known, got both")

    @property
    def whole(self) -> tuple[Tolerance | None, Tolerance | None]:
        """The RMS and the maximum error of the whole surface at which to stop; None where there is no such limit."""
        rms, worst = (limit if isinstance(limit, Tolerance) else None for limit in (self.until_rms, self.until_max))
        return rms, worst

    @property
    def channels(self) -> tuple[ChannelLimit, ...]:
        """The errors of channels at which to stop, by name."""
        limits: list[ChannelLimit] = []
        if isinstance(self.until_rms, Mapping):
            limits += [(name, "rms", Tolerance.of(limit).value) for name, limit in self.until_rms.items()]
        if isinstance(self.until_max, Mapping):
            limits += [(name, "max", Tolerance.of(limit).value) for name, limit in self.until_max.items()]
        return tuple(sorted(limits))


def _limits(given: Limits | None) -> Tolerance | dict[str, Tolerance] | None:
    """Check error limits, of the whole surface or of channels."""
    if given is None:
        return None
    if not isinstance(given, Mapping):
        return Tolerance.of(given)
    for name in given:
        if not isinstance(name, str):
            raise OptionError(f"expected errors by the names of channels, such as {{'z': 0.5}}, got the key {name!r}")
    limits = {name: Tolerance.of(limit) for name, limit in given.items()}
    for name, limit in limits.items():
        if limit.relative:
            # The extent is one of lengths; a channel has its own unit.
            raise OptionError(f"expected an error of {name!r} in its own unit, got {limit}, which is of the extent")
    return limits or None


def _with_words(made: Callable[..., None]) -> Callable[..., None]:
    """Return what makes a target, and names the right keyword for a word of another call."""

    @wraps(made)
    def make(self: Target, *args: Any, **given: Any) -> None:
        word = next((word for word in given if word in _KEYWORDS), None)
        if word is not None:
            raise OptionError(f"expected {_KEYWORDS[word]}={str(given[word])[:80]}, got {word}=")
        made(self, *args, **given)

    return make


Target.__init__ = _with_words(Target.__init__)  # type: ignore[method-assign]  # what it wraps has the parameters
