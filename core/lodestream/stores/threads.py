"""Threads for requests to buckets: the end of the program does not wait for them."""

from __future__ import annotations

import threading
from collections import deque
from collections.abc import Callable
from concurrent.futures import Executor, Future
from typing import Any, TypeVar

__all__ = ["Threads"]

_T = TypeVar("_T")


class Threads(Executor):
    """A few threads that carry out calls, and end when there is nothing to do.

    Those of `concurrent.futures` are waited for when the program ends: after Ctrl-C as long as a request may take.

    Parameters
    ----------
    most : int
        How many there are at once.
    """

    def __init__(self, most: int) -> None:
        self._most = most
        self._lock = threading.Lock()
        self._waiting: deque[Callable[[], None]] = deque()
        self._running = 0

    def submit(self, call: Callable[..., _T], /, *arguments: Any, **options: Any) -> Future[_T]:
        """Carry out a call in one of the threads.

        Raises
        ------
        RuntimeError
            If the program ends.
        """
        answer: Future[_T] = Future()

        def carry_out() -> None:
            if answer.set_running_or_notify_cancel():
                try:
                    answer.set_result(call(*arguments, **options))
                except BaseException as error:
                    answer.set_exception(error)

        with self._lock:
            self._waiting.append(carry_out)
            if self._running < self._most:
                try:
                    threading.Thread(target=self._work, name="lodestream-store", daemon=True).start()
                except RuntimeError:
                    self._waiting.pop()
                    raise
                self._running += 1
        return answer

    def _work(self) -> None:
        while True:
            with self._lock:
                if not self._waiting:
                    self._running -= 1
                    return
                carry_out = self._waiting.popleft()
            carry_out()
            del carry_out  # or the answer lives as long as the wait for the next call
