"""The log message about a container that turns out to be damaged when it is read."""

from __future__ import annotations

import logging

from lodestream.errors import StreamError

from ..operation.logs import event
from .storage import Storage

__all__ = ["tell"]

_log = logging.getLogger(__name__)

_MOST_NAMES = 5


def tell(storage: Storage, sha256: str, error: StreamError) -> None:
    """Log that a container is damaged, which surfaces have it, and what to do; repetitions are counted (`repeats`).

    ``lodestream_errors_total`` counts each of them as ``damaged`` when the request is answered.

    Parameters
    ----------
    storage : Storage
    sha256 : str
        Name of the container.
    error : StreamError
        What is wrong. It is a field of the log record and not part of the line, because it may differ from time to
        time.
    """
    surfaces = storage.surfaces_of(sha256)
    named = ", ".join(surfaces[:_MOST_NAMES]) or "none"
    more = f" and {len(surfaces) - _MOST_NAMES} more" if len(surfaces) > _MOST_NAMES else ""
    event(
        _log,
        f"{storage.place_of(sha256)}, the container of surface {named}{more}, is damaged: stop the server and run "
        f"lodestream fsck --repair {storage.root}, which builds it again from its upload",
        logging.ERROR,
        problem=str(error),
    )
