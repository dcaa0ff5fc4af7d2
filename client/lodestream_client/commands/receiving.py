"""Progress and metadata of `pull` while it receives."""

from __future__ import annotations

import time
from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

from lodestream.errors import LodestreamError, NotFoundError

from ..terminal.output import note, progress_bar

if TYPE_CHECKING:
    from lodestream.planning.byte_ranges import RangeSet
    from lodestream.target import Target

    from ..client import Client
    from ..stream.blocking_stream import Stream
    from .keeping import Kept

__all__ = ["Metadata", "Progress"]

# Seconds for what is fetched after an interruption: somebody waits for the end, or the server is gone.
_HURRY = 3.0


class Progress:
    """A progress bar that is updated with every message, and estimates the time left."""

    def __init__(self, target: Target) -> None:
        self.figures = ""
        self._bar = progress_bar()
        self._seconds = target.seconds

    def __enter__(self) -> Progress:
        self._shown = self._bar.__enter__()
        self._started = time.monotonic()
        self._task = self._shown.add_task("pulling", total=None, figures="", limit=self._seconds)
        return self

    def __exit__(self, *raised: Any) -> None:
        self._bar.__exit__(*raised)

    def received(self, received: int, planned: int | None) -> None:
        """Set the bytes received and the bytes planned."""
        self._shown.update(self._task, total=planned, completed=received, figures=self.figures)


class Metadata:
    """The metadata of a stream's surface, which stand at the end of a container: call it to get them.

    They are fetched, at most once, if the stream has not brought them: after a stop of our own, which takes effect at
    once, and for what is written before the end.

    Parameters
    ----------
    stream : Stream
    kept : Kept
        Has them perhaps, or keeps them.
    client : Client
        Of the server.
    arrived : RangeSet
        Bytes of the container that have come; those fetched are added.

    Attributes
    ----------
    bytes : int
        Bytes that were fetched.
    hurried : bool
        Whether somebody waits for the end, or the server is gone.
    """

    def __init__(self, stream: Stream, kept: Kept, client: Client, arrived: RangeSet) -> None:
        self.bytes = 0
        self.hurried = False
        self._stream = stream
        self._kept = kept
        self._client = client
        self._arrived = arrived
        self._values: Mapping[str, Any] | None = None

    def __call__(self) -> Mapping[str, Any]:
        """Return the metadata; an empty mapping while the stream goes on and their place is unknown.

        Raises
        ------
        NotFoundError
            If the surface is gone.
        CorruptStreamError
            If they are damaged.
        """
        if self._stream.decoder.metadata is not None:
            return self._stream.decoder.metadata
        if self._values is None and (self._stream.metadata_place is not None or self._stream.ended is not None):
            self._values = self._fetched()
        return self._values or {}

    def _fetched(self) -> Mapping[str, Any]:
        from lodestream.container import ByteRange, read_metadata

        from ..requests.calls import TIMEOUT

        place = self._stream.metadata_place
        if place is None:  # over HTTP layers may come before it is known
            note("written without metadata such as name and position, which have not arrived")
            return {}
        if (data := self._kept.read(*place)) is not None:
            return read_metadata(data, ByteRange(*place))
        timeout = _HURRY if self.hurried else TIMEOUT
        try:
            data = self._client.fetch_range(self._stream.url, *place, timeout=timeout)
        except LodestreamError as error:
            if isinstance(error, NotFoundError) and not self.hurried:
                raise
            note(f"written without metadata such as name and position, which could not be fetched: {error}")
            return {}
        self.bytes = len(data)
        self._arrived.add(place[0], len(data))
        self._kept.write(place[0], data)
        return read_metadata(data, ByteRange(*place))
