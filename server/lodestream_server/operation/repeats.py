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
class _Told:
    at: float
    more: int = 0


class Repeats:
    """Counts repeated log records. Times are seconds of any clock."""

    def __init__(self) -> None:
        self._told: dict[_Key, _Told] = {}

    def admit(self, record: logging.LogRecord, now: float) -> bool:
        """Whether to log a record; warnings and errors that were logged less than a minute ago are counted instead."""
        if record.levelno < logging.WARNING:
            return True
        key = _key(record)
        told = self._told.get(key)
        if told is not None:
            told.more += 1
        elif len(self._told) < _MOST:
            self._told[key] = _Told(now)
        return told is None

    def due(self, now: float) -> list[logging.LogRecord]:
        """A line for each record that was counted for a minute; records that did not repeat are forgotten."""
        lines = []
        for key, told in list(self._told.items()):
            if now - told.at >= SECONDS:
                if told.more:
                    lines.append(_line(key, told))
                    self._told[key] = _Told(now)
                else:
                    del self._told[key]
        return lines

    def all(self) -> list[logging.LogRecord]:
        """A line for each record that was counted; for use when the server ends."""
        lines = [_line(key, told) for key, told in self._told.items() if told.more]
        self._told.clear()
        return lines


def _key(record: logging.LogRecord) -> _Key:
    error = record.exc_info[1] if record.exc_info else None
    return record.name, record.levelno, record.getMessage(), "" if error is None else f"{type(error).__name__}: {error}"


def _line(key: _Key, told: _Told) -> logging.LogRecord:
    name, level, message, error = key
    first = " ".join(filter(None, (message.partition("\n")[0], error)))
    times = "once more" if told.more == 1 else f"{told.more} times more"
    return logging.LogRecord(name, level, "", 0, "%s (%s)", (first, times), None)
