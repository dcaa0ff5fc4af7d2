"""Streams for programs without an event loop."""

from __future__ import annotations

import weakref
from collections.abc import Callable, Iterator
from contextlib import suppress
from functools import partial
from types import TracebackType
from typing import TYPE_CHECKING, Any

from lodestream.errors import LodestreamError
from lodestream.target import Region

from .. import loop_thread
from .effect_io import EffectIO
from .effects import WAITS, Effect, HangUp, Hear, Read, Send
from .options import ConnectOptions
from .stream import BaseStream

if TYPE_CHECKING:
    import httpx

    from lodestream.decoding.decoder import View

__all__ = ["Stream"]


class Stream(BaseStream):
    """A surface being received; iterate over it for a `View` of each layer.

    It is a context manager, made by `Client.connect`. Leaving it stops the stream.

    If the iteration raises an error, for example because the server is gone, the stream ends but keeps what it has:
    earlier views stay usable, `decoder` has all received data (``decoder.view()`` is the last complete layer), and
    `ended` is truncated.

    Examples
    --------
    >>> from lodestream_client import Client
    >>> client = Client("http://127.0.0.1:8000")
    >>> surface = client.upload("terrain.npy")
    >>> with client.connect(surface.id, limit_rate=4000) as stream:  # bytes a second
    ...     for view in stream:
    ...         if view.rms < 5:
    ...             stream.stop()
    >>> stream.ended, view.points.shape
    ('stopped', (97, 70))
    """

    # Only what waits for the network is done on the loop. The policy, the decoder, and whatever the caller has given
    # (sink, store, progress) run in the caller's thread.
    def __init__(self, url: str, options: ConnectOptions, http: Callable[[], httpx.AsyncClient], owner: object) -> None:
        super().__init__(url, options)
        self._owner = owner  # whose connections are closed when nobody refers to it
        self._loop = loop_thread.current()
        self._io = EffectIO(self._session, http)
        self._loop.hold(self._io)
        weakref.finalize(self, loop_thread.release, self._io).atexit = False
        try:
            while not self._core.met and self._step():
                pass
        except BaseException as error:
            self._abandon(abort=isinstance(error, KeyboardInterrupt))
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
        self._send(stop=True)

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
        self._send()

    def close(self) -> None:
        """Stop and close the connection, within `close_timeout`."""
        if not self._loop.alive:
            return  # the process was forked; the other one has the connection
        over = self.ended is not None
        self._session.close()
        if not over:
            self._send(stop=True)
        # Whoever closes has what they want; how the other side takes it is no concern of theirs.
        with suppress(LodestreamError):
            while self._step():
                pass
        self._abandon()

    def _abandon(self, *, abort: bool = False) -> None:
        self._session.abandon()
        if self._loop.alive:
            if self._io.open:
                self._loop.run(partial(self._io.hang_up, HangUp(abort=abort)))
            loop_thread.release(self._io)

    def _send(self, *, stop: bool = False) -> None:
        # Messages are handed over in the order in which they are made; so is their sending begun. Nobody waits for it.
        with self._session.lock:
            messages = self._session.messages()
            if not messages and not stop:
                return
            self._loop.begin(partial(self._io.stop if stop else self._io.send, messages))

    def _step(self, *, wait: bool = True) -> bool:
        """Carry out the next effect, optionally only if it needs no waiting; return whether that was done."""
        if (effect := self._core.effect) is None:
            return False
        try:
            result = self._performed(effect, wait=wait)
            if result is WAITS:
                return False
        except Exception as error:
            self._core.failed(error)
        else:
            self._core.done(result)
        return True

    def _performed(self, effect: Effect, *, wait: bool) -> Any:
        if isinstance(effect, Send):
            return self._send()
        result = None
        if not isinstance(effect, Hear | Read) or not self._io.arrived:
            result = self._loop.run(partial(self._io.perform if wait else self._io.poll, effect))
        return self._io.arrived.popleft() if isinstance(effect, Hear | Read) and self._io.arrived else result
