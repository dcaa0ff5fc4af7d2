"""Messages as bytes: a MessagePack map for each, with a ``type``.

Keys that a receiver does not know are ignored, so that later versions can add some; everything else is checked, since
the other side is a stranger.
"""

from __future__ import annotations

import math
import re
import reprlib
from collections.abc import Callable, Mapping
from typing import Any, TypeAlias

import msgpack

from ..errors import OptionError, UnsupportedVersionError
from ..target import ChannelLimit, Region, Target, Tolerance
from .messages import (
    BASE_CREDIT,
    MAX_DATA,
    MAX_HELD,
    MAX_MESSAGE,
    VERSION,
    Bye,
    Credit,
    End,
    Error,
    Event,
    Layer,
    MessageError,
    Open,
    Opened,
    Segments,
    Stop,
)

__all__ = ["parse", "serialize"]

# Integers stay exact in every language that reads them as a double.
_MAX_INTEGER = 2**53

_Read: TypeAlias = Callable[[Any], Any]


class _MismatchError(Exception):
    """A field has another value than expected; the text says what was expected."""


def _integer(value: Any, least: int = 0) -> int:
    """Check an integer from ``least`` to 2**53."""
    # bool is a subclass of int only in Python.
    if type(value) is not int or not least <= value <= _MAX_INTEGER:
        raise _MismatchError(f"an integer from {least} to 2^53")
    return value


def _positive(value: Any) -> int:
    """Check an integer from 1 to 2**53."""
    return _integer(value, 1)


def _credit(value: Any) -> int:
    """Check an amount of credit."""
    if type(value) is not int or not BASE_CREDIT <= value <= _MAX_INTEGER:
        raise _MismatchError(f"an integer from {BASE_CREDIT} to 2^53")
    return value


def _number(value: Any) -> float:
    """Check a finite number."""
    # Other languages write 2.0 as the integer 2.
    if type(value) not in (int, float) or not math.isfinite(value):
        raise _MismatchError("a finite number")
    return float(value)


def _text(value: Any) -> str:
    """Check a text."""
    if not isinstance(value, str):
        raise _MismatchError("text")
    return value


def _data(value: Any) -> bytes:
    """Check the bytes of a slice."""
    if not isinstance(value, bytes) or not 0 < len(value) <= MAX_DATA:
        raise _MismatchError(f"1 to {MAX_DATA} bytes")
    return value


def _digest(value: Any) -> str:
    """Check a SHA-256 in hexadecimal digits."""
    if not isinstance(value, str) or not re.fullmatch("[0-9a-f]{64}", value):
        raise _MismatchError("64 hexadecimal digits")
    return value


def _held(value: Any) -> tuple[tuple[int, int], ...]:
    """Check the ranges that a client has cached."""
    if not isinstance(value, list) or not all(isinstance(pair, list) and len(pair) == 2 for pair in value):
        raise _MismatchError("a list of [offset, length]")
    if len(value) > MAX_HELD:
        raise MessageError("bad-held", f"expected open.held to be at most {MAX_HELD} ranges, got {len(value)}")
    return tuple((_integer(offset), _positive(length)) for offset, length in value)


def _place(value: Any) -> tuple[int, int]:
    """Check the offset and length of a range that is not empty."""
    if not isinstance(value, list) or len(value) != 2:
        raise _MismatchError("[offset, length]")
    return _integer(value[0]), _positive(value[1])


def _section(value: Any) -> tuple[int, int]:
    """Check the offset and length of a range that may be empty."""
    if not isinstance(value, list) or len(value) != 2:
        raise _MismatchError("[offset, length]")
    return _integer(value[0]), _integer(value[1])


def _flag(value: Any) -> bool:
    """Check a boolean."""
    if not isinstance(value, bool):
        raise _MismatchError("true or false")
    return value


def _tolerance(value: Any) -> Tolerance:
    """Check a tolerance."""
    if not isinstance(value, list) or len(value) != 2 or not isinstance(value[1], bool):
        raise _MismatchError("[number, whether it is relative]")
    return Tolerance(_number(value[0]), value[1])


def _region(value: Any) -> Region:
    """Check a region."""
    if not isinstance(value, list) or len(value) != 2:
        raise _MismatchError("[[first row, past the last], [first column, past the last]]")
    spans = []
    for span in value:
        if not isinstance(span, list) or len(span) != 2:
            raise _MismatchError("[[first row, past the last], [first column, past the last]]")
        spans.append((_integer(span[0]), _integer(span[1])))
    return spans[0], spans[1]


def _names(value: Any) -> tuple[str, ...]:
    """Check a list of names."""
    if not isinstance(value, list) or not all(isinstance(name, str) for name in value):
        raise _MismatchError("a list of names")
    return tuple(value)


def _channels(value: Any) -> tuple[ChannelLimit, ...]:
    """Check limits of channels."""
    if not isinstance(value, list) or not all(isinstance(limit, list) and len(limit) == 3 for limit in value):
        raise _MismatchError("a list of [name, rms or max, number]")
    for name, which, _ in value:
        if not isinstance(name, str) or which not in ("rms", "max"):
            raise _MismatchError("a list of [name, rms or max, number]")
    return tuple((name, which, _number(error)) for name, which, error in value)


def _error(value: Any) -> float:
    """Check an error; None stands for an unknown one, NaN."""
    return math.nan if value is None else _number(value)


_TARGET: Mapping[str, _Read] = {
    "level": _integer,
    "until_rms": _tolerance,
    "until_max": _tolerance,
    "channels": _channels,
    "max_bytes": _integer,
    "order": _text,
    "region": _region,
    "attributes": _names,
    "first": _region,
}


def _target(value: Any) -> Target:
    """Check a target."""
    if not isinstance(value, dict):
        raise _MismatchError("a map")
    fields = {
        name: _value(f"target.{name}", read, value[name])
        for name, read in _TARGET.items()
        if value.get(name) is not None
    }
    for name, which, error in fields.pop("channels", ()):
        limits = fields.setdefault(f"until_{which}", {})
        if not isinstance(limits, dict):
            raise OptionError("expected either an error of the whole surface or errors of channels, got both")
        if name in limits:
            raise OptionError(f"expected one {which} error of {_show(name)}, got two")
        limits[name] = error
    return Target(**fields)


_FIELDS: Mapping[type[Event], Mapping[str, _Read]] = {
    Open: {
        "target": _target,
        "credit": _integer,
        "held": _held,
        "container": _digest,
        "token": _text,
        "window_errors": _flag,
        "decodes": _flag,
    },
    Credit: {"bytes": _positive},
    Stop: {},
    Bye: {},
    Opened: {
        "container": _digest,
        "size": _integer,
        "planned": _integer,
        "extent": _number,
        "index": _place,
        "metadata": _place,
        "prefix": _flag,
        "credit": _credit,
        "window_errors": _section,
        "channels": _flag,
    },
    Segments: {"offset": _integer, "data": _data},
    Layer: {"number": _integer, "level": _integer, "bytes": _integer, "rms": _error, "max": _error},
    End: {"why": _text},
    Error: {"code": _text, "title": _text, "detail": _text},
}

_TYPES: Mapping[str, type[Event]] = {kind.type: kind for kind in _FIELDS}

#: What may be left out: a client that wants the whole surface and holds nothing says only its version and credit, and
#: those of earlier releases say nothing of errors of windows or that they decode, nor servers how much they keep of the
#: credit, or that they know errors of channels.
_OPTIONAL = {
    (Open, "target"),
    (Open, "held"),
    (Open, "container"),
    (Open, "token"),
    (Open, "window_errors"),
    (Open, "decodes"),
    (Opened, "credit"),
    (Opened, "window_errors"),
    (Opened, "channels"),
}
#: Fields that are omitted where their value is unknown.
_UNKNOWN = {(Layer, "rms"), (Layer, "max")}


def serialize(event: Event) -> bytes:
    """Serialize a message."""
    fields: dict[str, Any] = {"type": event.type}
    if isinstance(event, Open):
        fields["version"] = VERSION
    for name in _FIELDS[type(event)]:
        value = _plain(getattr(event, name))
        if value is not None:
            fields[name] = value
    packed: bytes = msgpack.packb(fields)
    return packed


def parse(message: bytes) -> Event:
    """Parse a message into its event.

    Raises
    ------
    MessageError
        When it is too large, not one MessagePack map, of an unknown type, or has a field that is missing or wrong; with
        the code ``bad-target`` when the fields of a target contradict each other.
    UnsupportedVersionError
        When an `Open` names another version of the protocol.
    """
    if len(message) > MAX_MESSAGE:
        raise MessageError(
            "message-too-large", f"expected a message of at most {MAX_MESSAGE} bytes, got {len(message)}"
        )
    fields = _unpack(message)
    name = fields.get("type")
    kind = _TYPES.get(name) if isinstance(name, str) else None
    if kind is None:
        raise MessageError("bad-message", f"expected a type out of {', '.join(_TYPES)}, got {_show(name)}")
    if kind is Open:
        _check_version(fields)
    try:
        return kind(**_values(kind, fields))
    except OptionError as error:
        raise MessageError("bad-target", str(error)) from None


def _unpack(message: bytes) -> dict[str, Any]:
    """Decode the MessagePack map of a message."""
    try:
        fields = msgpack.unpackb(message, raw=False, strict_map_key=True)
    # The exceptions of the MessagePack decoder have no common base class.
    except (ValueError, TypeError, OverflowError, RecursionError, msgpack.UnpackException) as error:
        raise MessageError(
            "bad-message", f"expected one MessagePack map, got {len(message)} bytes that are not: {error}"
        ) from None
    if not isinstance(fields, dict):
        raise MessageError("bad-message", f"expected a MessagePack map, got {_show(fields)}")
    return fields


def _check_version(fields: dict[str, Any]) -> None:
    """Check the protocol version of an opening message."""
    version = fields.get("version")
    if type(version) is not int:
        raise MessageError("bad-message", f"expected open.version to be an integer, got {_show(version)}")
    if version != VERSION:
        raise UnsupportedVersionError(f"expected version {VERSION} of the protocol, got version {version}")


def _values(kind: type[Event], fields: dict[str, Any]) -> dict[str, Any]:
    """Check all fields of a message."""
    values = {}
    for name, read in _FIELDS[kind].items():
        if name in fields:
            values[name] = _value(f"{kind.type}.{name}", read, fields[name])
        elif (kind, name) in _UNKNOWN:
            values[name] = math.nan
        elif (kind, name) not in _OPTIONAL:
            raise MessageError("bad-message", f"expected {kind.type}.{name}, got {_show(list(fields))}")
    return values


def _value(place: str, read: _Read, value: Any) -> Any:
    """Check a field; the error names its place."""
    try:
        return read(value)
    except _MismatchError as expected:
        raise MessageError("bad-message", f"expected {place} to be {expected}, got {_show(value)}") from None


def _plain(value: Any) -> Any:
    """Convert a value of an event into what MessagePack encodes."""
    if isinstance(value, Target):
        chosen = {name: _plain(getattr(value, name)) for name in _TARGET}
        chosen["channels"] = value.channels or None
        return {name: item for name, item in chosen.items() if item is not None}
    if isinstance(value, Tolerance):
        return [value.value, value.relative]
    if isinstance(value, Mapping):
        return None  # errors of channels have a separate key
    # NaN is an unknown error of an incomplete window.
    return None if isinstance(value, float) and math.isnan(value) else value


def _show(value: Any) -> str:
    """Shorten and escape a value for an error message."""
    # Received values may be long, deeply nested or unprintable.
    return reprlib.repr(value).encode("ascii", "backslashreplace").decode()
