"""What an encoding is to be: how close, and with how much effort; as a caller, a command or a query requests it."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from typing import Literal, cast, get_args

from .errors import OptionError
from .target import Limit, Tolerance

__all__ = ["EFFORTS", "Effort", "Limit", "Quality"]

#: What an encoder spends its time on, see `lodestream.encoding.effort`.
Effort = Literal["fast", "default", "small"]
EFFORTS: tuple[Effort, ...] = get_args(Effort)


@dataclass(frozen=True, kw_only=True)
class Quality:
    """How closely a container keeps a surface, by default bit for bit; and with how much effort it is made.

    >>> Quality.of("0.01%").precision
    Tolerance(value=0.0001, relative=True)
    >>> Quality.of(rms=0.5, attributes={"depth": 2}).attributes
    {'depth': Tolerance(value=2.0, relative=False)}

    Parameters
    ----------
    precision : Tolerance or None
        Maximum error of the points of the complete surface.
    rms : Tolerance or None
        Encode for one root mean square error instead: the complete surface has at most this error.
    attributes : mapping of str to Tolerance
        Maximum errors of attributes, by name, or of single channels: a coordinate (x, y, z), a component of an
        attribute (``wind_0``). The others are restored bit for bit, except coordinates to which `precision` applies.
    effort : "fast", "default" or "small"
        It changes bytes and time, never values. "fast": about half the time, in few layers. "small": fewer bytes,
        in few layers; a window takes more of them, since tiles and chunks are large.

    Raises
    ------
    OptionError
        If both a precision and a root mean square error are given, or if there is no such effort.
    """

    precision: Tolerance | None = None
    rms: Tolerance | None = None
    attributes: Mapping[str, Tolerance] = field(default_factory=dict, hash=False)
    effort: Effort = "default"

    def __post_init__(self) -> None:
        if self.effort not in EFFORTS:
            raise OptionError(f"effort must be one of {', '.join(EFFORTS)}, and is {str(self.effort)[:80]!a}")
        if self.precision is not None and self.rms is not None:
            raise OptionError("give either a precision or an RMS error, not both")

    @classmethod
    def of(
        cls,
        precision: Limit | None = None,
        rms: Limit | None = None,
        attributes: Mapping[str, Limit] | None = None,
        effort: Effort = "default",
    ) -> Quality:
        """Make a quality from tolerances, numbers in the surface's unit, or texts.

        Raises
        ------
        OptionError
            If one of them is not a number of 0 or more, if both a precision and a root mean square error are given, or
            if there is no such effort.
        """
        return cls(
            precision=None if precision is None else Tolerance.of(precision),
            rms=None if rms is None else Tolerance.of(rms),
            attributes={name: Tolerance.of(limit) for name, limit in (attributes or {}).items()},
            effort=effort,
        )

    @classmethod
    def parse(cls, precisions: Iterable[str] = (), rms: str | None = None, effort: str = "default") -> Quality:
        """Parse a quality from the texts of a command line or a query, which `texts` returns.

        >>> Quality.parse(["0.01%", "depth=0.5"]) == Quality.of("0.01%", attributes={"depth": 0.5})
        True

        Parameters
        ----------
        precisions : iterable of str
            ``P`` for the points, ``NAME=P`` for an attribute or a channel. A name may contain an equals sign, a
            tolerance does not.
        rms : str or None
        effort : str

        Raises
        ------
        OptionError
            If a text is not a tolerance, if one is given twice, if both a precision and a root mean square error are
            given, or if there is no such effort.
        """
        tolerances: dict[str | None, Tolerance] = {}
        for text in precisions:
            name, equals, tolerance = text.rpartition("=")
            key = name if equals else None
            if key in tolerances:
                raise OptionError(f"the precision of {_shown(key)} is given twice")
            tolerances[key] = _parsed("precision", tolerance)
        points = tolerances.pop(None, None)
        attributes = {name: tolerance for name, tolerance in tolerances.items() if name is not None}
        error = None if rms is None else _parsed("rms", rms)
        return cls(precision=points, rms=error, attributes=attributes, effort=cast("Effort", effort))

    def texts(self) -> tuple[list[str], str | None]:
        """Return the texts of errors that `parse` reads: the precisions and the RMS error, in canonical spelling.

        >>> Quality.of(attributes={"depth": 0.5}, rms="10.0%").texts()
        (['depth=0.5'], '10%')
        """
        precisions = [] if self.precision is None else [str(self.precision)]
        precisions += [f"{name}={tolerance}" for name, tolerance in self.attributes.items()]
        return precisions, None if self.rms is None else str(self.rms)


def _parsed(option: str, text: str) -> Tolerance:
    try:
        return Tolerance.parse(text)
    except OptionError as error:
        raise OptionError(f"{option}: {error}") from None


def _shown(name: str | None) -> str:
    """Quote the name of an attribute for a message."""
    return "the points" if name is None else f"{name[:80]!a}"
