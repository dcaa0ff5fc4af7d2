"""Ctrl-C while a program starts, when there is nothing yet that would have to be ended in order.

Imported before everything else, hence itself without an import that takes time: until then Ctrl-C prints a traceback.
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
    """Let SIGINT end the process within a ``with`` block, without a word, unless it is ignored or somebody else has it.

    An import that is interrupted by an exception may make another one of it, or print it.
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
