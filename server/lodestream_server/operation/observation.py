"""Id, log line and metrics of every request, and an answer to those that the server's end interrupts."""

from __future__ import annotations

import asyncio
import logging
import time

from fastapi.requests import HTTPConnection
from starlette.datastructures import Headers, MutableHeaders
from starlette.types import ASGIApp, Message, Receive, Scope, Send

from ..problems import RestartingError, answer
from .logs import event, new_request
from .metrics import Metrics

__all__ = ["Observation"]

_log = logging.getLogger(__name__)

_READING = {"GET", "HEAD", "OPTIONS"}
_METHODS = {"DELETE", "GET", "HEAD", "OPTIONS", "PATCH", "POST", "PUT"}


class Observation:
    """The outermost ASGI middleware.

    Parameters
    ----------
    app : ASGI application
    metrics : Metrics
    log_reads : bool
        Whether requests that read are logged at ``info``, like those that write.
    """

    def __init__(self, app: ASGIApp, metrics: Metrics, *, log_reads: bool) -> None:
        self._app = app
        self._metrics = metrics
        self._log_reads = log_reads

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Pass a request on, and record it; when it is cancelled before it is answered, answer 503."""
        if scope["type"] not in ("http", "websocket"):
            await self._app(scope, receive, send)
            return
        name = new_request(Headers(scope=scope).get("x-request-id"))
        started = time.monotonic()
        status = 0

        async def named(message: Message) -> None:
            nonlocal status
            if message["type"] in ("http.response.start", "websocket.accept", "websocket.http.response.start"):
                status = message.get("status", 101)
                message.setdefault("headers", [])
                MutableHeaders(scope=message).append("x-request-id", name)
            await send(message)

        try:
            await self._app(scope, receive, named)
        except asyncio.CancelledError:
            # A server that ends waits for requests only so long, and uvicorn would answer 500 to the others.
            if status or scope["type"] != "http" or not _is_cancelled():
                raise
            ended = RestartingError("the server ended before it could answer; ask again")
            await answer(HTTPConnection(scope), ended)(scope, receive, named)
        finally:
            # The log of a stream tells more than that its handshake was accepted.
            if status != 101:
                self._write(scope, status, time.monotonic() - started)

    def _write(self, scope: Scope, status: int, seconds: float) -> None:
        # What strangers may choose, paths and methods, must not make a figure each.
        route = getattr(scope.get("route"), "path", "none")
        method = scope.get("method", "WEBSOCKET")
        self._metrics.answered(method if method in _METHODS | {"WEBSOCKET"} else "other", route, status, seconds)
        client = scope.get("client")
        event(
            _log,
            "request",
            # Who reads much would otherwise write much.
            logging.INFO if self._log_reads or method not in _READING or status >= 500 else logging.DEBUG,
            method=method[:20],
            path=scope["path"][:200],
            status=status,
            seconds=seconds,
            client=client[0] if client else None,
        )


def _is_cancelled() -> bool:
    """Return whether this task itself is cancelled, not only something that it awaited."""
    task = asyncio.current_task()
    return task is not None and task.cancelling() > 0
