"""How a command ends when it is interrupted: by Ctrl-C, which sends SIGINT, or by SIGTERM."""

from __future__ import annotations

import signal
from collections.abc import Iterator
from contextlib import contextmanager
from types import FrameType

from .output import note

__all__ = ["Terminated", "exit_code", "interruptible", "raising", "unwrapping"]


class Terminated(KeyboardInterrupt):
    """SIGTERM came: the program is to end, as after Ctrl-C."""


def exit_code(interrupt: KeyboardInterrupt) -> int:
    """128 and the number of the signal, as a shell has it: 130 after SIGINT, 143 after SIGTERM."""
    return 128 + (signal.SIGTERM if isinstance(interrupt, Terminated) else signal.SIGINT)


@contextmanager
def raising() -> Iterator[None]:
    """Let SIGTERM raise `Terminated` within the block: without unwinding, temporary files and processes would stay."""

    def leave(number: int, frame: FrameType | None) -> None:
        raise Terminated("terminated")

    try:
        previous = signal.signal(signal.SIGTERM, leave)
    except ValueError:  # not in the main thread, where signals never arrive anyway
        yield
        return
    try:
        yield
    finally:
        signal.signal(signal.SIGTERM, previous)


@contextmanager
def unwrapping() -> Iterator[None]:
    """Raise an interrupt as such where something on its way has made another error of it, as a class body does."""
    try:
        yield
    except Exception as error:
        cause = error.__cause__
        while cause is not None and not isinstance(cause, KeyboardInterrupt):
            cause = cause.__cause__
        if cause is None:
            raise
        raise cause from None


@contextmanager
def interruptible() -> Iterator[None]:
    """Let SIGTERM end the block as SIGINT does, with a line that says so."""
    with raising():
        try:
            with unwrapping():
                yield
        except KeyboardInterrupt as interrupt:
            note(str(interrupt) or "interrupted")
            raise
