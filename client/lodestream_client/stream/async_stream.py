"""Streams for asyncio."""

from __future__ import annotations

from collections.abc import AsyncIterator, Callable
from contextlib import suppress
from types import TracebackType
from typing import TYPE_CHECKING, Any

from lodestream.errors import LodestreamError
from lodestream.target import Region

from .effect_io import EffectIO
from .effects import WAITS, Effect, HangUp, Hear, Read
from .options import ConnectOptions
from .stream import BaseStream

if TYPE_CHECKING:
    import httpx

    from lodestream.decoding.decoder import View

__all__ = ["AsyncStream"]


class AsyncStream(BaseStream):
    """A surface being received, as `Stream` for asyncio; iterate over it for a `View` of each layer.

    It is an asynchronous context manager, made by `AsyncClient.connect`. Entering it opens the connection; leaving it
    stops the stream. An iteration that is cancelled, for example by a timeout, may be continued.

    The event loop only takes bytes apart, at most 64 KiB at a time. Values are decoded where they are asked for: use
    ``await asyncio.to_thread(view.surface)`` for a large surface, and ``asyncio.to_thread(stream.decoder.view)`` for
    its end, which is verified when it is first asked for.

    Examples
    --------
    >>> import asyncio, lodestream_client
    >>> async def receive():
    ...     async with lodestream_client.AsyncClient("http://127.0.0.1:8000") as client:
    ...         surface = await client.upload("terrain.npy")
    ...         async with client.connect(surface.id, limit_rate=4000) as stream:  # bytes a second
    ...             async for view in stream:
    ...                 if view.rms < 5:
    ...                     await stream.stop()
    ...     return stream.ended, view.points.shape
    >>> asyncio.run(receive())
    ('stopped', (97, 70))
    """

    def __init__(self, url: str, options: ConnectOptions, http: Callable[[], httpx.AsyncClient]) -> None:
        super().__init__(url, options)
        self._io = EffectIO(self._session, http)

    def __aiter__(self) -> AsyncIterator[View]:
        return self

    async def __anext__(self) -> View:
        while (view := self._core.next_view()) is None:
            if not await self._step():
                raise StopAsyncIteration
        return view

    async def __aenter__(self) -> AsyncStream:
        try:
            while not self._core.met and await self._step():
                pass
        except BaseException:
            await self._abandon()
            raise
        return self

    async def __aexit__(
        self, kind: type[BaseException] | None, error: BaseException | None, traceback: TracebackType | None
    ) -> None:
        if kind is None:
            await self.close()
        else:
            await self._abandon()

    async def latest(self) -> AsyncIterator[View]:
        """Iterate over the newest views, for a program that draws more slowly than they arrive.

        Earlier views are left out. The last view of the stream is always among them.
        """
        async for view in self:
            newest, failed = view, None
            try:
                while (later := self._core.next_view()) is not None or await self._step(wait=False):
                    newest = later or newest
            except LodestreamError as error:
                failed = error
            self._core.shown()
            yield newest
            if failed is not None:
                raise failed

    async def stop(self) -> None:
        """Stop the stream at once: no further view is yielded.

        May be called from another task than the one that iterates.
        """
        self._session.stop()
        await self._io.stop(self._session.messages())

    async def focus(self, region: Region | None) -> None:
        """Receive the data of a region before the rest, see `Stream.focus`.

        Raises
        ------
        OptionError
            If the surface has no such region, or several blocks. While the surface is not known yet, the iteration
            raises it.
        """
        self._session.focus(region)
        await self._io.send(self._session.messages())

    async def close(self) -> None:
        """Stop and close the connection, within `close_timeout`."""
        self._session.close()
        await self._io.stop(self._session.messages())
        # Whoever closes has what they want; how the other side takes it is no concern of theirs.
        with suppress(LodestreamError):
            while await self._step():
                pass
        await self._abandon()

    async def _abandon(self) -> None:
        self._session.abandon()
        await self._io.hang_up(HangUp())

    async def _step(self, *, wait: bool = True) -> bool:
        """Carry out the next effect, optionally only if it needs no waiting; return whether that was done."""
        if (effect := self._core.effect) is None:
            return False
        try:
            result = await self._performed(effect, wait=wait)
            if result is WAITS:
                return False
        except Exception as error:
            self._core.failed(error)
        else:
            self._core.done(result)
        return True

    async def _performed(self, effect: Effect, *, wait: bool) -> Any:
        result = None
        if not isinstance(effect, Hear | Read) or not self._io.arrived:
            result = await (self._io.perform(effect) if wait else self._io.poll(effect))
        return self._io.arrived.popleft() if isinstance(effect, Hear | Read) and self._io.arrived else result
