"""Spreading work that can wait over iterations of the event loop.

An iteration of the loop runs every callback that is ready, and a request needs several iterations. If a thousand
connections each have a millisecond of work at the same time, an iteration takes a second. So work that may come in such
numbers is done here, in order of arrival, a few pieces in each iteration. Health checks do not wait: a server that is
busy must not look dead.
"""

from __future__ import annotations

import asyncio
from collections import deque
from collections.abc import Callable
from contextvars import Context, copy_context

from starlette.types import ASGIApp, Receive, Scope, Send

__all__ = ["PIECES_A_TURN", "Pace", "Paced"]

#: A piece takes at most some milliseconds, most take a tenth of one.
PIECES_A_TURN = 8

_PROBES = {"/healthz", "/readyz"}


class Pace:
    """Runs work that can wait; to be used from the event loop only."""

    def __init__(self) -> None:
        self._waiting: deque[tuple[Callable[[], object], Context]] = deque()

    def later(self, work: Callable[[], object]) -> None:
        """Call a function in one of the next iterations.

        Parameters
        ----------
        work : callable
            Takes a few milliseconds at most; its exceptions go to the loop's exception handler.
        """
        if not self._waiting:
            asyncio.get_running_loop().call_soon(self._some, context=Context())
        self._waiting.append((work, copy_context()))

    async def turn(self) -> None:
        """Wait for this task's turn."""
        turn = asyncio.get_running_loop().create_future()

        def begin() -> None:
            if not turn.done():  # nor is the task gone
                turn.set_result(None)

        self.later(begin)
        await turn

    def _some(self) -> None:
        loop = asyncio.get_running_loop()
        for _ in range(min(PIECES_A_TURN, len(self._waiting))):
            work, context = self._waiting.popleft()
            loop.call_soon(work, context=context)
        if self._waiting:
            loop.call_soon(self._some, context=Context())


class Paced:
    """ASGI middleware: requests begin in turn, health checks at once.

    Parameters
    ----------
    app : ASGI application pace : Pace
    """

    def __init__(self, app: ASGIApp, pace: Pace) -> None:
        self._app = app
        self._pace = pace

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Pass a request on in its turn."""
        if scope["type"] in ("http", "websocket"):
            path: str = scope["path"]
            if path.removeprefix(scope.get("root_path", "")) not in _PROBES:
                await self._pace.turn()
        await self._app(scope, receive, send)
