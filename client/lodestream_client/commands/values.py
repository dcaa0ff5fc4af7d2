"""Types of options: conversion of text from the command line into numbers, addresses and names."""

from __future__ import annotations

import argparse
import math
import re
from collections.abc import Callable
from datetime import timedelta
from typing import TypeVar
from urllib.parse import urlsplit

from lodestream import sizes
from lodestream.errors import OptionError
from lodestream.quality import Quality
from lodestream.target import Region, Tolerance

from ..requests import addresses

__all__ = [
    "parse_count",
    "parse_days",
    "parse_http",
    "parse_level",
    "parse_limit",
    "parse_memory",
    "parse_names",
    "parse_pair",
    "parse_pictures",
    "parse_port",
    "parse_positive_seconds",
    "parse_precision",
    "parse_rate",
    "parse_region",
    "parse_scheduler",
    "parse_seconds",
    "parse_server",
    "parse_size",
    "parse_source",
    "parse_surface",
    "parse_tolerance",
]

T = TypeVar("T")

_AMOUNT = re.compile(r"\s*([0-9]*\.?[0-9]+(?:[eE][+-]?[0-9]+)?)\s*([a-zA-Z]*)(/s)?\s*")
_MOST_DAYS = 36_500
_PREFIXES = {"": 1, "k": 10**3, "m": 10**6, "g": 10**9, "ki": 2**10, "mi": 2**20, "gi": 2**30}


def parse_size(text: str) -> int:
    """Read a number of bytes, such as ``20000``, ``20kB`` or ``1MiB``.

    Raises
    ------
    ArgumentTypeError
        If it is something else.
    """
    try:
        size = sizes.parse_size(text)
    except ValueError as error:
        raise argparse.ArgumentTypeError(str(error)) from None
    if size < 1:
        raise argparse.ArgumentTypeError(f"expected at least one byte, got {text!r}")
    return size


def parse_rate(text: str) -> float:
    """Read a rate such as ``64kbit``, ``1mbit/s`` or ``200kB``; bytes per second.

    Raises
    ------
    ArgumentTypeError
        If it is something else.
    """
    number, unit = _amount(text)
    bits = unit.lower().endswith("bit")
    prefix = unit.lower().removesuffix("bit") if bits else unit.removesuffix("B").lower()
    if not (bits or unit.endswith("B")) or prefix not in _PREFIXES or not number > 0:
        raise argparse.ArgumentTypeError(f"expected a rate such as 64kbit, 1mbit or 200kB (per second), got {text!r}")
    return number * _PREFIXES[prefix] / (8 if bits else 1)


def _amount(text: str) -> tuple[float, str]:
    match = _AMOUNT.fullmatch(text)
    if match is None or not math.isfinite(float(match[1])):
        return 0.0, "?"
    return float(match[1]), match[2]


def parse_pair(text: str) -> tuple[str, str]:
    """Read ``KEY=VALUE``.

    Raises
    ------
    ArgumentTypeError
        If it is something else.
    """
    key, equals, value = text.partition("=")
    if not key or not equals:
        raise argparse.ArgumentTypeError(f"expected KEY=VALUE, got {text!r}")
    return key, value


def parse_seconds(text: str) -> float:
    """Read a number of seconds, 0 or more.

    Raises
    ------
    ArgumentTypeError
        If it is something else.
    """
    value = _seconds(text)
    if not 0 <= value < math.inf:
        raise argparse.ArgumentTypeError(f"expected a number of seconds, got {text!r}")
    return value


def parse_positive_seconds(text: str) -> float:
    """Read a number of seconds above 0.

    Raises
    ------
    ArgumentTypeError
        If it is something else.
    """
    value = _seconds(text)
    if not 0 < value < math.inf:
        raise argparse.ArgumentTypeError(f"expected a positive number of seconds, got {text!r}")
    return value


def _seconds(text: str) -> float:
    try:
        return float(text)
    except ValueError:
        return math.nan


def parse_level(text: str) -> int:
    """Read the number of a level.

    Raises
    ------
    ArgumentTypeError
        If it is something else.
    """
    if not text.isdecimal():
        raise argparse.ArgumentTypeError(f"expected a level of 0 or more, got {text!r}")
    return int(text)


def parse_count(text: str) -> int:
    """Read a whole number of 1 or more.

    Raises
    ------
    ArgumentTypeError
        If it is something else.
    """
    if not re.fullmatch("[0-9]{1,18}", text) or int(text) < 1:
        raise argparse.ArgumentTypeError(f"expected a number of 1 or more, got {text!r}")
    return int(text)


def parse_region(text: str) -> Region:
    """Read rows and columns such as ``0:100,200:300``, half-open.

    Raises
    ------
    ArgumentTypeError
        If it is something else.
    """
    match = re.fullmatch(r"(\d+):(\d+),(\d+):(\d+)", text.replace(" ", ""))
    if match is None:
        raise argparse.ArgumentTypeError(f"expected rows and columns such as 0:100,200:300, got {text!r}")
    top, bottom, left, right = map(int, match.groups())
    return (top, bottom), (left, right)


def parse_names(text: str) -> tuple[str, ...]:
    """Read names separated by commas; ``none`` is none."""
    return () if text == "none" else tuple(name.strip() for name in text.split(",") if name.strip())


def parse_port(text: str) -> int:
    """Read a port of TCP; 0 for any free one."""
    if not text.isascii() or not text.isdigit() or int(text) > 65535:
        raise argparse.ArgumentTypeError(f"expected a port of 0 to 65535, got {text!r}")
    return int(text)


def parse_pictures(text: str) -> tuple[tuple[str, int | None], ...]:
    """Read a list such as ``1kB,20kB,all``: each size as it was written, and in bytes (None: all)."""
    words = [word.strip() for word in text.split(",")]
    return tuple((word, None if word == "all" else parse_size(word)) for word in words)


def _checked(parse: Callable[[str], T]) -> Callable[[str], T]:
    # argparse hides the message of any other exception behind "invalid value".
    def checked(text: str) -> T:
        try:
            return parse(text)
        except OptionError as error:
            raise argparse.ArgumentTypeError(str(error)) from None

    return checked


def parse_days(text: str) -> timedelta:
    """Read a number of days, 0 or more.

    Raises
    ------
    ArgumentTypeError
        If it is something else.
    """
    try:
        days = float(text)
        if not 0 <= days <= _MOST_DAYS:
            raise ValueError
    except ValueError:
        raise argparse.ArgumentTypeError(f"expected a number of days, 0 to {_MOST_DAYS}, got {text!r}") from None
    return timedelta(days=days)


def _http(text: str) -> str:
    if not addresses.is_url(text) or "@" in urlsplit(text).netloc:
        raise OptionError("expected an address that begins with http:// or https://, without credentials")
    return text


def _limit(text: str) -> tuple[str | None, Tolerance]:
    # A name may hold an equals sign, a number does not.
    name, equals, error = text.rpartition("=")
    if equals and not name:
        raise OptionError(f"expected E or NAME=E, got {text!r}")
    return name if equals else None, Tolerance.parse(error)


def _memory(text: str) -> int:
    from lodestream.encoding.memory import checked_memory

    return checked_memory(text)


def _scheduler(text: str) -> str:
    from lodestream.encoding.cluster import checked_address  # which most commands need not import

    return checked_address(text)


def _precision(text: str) -> str:
    if "" in Quality.parse([text]).attributes:
        raise OptionError(f"expected P or NAME=P, got {text!r}")
    return text


parse_tolerance = _checked(Tolerance.parse)
parse_limit = _checked(_limit)
parse_precision = _checked(_precision)
parse_memory = _checked(_memory)
parse_scheduler = _checked(_scheduler)
parse_http = _checked(_http)
parse_server = _checked(addresses.surfaces_url)
parse_surface = _checked(addresses.surface_url)
parse_served = _checked(addresses.served_url)
parse_source = _checked(addresses.source_url)
