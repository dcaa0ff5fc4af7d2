"""Repeated warnings and errors: logged once, then counted, so that they do not fill a disk."""

from __future__ import annotations

import logging
from dataclasses import dataclass

__all__ = ["SECONDS", "Repeats"]

#: How often one and the same failure is told.
SECONDS = 60.0

# More different ones at a time are told as they come.
_MOST = 1000

_Key = tuple[str, int, str, str]


@dataclass
class _Repeated:
    at: float
    more: int = 0


class Repeats:
    """Counts repeated log records. Times are seconds of any clock."""

    def __init__(self) -> None:
        self._repeated: dict[_Key, _Repeated] = {}

    def admit(self, record: logging.LogRecord, now: float) -> bool:
        """Return whether to log a record; warnings and errors logged less than a minute ago are counted instead."""
        if record.levelno < logging.WARNING:
            return True
        key = _key(record)
        entry = self._repeated.get(key)
        if entry is not None:
            entry.more += 1
        elif len(self._repeated) < _MOST:
            self._repeated[key] = _Repeated(now)
        return entry is None

    def due(self, now: float) -> list[logging.LogRecord]:
        """Return a line for each record that was counted for a minute, and drop records that did not repeat."""
        lines = []
        for key, entry in list(self._repeated.items()):
            if now - entry.at >= SECONDS:
                if entry.more:
                    lines.append(_line(key, entry))
                    self._repeated[key] = _Repeated(now)
                else:
                    del self._repeated[key]
        return lines

    def all(self) -> list[logging.LogRecord]:
        """Return a line for each record that was counted; for use when the server ends."""
        lines = [_line(key, entry) for key, entry in self._repeated.items() if entry.more]
        self._repeated.clear()
        return lines


def _key(record: logging.LogRecord) -> _Key:
    error = record.exc_info[1] if record.exc_info else None
    return record.name, record.levelno, record.getMessage(), "" if error is None else f"{type(error).__name__}: {error}"


def _line(key: _Key, entry: _Repeated) -> logging.LogRecord:
    name, level, message, error = key
    first = " ".join(filter(None, (message.partition("\n")[0], error)))
    times = "once more" if entry.more == 1 else f"{entry.more} times more"
    return logging.LogRecord(name, level, "", 0, "%s (%s)", (first, times), None)
