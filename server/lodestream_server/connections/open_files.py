"""The limit of open files of this process, and the number of connections that it allows."""

from __future__ import annotations

import logging

from lodestream import operating_system

from ..operation.settings import Settings

__all__ = ["most_connections", "raise_file_limit"]

_log = logging.getLogger(__name__)

# Where the settings say nothing and files are no concern.
_MOST = 5000

# A connection, and the file that is sent or received over it.
_FILES_EACH = 2

# The pipe of a process, and what there is beside it while it starts; the one that makes levels counts too.
_FILES_OF_PROCESS = 4

# The log, the lock, sockets that listen, the event loop's own, and what threads open for a moment.
_OTHER_FILES = 40


def raise_file_limit(settings: Settings) -> None:
    """Raise this process's limit of open files to what it may need, or as far as the system allows."""
    wanted = _MOST if settings.max_connections is None else settings.max_connections
    needed = _FILES_EACH * wanted + _others(settings)
    allowed = operating_system.raise_file_limit(needed)
    if allowed < needed:
        _log.warning(
            "%d connections may need %d open files and this process may open %d, enough for %d: raise the limit "
            "(ulimit -n)",
            wanted,
            needed,
            allowed,
            _enough_for(allowed, settings),
        )


def most_connections(settings: Settings) -> int:
    """Return the largest number of connections: that of the settings, or what the limit of open files allows."""
    if settings.max_connections is not None:
        return settings.max_connections
    limit = operating_system.file_limit()
    return _MOST if limit is None else _enough_for(limit, settings)


def _enough_for(files: int, settings: Settings) -> int:
    return min(max((files - _others(settings)) // _FILES_EACH, 1), _MOST)


def _others(settings: Settings) -> int:
    return _OTHER_FILES + _FILES_OF_PROCESS * (settings.workers + 1)
