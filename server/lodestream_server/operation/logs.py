"""The log: text or JSON lines with fields, each with the id of the request that it belongs to."""

from __future__ import annotations

import asyncio
import json
import logging
import os
import re
import secrets
import select
import threading
from contextlib import suppress
from contextvars import ContextVar
from datetime import UTC, datetime
from logging.handlers import QueueHandler, QueueListener
from queue import SimpleQueue
from typing import Any

__all__ = ["configure", "drain", "event", "new_request"]

_FIELDS = "lodestream_fields"
_STANDARD_ERROR = 2
_MOST_LINES = 10_000
_DRAIN_SECONDS = 1.0

# What uvicorn says of what strangers send, which could fill a disk: refusals are in order, and are told and counted
# elsewhere.
_UNWORTHY = {
    "ASGI callable returned without completing handshake.",
    "Invalid HTTP request received.",
    "Invalid UTF-8 sequence received from client.",
    "Unsupported upgrade request.",
}

# asyncio says it for each connection that waits, thousands of times a second while there are no more files.
_NO_FILES = "socket.accept() out of system resource"
_NO_FILES_SECONDS = 60.0

_request: ContextVar[str | None] = ContextVar("lodestream_request", default=None)
_USABLE_ID = re.compile(r"[A-Za-z0-9._-]{1,64}", re.ASCII)
_PLAIN = re.compile(r"[A-Za-z0-9._:/@+*,;<>()\[\]-]+", re.ASCII)


def configure(style: str, level: str) -> None:
    """Write the log to standard error, without waiting for its reader.

    Parameters
    ----------
    style : "text" or "json"
    level : str
        Least severe messages of this server that are logged; libraries are logged from ``warning`` on.
    """
    handler = _Queue()
    handler.setFormatter(_Json() if style == "json" else _Text())
    handler.addFilter(_Worth())
    root = logging.getLogger()
    root.handlers = [handler]
    root.setLevel(logging.WARNING)
    logging.getLogger("lodestream_server").setLevel(level.upper())


def drain() -> None:
    """End the log of `configure`, if there is one: wait up to a second until it has been written."""
    root = logging.getLogger()
    for handler in [each for each in root.handlers if isinstance(each, _Queue)]:
        root.removeHandler(handler)
        handler.end()


def event(log: logging.Logger, words: str, level: int = logging.INFO, **fields: Any) -> None:
    """Log an event with its fields."""
    log.log(level, words, extra={_FIELDS: fields})


def new_request(offered: str | None) -> str:
    """Begin a request; return its id, which is the one from the client or a proxy if that is usable."""
    name = offered if offered is not None and _USABLE_ID.fullmatch(offered) else secrets.token_hex(8)
    _request.set(name)
    return name


class _Worth(logging.Filter):
    """Passes what is worth a line."""

    _next = 0.0

    def filter(self, record: logging.LogRecord) -> bool:
        """Return whether a record is logged."""
        # A request that the end of the server has cut short is no failure.
        if record.exc_info and isinstance(record.exc_info[1], asyncio.CancelledError):
            return False
        if str(record.msg).startswith(_NO_FILES):
            if record.created < self._next:
                return False
            self._next = record.created + _NO_FILES_SECONDS
        return str(record.msg) not in _UNWORTHY


def _fields(record: logging.LogRecord) -> dict[str, Any]:
    fields = dict(getattr(record, _FIELDS, {}))
    if (name := _request.get()) is not None:
        fields["request"] = name
    return fields


class _Queue(QueueHandler):
    """Format records where they are logged, which knows the request, and leave the writing to a thread.

    A terminal that is held, or a pipe that nobody reads, stops nobody: records that the queue has no room for are
    dropped and counted, and a later line says how many.
    """

    def __init__(self, descriptor: int = _STANDARD_ERROR) -> None:
        self._lines: SimpleQueue[logging.LogRecord] = SimpleQueue()
        super().__init__(self._lines)
        self._lost = 0
        self._writer = _Writer(self._lines, descriptor)
        self._writer.start()

    def enqueue(self, record: logging.LogRecord) -> None:
        """Put a formatted record into the queue, if there is room; the handler is locked meanwhile."""
        if self._lines.qsize() >= _MOST_LINES:
            self._lost += 1
            return
        self._tell_lost()
        self._lines.put(record)

    def _tell_lost(self) -> None:
        if self._lost:
            words, self._lost = f"{self._lost} log lines were dropped, because the reader of the log was too slow", 0
            told = {"name": __name__, "levelno": logging.WARNING, "levelname": "WARNING", "msg": words}
            self._lines.put(self.prepare(logging.makeLogRecord(told)))

    def end(self) -> None:
        """Stop the thread once it has written what is in the queue; wait for that only so long."""
        self._tell_lost()
        stopping = threading.Thread(target=self._writer.stop, daemon=True)
        stopping.start()
        stopping.join(_DRAIN_SECONDS)


class _Writer(QueueListener):
    """Writes lines to a descriptor.

    Not by a handler over Python's own stream: while a write hangs, both would hold locks that the end of the process
    waits for.
    """

    def __init__(self, lines: SimpleQueue[logging.LogRecord], descriptor: int) -> None:
        super().__init__(lines)
        self._descriptor = descriptor

    def handle(self, record: logging.LogRecord) -> None:
        """Write a line; where it cannot be written, nobody could be told."""
        data = f"{record.getMessage()}\n".encode("utf-8", "backslashreplace")
        with suppress(OSError):
            while data:
                try:
                    data = data[os.write(self._descriptor, data) :]
                except BlockingIOError:  # whoever shares a terminal or a pipe may have set that for all
                    select.select((), (self._descriptor,), ())


class _Text(logging.Formatter):
    def __init__(self) -> None:
        super().__init__("%(asctime)s %(levelname)s %(name)s: %(message)s")

    def formatMessage(self, record: logging.LogRecord) -> str:  # noqa: N802 - the library's name
        pairs = "".join(f" {key}={_value(value)}" for key, value in _fields(record).items() if value is not None)
        return _line(super().formatMessage(record)) + pairs

    def formatException(self, ei: Any) -> str:  # noqa: N802 - the library's name
        # Indented, so that nothing in it looks like a line of its own.
        return "\n".join(f"    {_line(line)}" for line in super().formatException(ei).splitlines())


class _Json(logging.Formatter):
    def format(self, record: logging.LogRecord) -> str:
        document = {
            "time": datetime.fromtimestamp(record.created, UTC).isoformat(timespec="milliseconds"),
            "level": record.levelname.lower(),
            "logger": record.name,
            "message": record.getMessage(),
            **_fields(record),
        }
        if record.exc_info:
            document["error"] = self.formatException(record.exc_info)
        return json.dumps(document, default=str)


def _value(value: Any) -> str:
    text = f"{value:.6g}" if isinstance(value, float) else str(value)
    return text if _PLAIN.fullmatch(text) else json.dumps(text)


def _line(text: str) -> str:
    # What a stranger sent must not be able to begin a line of its own, or to move a terminal's cursor.
    return "".join(character if character.isprintable() else ascii(character)[1:-1] for character in text)
