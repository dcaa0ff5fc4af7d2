"""Answers of processes that read untrusted files: JSON of bounded length, and reasons cut to one printable line."""

from __future__ import annotations

import json
import signal
import traceback
from collections.abc import Callable
from dataclasses import dataclass
from textwrap import indent
from typing import Any, get_type_hints

from pydantic import TypeAdapter, ValidationError
from pydantic_core import to_json

from lodestream.errors import (
    FormatError,
    InputError,
    LodestreamError,
    OptionError,
    StreamError,
    TooLargeError,
    UnavailableError,
)

__all__ = [
    "LONGEST_ANSWER",
    "FileTooLongError",
    "ProcessDiedError",
    "Refusal",
    "UnforeseenError",
    "WrongAnswerError",
    "answer_of",
    "reason_of",
    "result_of",
]

LONGEST_ANSWER = 256 << 10
_LONGEST_KIND = 100
_LONGEST_REASON = 2000
_TRACEBACK = 20_000


class ProcessDiedError(LodestreamError):
    """The process ended before the call did.

    Attributes
    ----------
    exitcode : int or None
        Its exit code; negative for the signal that ended it.
    """

    def __init__(self, exitcode: int | None) -> None:
        name = ""
        if exitcode is not None and exitcode < 0:
            name = f", {signal.Signals(-exitcode).name}" if -exitcode in set(signal.Signals) else ""
        code = "" if exitcode is None else f" (exit code {exitcode}{name})"
        super().__init__(f"the process ended before it was done{code}")
        self.exitcode = exitcode


class WrongAnswerError(ProcessDiedError):
    """The process gave an invalid answer, or did not make what it claims."""

    def __init__(self, words: str) -> None:
        super().__init__(0)
        self.args = (f"the process gave an invalid answer: {words}",)


class UnforeseenError(LodestreamError):
    """The function raised an exception.

    Attributes
    ----------
    kind : str
        Name of the exception's class.
    errno : int or None
        Error number of an OSError.
    traceback : str
        As the process reports it, with a bar before each line.
    """

    def __init__(self, kind: str, errno: int | None, traceback: str) -> None:
        super().__init__(f"the function raised {kind}")
        self.kind = kind
        self.errno = errno
        self.traceback = traceback


class FileTooLongError(TooLargeError):
    """The file of a level became longer than allowed."""


# What an error is told as: the first class that fits.
_KINDS: tuple[type[LodestreamError], ...] = (
    FileTooLongError,
    TooLargeError,
    OptionError,
    FormatError,
    InputError,
    UnavailableError,
    StreamError,
    LodestreamError,
)


@dataclass(frozen=True)
class Refusal:
    """A level or a tile was not made.

    Attributes
    ----------
    kind : str
        Name of the exception class that was raised, or of a base of it.
    reason : str
        One line.
    """

    kind: str
    reason: str

    @classmethod
    def of(cls, error: LodestreamError) -> Refusal:
        """Return what is told of an error."""
        return cls(next(kind.__name__ for kind in _KINDS if isinstance(error, kind)), str(error))

    def error(self) -> LodestreamError:
        """Return the exception, limited to known classes: the process is not trusted."""
        kind = next((kind for kind in _KINDS if kind.__name__ == self.kind), LodestreamError)
        return kind(reason_of(self.reason))


def answer_of(call: Callable[[], Any]) -> bytes:
    """Make a call, and return its result or exception as JSON, for `result_of`."""
    # Not every exception survives the way between processes: its name and its text do.
    try:
        return to_json({"returned": call()})
    except MemoryError as error:
        return json.dumps({"memory": str(error)[:1000]}).encode()
    except Exception as error:
        number = getattr(error, "errno", None)
        raised = {
            "kind": type(error).__name__,
            "errno": number if isinstance(number, int) else None,
            "traceback": traceback.format_exc()[-_TRACEBACK:],
        }
        return json.dumps({"raised": raised}).encode()


def result_of(function: Callable[..., Any], answer: bytes) -> Any:
    """Return the result of a function, or raise its exception, as its process reports it.

    Parameters
    ----------
    function : callable
        Its annotation says of which type the value must be.
    answer : bytes
        JSON: ``returned``, ``memory`` or ``raised``.

    Raises
    ------
    WrongAnswerError
        If that is not JSON, or not of the function's type.
    MemoryError
        If the function ran out of memory.
    UnforeseenError
        If the function raised anything else.
    """
    try:
        message = json.loads(answer)
    except (ValueError, RecursionError):
        raise WrongAnswerError("expected JSON") from None
    match message:
        case {"returned": value}:
            kind = get_type_hints(function).get("return", Any)
            try:
                return TypeAdapter(kind).validate_python(value)
            except (ValidationError, RecursionError):
                raise WrongAnswerError(f"expected what {function.__name__} returns") from None
        case {"memory": str(words)}:
            raise MemoryError(words)
        case {"raised": {"kind": str(kind), "errno": int() | None as number, "traceback": str(text)}} if (
            kind.isidentifier() and len(kind) <= _LONGEST_KIND
        ):
            raise UnforeseenError(kind, number, indent(_printable(text), "| ", lambda line: True))
    raise WrongAnswerError("expected what was returned or raised")


def _printable(text: str) -> str:
    return "".join(character if character.isprintable() or character == "\n" else "?" for character in text)


def reason_of(text: str) -> str:
    """Return a reason given by a process, as one printable line of limited length."""
    words = " ".join("".join(character if character.isprintable() else " " for character in text).split(" "))
    return words if len(words) <= _LONGEST_REASON else words[: _LONGEST_REASON - 3] + "..."
