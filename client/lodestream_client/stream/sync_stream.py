"""Streams for programs without an event loop; `lodestream_client.sync` exports the names."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import suppress
from types import TracebackType
from typing import TYPE_CHECKING

from lodestream.errors import LodestreamError
from lodestream.target import Region

from .effects import WAITS, HangUp
from .options import ConnectOptions
from .stream import BaseStream
from .sync_io import SyncIO

if TYPE_CHECKING:
    from lodestream.decoding.decoder import View

__all__ = ["Stream"]


class Stream(BaseStream):
    """A surface being received; iterate over it for a `View` of each layer.

    It is a context manager, made by `connect`. Leaving it stops the stream.

    If the iteration raises an error, for example because the server is gone, the stream ends but keeps what it has:
    earlier views stay usable, `decoder` has all received data (``decoder.view()`` is the last complete layer), and
    `ended` is truncated.

    Examples
    --------
    >>> from lodestream_client import sync
    >>> url = sync.upload("http://127.0.0.1:8000", "terrain.npy").url
    >>> with sync.connect(url, limit_rate=4000) as stream:  # bytes a second
    ...     for view in stream:
    ...         if view.rms < 5:
    ...             stream.stop()
    >>> stream.ended, view.points.shape
    ('stopped', (97, 70))
    """

    def __init__(self, url: str, options: ConnectOptions) -> None:
        super().__init__(url, options)
        self._io = SyncIO(self._session)
        try:
            while not self._core.met and self._step():
                pass
        except BaseException:
            self._abandon()
            raise

    def __iter__(self) -> Iterator[View]:
        return self

    def __next__(self) -> View:
        while (view := self._core.next_view()) is None:
            if not self._step():
                raise StopIteration
        return view

    def __enter__(self) -> Stream:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, traceback: TracebackType | None
    ) -> None:
        if kind is None:
            self.close()
            return
        # After Ctrl-C somebody waits for the end: no time for taking leave of a server that may be silent.
        self._abandon(abort=isinstance(error, KeyboardInterrupt))

    def latest(self) -> Iterator[View]:
        """Iterate over the newest views, for a program that draws more slowly than they arrive.

        Earlier views are left out. The last view of the stream is always among them.
        """
        for view in self:
            newest, failed = view, None
            try:
                while (later := self._core.next_view()) is not None or self._step(wait=False):
                    newest = later or newest
            except LodestreamError as error:
                failed = error
            self._core.shown()
            yield newest
            if failed is not None:
                raise failed

    def stop(self) -> None:
        """Stop the stream at once: no further view is yielded.

        May be called from another thread than the one that iterates.
        """
        self._session.stop()
        self._io.wake.set()
        self._io.send()

    def focus(self, region: Region | None) -> None:
        """Receive the data of a region before the rest. Allowed at any time, any number of times.

        Nothing is sent twice, and the stream ends as it would have. Views then come when a layer is complete in the
        region, and when it is complete everywhere. Their errors are NaN if more data have arrived than belong to the
        layer.

        Parameters
        ----------
        region : ((int, int), (int, int)) or None
            Rows and columns, half-open, in full-resolution indices; None for the target's own order again.

        Raises
        ------
        OptionError
            If the surface has no such region, or several blocks. While the surface is not known yet, the iteration
            raises it.
        """
        self._session.focus(region)
        self._io.send()

    def close(self) -> None:
        """Stop and close the connection, within `close_timeout`."""
        self._session.close()
        self._io.wake.set()
        self._io.send()
        # Whoever closes has what they want; how the other side takes it is no concern of theirs.
        with suppress(LodestreamError):
            while self._step():
                pass
        self._abandon()

    def _abandon(self, *, abort: bool = False) -> None:
        self._session.abandon()
        self._io.close(HangUp(abort=abort))

    def _step(self, *, wait: bool = True) -> bool:
        """Carry out the next effect, optionally only if it needs no waiting; return whether that was done."""
        if (effect := self._core.effect) is None:
            return False
        try:
            result = self._io.perform(effect) if wait else self._io.poll(effect)
            if result is WAITS:
                return False
        except Exception as error:
            self._core.failed(error)
        else:
            self._core.done(result)
        return True
