"""Answers of a server over HTTP: read within bounds, and their JSON checked before use.

Encoded answers are refused: none was requested, and a few compressed bytes can expand to any number.
"""

from __future__ import annotations

import json
import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

from lodestream.errors import RemoteProtocolError

from . import addresses

if TYPE_CHECKING:
    import httpx

__all__ = ["LONGEST_ANSWER", "LONGEST_PROBLEM", "Answer", "Head", "Incoming", "check_figures", "parse", "withheld"]

#: The most bytes of an answer that are read, where it is not data of a container; and of one that says what is wrong.
LONGEST_ANSWER = 16 * 1024 * 1024
LONGEST_PROBLEM = 64 * 1024

# Lists in lists: more than any description has, and far less than what a program can print or write again.
_DEEPEST = 32

_LARGEST_NUMBER = 2**63


@dataclass(frozen=True)
class Answer:
    """An answer that has been read as far as needed.

    Attributes
    ----------
    status, reason : int, str
        The status line.
    headers : mapping
        By names in lower case.
    content : bytes
        The body, as it was sent.
    withheld : str
        Explanation if the token was not sent along a redirect; otherwise empty.
    """

    status: int
    reason: str
    headers: Mapping[str, str]
    content: bytes = field(default=b"", repr=False)
    withheld: str = ""


@dataclass(frozen=True)
class Head:
    """An answer up to its body.

    Attributes
    ----------
    status, reason : int, str
        The status line.
    headers : mapping
        By names in lower case.
    url : str
        The URL that answered, to which redirects may have led.
    """

    status: int
    reason: str
    headers: Mapping[str, str] = field(repr=False)
    url: str

    @classmethod
    def of(cls, response: httpx.Response) -> Head:
        """Return the head of a response of httpx."""
        return cls(response.status_code, response.reason_phrase, dict(response.headers), str(response.url))


class Incoming:
    """An answer whose body has not been read yet.

    Parameters
    ----------
    head : Head
    most : int
        Most bytes of a body, unless it is a problem document.
    asked, given : str
        The URL of the request, and the one that the user gave.
    token : str or None
        Token that was sent to the server at `given`.

    Raises
    ------
    RemoteProtocolError
        If the body is encoded, or longer than `most`.
    """

    def __init__(self, head: Head, most: int, asked: str, given: str, token: str | None) -> None:
        self._head = head
        self._asked = asked
        self._fine = 200 <= head.status < 300
        self._most = most if self._fine else LONGEST_PROBLEM
        self._withheld = withheld(token, given, asked, head.url)
        self._body = bytearray()
        coding = head.headers.get("content-encoding", "identity")
        self._read = coding == "identity"
        if self._fine and not self._read:
            raise RemoteProtocolError(f"expected an unencoded answer of {asked}, got one encoded with {coding}")

    def take(self, chunk: bytes) -> bool:
        """Take a chunk of the body, and return whether more is needed.

        Raises
        ------
        RemoteProtocolError
            If the body is longer than allowed.
        """
        if self._read:
            self._body += chunk
        if len(self._body) <= self._most:
            return self._read
        if self._fine:
            raise RemoteProtocolError(f"expected at most {self._most} bytes of {self._asked}, got more")
        del self._body[self._most :]
        return False

    def answer(self) -> Answer:
        """Return the complete answer."""
        head = self._head
        return Answer(head.status, head.reason, head.headers, bytes(self._body), self._withheld)


def withheld(token: str | None, given: str, asked: str, landed: str) -> str:
    """Return an explanation for the user if a token was not sent along a redirect; empty if it was.

    Parameters
    ----------
    token : str or None
        Token for the server at `given`.
    given, asked, landed : str
        The URL that the user gave, the one of the request, and the one that answered.
    """
    if token is None or addresses.same_origin(given, landed):
        return ""
    return (
        f"; the token was not sent to {addresses.origin(landed)}, to which {addresses.origin(given)} redirects: "
        f"if it is meant for both, use {addresses.counterpart(given, asked, landed)}"
    )


def parse(data: bytes) -> Mapping[str, Any]:
    """Parse bytes that must be one JSON object.

    Raises
    ------
    ValueError
        If they are not, or contain numbers that are not finite, or are nested too deeply.
    """
    try:
        document = json.loads(data, parse_float=_finite, parse_constant=_finite)
    except RecursionError:
        raise ValueError("lists and objects nested too deeply") from None
    if not isinstance(document, dict):
        raise ValueError("not an object")
    within: list[Any] = [document]
    for _ in range(_DEEPEST):
        within = [
            item
            for holder in within
            for item in (holder.values() if isinstance(holder, dict) else holder)
            if isinstance(item, dict | list)
        ]
        if not within:
            return document
    raise ValueError("lists and objects nested too deeply")


def _finite(text: str) -> float:
    number = float(text)
    if not math.isfinite(number):
        raise ValueError(text)
    return number


def check_figures(document: Mapping[str, Any], url: str) -> None:
    """Refuse a description of a surface whose figures have wrong types; any of them may be missing.

    Raises
    ------
    RemoteProtocolError
    """
    for name, fits in _FIGURES.items():
        value = document.get(name)
        if value is not None and not fits(value):
            raise RemoteProtocolError(f"expected the description of a surface from {url}, got {name} {value!a:.80}")


def _is_count(value: Any) -> bool:
    return isinstance(value, int) and not isinstance(value, bool) and 0 <= value < _LARGEST_NUMBER


def _is_number(value: Any) -> bool:
    return _is_count(value) or isinstance(value, float)


def _is_text(value: Any) -> bool:
    return isinstance(value, str)


def _is_flag(value: Any) -> bool:
    return isinstance(value, bool)


def _list_of(fits: Callable[[Any], bool], length: int | None = None) -> Callable[[Any], bool]:
    def check(value: Any) -> bool:
        return isinstance(value, list) and (length is None or len(value) == length) and all(map(fits, value))

    return check


def _map_of(needed: Mapping[str, Callable[[Any], bool]], **others: Callable[[Any], bool]) -> Callable[[Any], bool]:
    def check(value: Any) -> bool:
        return (
            isinstance(value, dict)
            and all(fits(value.get(name)) for name, fits in needed.items())
            and all(value.get(name) is None or fits(value[name]) for name, fits in others.items())
        )

    return check


_PAIR = _list_of(_is_count, 2)
_STATE = _map_of({"bytes": _is_count, "level": _is_count}, shape=_PAIR, rms=_is_number, max=_is_number)

_FIGURES: Mapping[str, Callable[[Any], bool]] = {
    "name": _is_text,
    "reason": _is_text,
    "dtype": _is_text,
    "progress": _is_number,
    "bytes": _is_count,
    "holes": _is_count,
    "non_finite": _is_count,
    "shape": _PAIR,
    "closed": _list_of(_is_flag, 2),
    "blocks": _list_of(_map_of({"shape": _PAIR, "closed": _list_of(_is_flag, 2)})),
    "attributes": _list_of(_is_text),
    "levels": _list_of(_STATE),
    "layers": _list_of(_STATE),
    "metadata": _map_of({}),  # whose values are whatever somebody has put there
}
