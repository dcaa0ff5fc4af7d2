"""The log: text or JSON lines with fields, each with the id of the request that it belongs to."""

from __future__ import annotations

import asyncio
import json
import logging
import os
import queue
import re
import secrets
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from contextvars import ContextVar
from datetime import UTC, datetime
from typing import Any

from .repeats import Repeats

__all__ = ["configure", "drain", "event", "new_request", "request_id"]

_FIELDS = "lodestream_fields"
_STANDARD_ERROR = 2
_MOST_LINES = 10_000
_DRAIN_SECONDS = 1.0
_LOOK_SECONDS = 1.0

# What uvicorn says of what strangers send, which could fill a disk: refusals are in order, and are told and counted
# elsewhere.
_UNWORTHY = {
    "ASGI callable returned without completing handshake.",
    "Invalid HTTP request received.",
    "Invalid UTF-8 sequence received from client.",
    "Unsupported upgrade request.",
}

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
    handler = _Patient()
    handler.setFormatter(_Json() if style == "json" else _Text())
    handler.addFilter(_is_worth_a_line)
    root = logging.getLogger()
    root.handlers = [handler]
    root.setLevel(logging.WARNING)
    logging.getLogger("lodestream_server").setLevel(level.upper())


def drain() -> None:
    """Wait up to a second until the log has been written."""
    for handler in logging.getLogger().handlers:
        handler.flush()


def event(log: logging.Logger, words: str, level: int = logging.INFO, **fields: Any) -> None:
    """Log an event with its fields."""
    log.log(level, words, extra={_FIELDS: fields})


def new_request(offered: str | None) -> str:
    """Begin a request; return its id, which is the one from the client or a proxy if that is usable."""
    name = offered if offered is not None and _USABLE_ID.fullmatch(offered) else secrets.token_hex(8)
    _request.set(name)
    return name


def request_id() -> str | None:
    """Return the id of the current request."""
    return _request.get()


def _is_worth_a_line(record: logging.LogRecord) -> bool:
    # A request that the end of the server has cut short is no failure.
    if record.exc_info and isinstance(record.exc_info[1], asyncio.CancelledError):
        return False
    return record.msg not in _UNWORTHY


def _fields(record: logging.LogRecord) -> dict[str, Any]:
    fields = dict(getattr(record, _FIELDS, {}))
    if (name := request_id()) is not None:
        fields["request"] = name
    return fields


class _Patient(logging.Handler):
    """A handler that writes from a thread: a terminal that is held, or a pipe that nobody reads, stops nobody."""

    def __init__(self, descriptor: int = _STANDARD_ERROR) -> None:
        super().__init__()
        self._descriptor = descriptor
        self._lines: queue.Queue[str] = queue.Queue(_MOST_LINES)
        self._lost = 0
        self._repeats = Repeats()
        self._idle = threading.Event()
        threading.Thread(target=self._write, name="lodestream-log", daemon=True).start()

    def emit(self, record: logging.LogRecord) -> None:
        if self._repeats.admit(record, time.monotonic()):
            self._put(record)

    def _put(self, record: logging.LogRecord) -> None:
        self._idle.clear()
        try:
            self._lines.put_nowait(self.format(record))
        except queue.Full:
            self._lost += 1

    def flush(self) -> None:
        with self._exclusive():
            for record in self._repeats.all():
                self._put(record)
        until = time.monotonic() + _DRAIN_SECONDS
        while not (self._lines.empty() and self._idle.is_set()) and time.monotonic() < until:
            self._idle.wait(0.01)

    def _tell_repeats(self) -> None:
        with self._exclusive():
            for record in self._repeats.due(time.monotonic()):
                self._put(record)

    @contextmanager
    def _exclusive(self) -> Iterator[None]:
        self.acquire()
        try:
            yield
        finally:
            self.release()

    def _write(self) -> None:
        look = time.monotonic()
        while True:
            if time.monotonic() >= look:
                look = time.monotonic() + _LOOK_SECONDS
                self._tell_repeats()
            try:
                line = self._lines.get_nowait()
            except queue.Empty:
                self._idle.set()
                try:
                    line = self._lines.get(timeout=_LOOK_SECONDS)
                except queue.Empty:
                    continue
                self._idle.clear()
            if self._lost:
                line, self._lost = (
                    f"{self._lost} log lines were dropped, because the reader of the log was too slow\n{line}",
                    0,
                )
            data = f"{line}\n".encode("utf-8", "backslashreplace")
            try:
                # Not through Python's own stream, whose lock would be held when the process ends.
                while data:
                    data = data[os.write(self._descriptor, data) :]
            except OSError:
                continue


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
