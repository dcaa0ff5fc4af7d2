"""The input of a reader, and the limits that it checks before it allocates memory."""

from __future__ import annotations

from collections.abc import Callable, Collection, Mapping, Sequence
from copy import copy
from dataclasses import dataclass
from math import prod
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
from numpy.typing import NDArray

from ..errors import FormatError, InputError, OptionError, SwitchedOffError, TooLargeError
from ..scratch import IN_MEMORY, Room
from ..surface import Closed

__all__ = [
    "DEFAULT_MAX_VERTICES",
    "MOST_CHOICES",
    "UNLIMITED_VERTICES",
    "Source",
    "check_allowed",
    "number",
    "reworded",
    "with_name",
]

_Error = TypeVar("_Error", bound=InputError)

#: What `read` accepts unless told otherwise: 2 GiB of float64 heights.
DEFAULT_MAX_VERTICES = 1 << 28
#: And where large arrays go to files.
UNLIMITED_VERTICES = 1 << 48

#: Surfaces of a file that are offered where one has to be chosen (`ChoiceError`); a file may have thousands.
MOST_CHOICES = 50

#: Values per allowed vertex, so that a grid of few vertices and millions of channels is no way around the limit.
_MAX_CHANNELS = 64

#: Deflate expands at most 1032 times; what claims much more is made to do harm, or holds nothing.
_MAX_EXPANSION = 2048
_HARMLESS_BYTES = 64 << 20

_KINDS = {
    "O": "Python objects, which are never unpickled",
    "S": "byte strings",
    "U": "strings",
    "c": "complex numbers",
    "b": "booleans",
    "V": "records",
    "M": "dates",
    "m": "time spans",
}
_FLOAT_SIZES = (4, 8)


def _untold(_: float) -> None:
    """Tell nobody."""


@dataclass(frozen=True, slots=True)
class Source:
    """One file to read a surface from.

    Messages of errors raised by readers do not name the file: `lodestream.formats.read` puts its name in front.

    Attributes
    ----------
    path : Path
        An existing regular file.
    stem : str
        Name of the file as its owner knows it, without the suffix.
    size : int
        Bytes of the file.
    max_vertices : int
        Larger surfaces are refused.
    options : mapping of str to str
        Options of the format, checked to exist; their values are not checked.
    more : tuple of Path
        Further files of the same surface, existing regular ones, for the formats that take them.
    closed : (bool, bool) or None
        Which axes wrap, where that was said; None leaves it to the reader.
    allowed : collection of str or None
        Names of the formats that may be read; None for all.
    room : Room
        Where large arrays go.
    progress : callable
        Is told the part of the work that is done, from 0 to 1, by what takes long: resampling.
    """

    path: Path
    stem: str
    size: int
    max_vertices: int
    options: Mapping[str, Any]
    more: tuple[Path, ...] = ()
    closed: Closed | None = None
    allowed: Collection[str] | None = None
    room: Room = IN_MEMORY
    progress: Callable[[float], None] = _untold

    def empty(self, shape: tuple[int, ...], dtype: np.dtype[Any]) -> NDArray[Any]:
        """Return a new array of this shape, (row, ...), not initialised.

        A large one lies in a file, if there is room.
        """
        return self.room.empty(shape, dtype)

    def check_vertices(self, count: int, shape: str) -> None:
        """Refuse a surface of too many vertices; `shape` tells in words where the count comes from.

        Raises
        ------
        TooLargeError
            If ``count`` is above `max_vertices`.
        """
        if count > self.max_vertices:
            raise TooLargeError(f"expected at most {number(self.max_vertices)} vertices, got {shape}")

    def check_array(self, shape: tuple[int, ...], dtype: np.dtype[Any]) -> None:
        """Refuse, by its header alone, an array that is no surface or is larger than allowed.

        Raises
        ------
        FormatError
            If no surface has this shape or type.
        TooLargeError
            If it has too many vertices, or too many values for each.
        """
        refusal = refuse_array(shape, dtype)
        if refusal:
            raise FormatError(refusal)
        vertices = shape[0] * shape[1]
        words = " x ".join(map(str, shape))
        self.check_vertices(vertices, f"an array of {words}")
        if prod(shape) > self.max_vertices * _MAX_CHANNELS:
            raise TooLargeError(f"expected at most {_MAX_CHANNELS} values for each vertex allowed, got {words}")

    def check_expansion(self, promised: int) -> None:
        """Refuse a compressed file that promises implausibly more bytes than it has.

        Raises
        ------
        TooLargeError
            If it would expand more than deflate can.
        """
        if promised > max(_HARMLESS_BYTES, self.size * _MAX_EXPANSION):
            raise TooLargeError(
                f"expected a file that expands at most {_MAX_EXPANSION} times, got {number(self.size)} bytes that "
                f"promise {number(promised)}"
            )

    def metadata(self, format_name: str) -> dict[str, Any]:
        """Return the metadata that all readers give."""
        return {"name": self.stem, "format": format_name}

    def integer_option(self, name: str, low: int, high: int) -> int | None:
        """Return the value of the option `name` as an integer from `low` to `high`; None if it was not given.

        Raises
        ------
        OptionError
            If it is no whole number, or outside the bounds.
        """
        value = self.options.get(name)
        if value is None:
            return None
        try:
            result = int(str(value))
        except ValueError:
            raise OptionError(f"expected {name}= a whole number, got {str(value)!r}") from None
        if not low <= result <= high:
            raise OptionError(f"expected {name}= from {low} to {high}, got {result}")
        return result


def refuse_array(shape: tuple[int, ...], dtype: np.dtype[Any]) -> str | None:
    """Return the reason why an array of this shape and type is no surface; None if it is one."""
    if dtype.kind in _KINDS or (dtype.kind == "f" and dtype.itemsize not in _FLOAT_SIZES):
        kind = f"{_KINDS[dtype.kind]} ({dtype})" if dtype.kind in _KINDS else str(dtype)
        return f"this is an array of {kind}: save it as integers, float32 or float64"
    if len(shape) not in (2, 3) or (len(shape) == 3 and shape[2] < 2):
        advice = {1: "give it rows and columns", 3: "drop its last axis"}.get(len(shape), "save one slice of it")
        return (
            f"this is an array of shape {shape}, not of (H, W), heights in rows and columns, nor of (H, W, 2), "
            f"(H, W, 3) or more channels, points: {advice}"
        )
    if min(shape) < 1 or shape[0] * shape[1] < 2:
        return f"this is an array of shape {shape}: a surface has at least two points"
    return None


def check_allowed(names: Sequence[str], allowed: Collection[str] | None) -> None:
    """Refuse a file that is of one of these formats when none of them may be read.

    Raises
    ------
    SwitchedOffError
        Naming the first of them.
    """
    if allowed is not None and not set(names) & set(allowed):
        raise SwitchedOffError(
            f"expected a file of a format that is switched on, got {names[0]}, which is switched off"
        )


def number(value: int) -> str:
    """Return a count with separators, for messages."""
    return f"{value:,}"


def counted(count: int, singular: str, plural: str) -> str:
    """Return a count with the words for it, for messages: "1 value is", "2 values are"."""
    return f"{number(count)} {singular if count == 1 else plural}"


def with_name(error: InputError, label: str) -> InputError:
    """Return an error with the file's name before its message, which stays one line whatever either holds."""
    message = f"{label}: {error}"
    return reworded(error, "".join(c if c.isprintable() else c.encode("unicode_escape").decode() for c in message))


def reworded(error: _Error, message: str) -> _Error:
    """Return an error like another one, with all that this has but its message."""
    other = copy(error)
    other.args = (message,)
    return other
