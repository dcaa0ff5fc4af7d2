"""Ctrl-C while a program starts and has nothing to clean up yet.

This module is imported before all others and imports nothing slow: until then Ctrl-C prints a traceback.
"""

from __future__ import annotations

import os

TYPE_CHECKING = False  # `typing` takes longer than all of this
if TYPE_CHECKING:
    import signal as _signal
    from types import FrameType
else:
    import _signal  # without the names that `signal` makes of its numbers

__all__ = ["INTERRUPTED", "EndingAtOnce"]

#: The exit code after Ctrl-C, as a shell has it.
INTERRUPTED = 130


class EndingAtOnce:
    """End the process silently on SIGINT within a ``with`` block, unless SIGINT is ignored or handled by other code.

    An import that is interrupted by an exception may turn it into another one, or print it.
    """

    def __enter__(self) -> None:
        self._set = _signal.getsignal(_signal.SIGINT) is _signal.default_int_handler
        try:
            if self._set:
                _signal.signal(_signal.SIGINT, _end)
        except ValueError:  # not in the main thread, where signals never arrive anyway
            self._set = False

    def __exit__(self, *error: object) -> None:
        if self._set:
            _signal.signal(_signal.SIGINT, _signal.default_int_handler)


def _end(number: int, frame: FrameType | None) -> None:
    os._exit(INTERRUPTED)
