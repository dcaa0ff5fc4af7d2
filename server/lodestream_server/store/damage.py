"""The log message about a container that turns out to be damaged when it is read."""

from __future__ import annotations

import logging

from lodestream.errors import StreamError

from ..operation.logs import event
from . import layout
from .surfaces import Surfaces

__all__ = ["tell"]

_log = logging.getLogger(__name__)

_MOST_NAMES = 5


def tell(surfaces: Surfaces, sha256: str, error: StreamError) -> None:
    """Log that a container is damaged, which surfaces have it, and what to do.

    ``lodestream_errors_total`` counts each of them as ``damaged`` when the request is answered.

    Parameters
    ----------
    surfaces : Surfaces
    sha256 : str
        Name of the container.
    error : StreamError
        What is wrong; a field of the log record.
    """
    count = surfaces.index.count_container(sha256)
    named = ", ".join(surfaces.index.with_container(sha256, _MOST_NAMES)) or "none"
    more = f" and {count - _MOST_NAMES} more" if count > _MOST_NAMES else ""
    event(
        _log,
        f"{layout.container_key(sha256)}, the container of surface {named}{more}, is damaged: stop the server and run "
        f"lodestream fsck --repair {surfaces.store.describe()}; the next start builds it again from its upload",
        logging.ERROR,
        problem=str(error),
    )
