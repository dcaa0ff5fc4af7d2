"""End a command when it is interrupted: by Ctrl-C, which sends SIGINT, or by SIGTERM."""

from __future__ import annotations

import signal
from collections.abc import Iterator
from contextlib import contextmanager
from types import FrameType

from .output import complain

__all__ = ["Terminated", "exit_code", "interruptible", "raising", "unwrapping"]


class Terminated(KeyboardInterrupt):
    """SIGTERM was received: the program must end, as after Ctrl-C."""


def exit_code(interrupt: KeyboardInterrupt) -> int:
    """Return 128 plus the number of the signal, as shells do: 130 after SIGINT, 143 after SIGTERM."""
    return 128 + (signal.SIGTERM if isinstance(interrupt, Terminated) else signal.SIGINT)


@contextmanager
def raising() -> Iterator[None]:
    """Have SIGTERM end the block, so that temporary files and processes are cleaned up.

    Raises
    ------
    Terminated
        On SIGTERM.
    """

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
    """Raise a KeyboardInterrupt again that was turned into another exception, as class bodies do.

    Raises
    ------
    KeyboardInterrupt
        The one that was turned into another exception.
    """
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
    """End the block on SIGTERM as on SIGINT, with a line that says so."""
    with raising():
        try:
            with unwrapping():
                yield
        except KeyboardInterrupt as interrupt:
            complain(str(interrupt) or "interrupted")
            raise
