"""Running a server: uvicorn configured for Lodestream, and a server in a thread of another program."""

from __future__ import annotations

import asyncio
import gc
import os
import socket
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import uvicorn

from lodestream.errors import LodestreamError
from lodestream.protocol.messages import MAX_MESSAGE

from .app import create_app, open_data
from .connections.connections import connections
from .connections.cuts import Cuts
from .operation.logs import drain
from .operation.settings import Settings

__all__ = ["Server", "make_server", "running_server", "serve_alone"]

_START_SECONDS = 60.0
_GRACEFUL_SECONDS = 4

# A ping waits behind what is in flight: a full window of 256 KiB takes 33 s on a link of 64 kbit/s.
_PING_INTERVAL = 20.0
_PING_TIMEOUT = 60.0


class Server(uvicorn.Server):
    """A uvicorn server that reports its address once it listens.

    Attributes
    ----------
    refusal : LodestreamError, OSError or None
        Why it did not start: its data could not be opened, or it cannot listen at its address.
    """

    def __init__(self, config: uvicorn.Config, settings: Settings, listening: Callable[[str], None]) -> None:
        super().__init__(config)
        self.refusal: LodestreamError | OSError | None = None
        self._settings = settings
        self._listening = listening
        self._state = getattr(config.app, "state", None)

    async def startup(self, sockets: list[Any] | None = None) -> None:
        """Open the data, listen, start, then report the address."""
        assert self._state is not None, "the application is that of `create_app`"
        try:
            data = await asyncio.to_thread(open_data, self._settings)
        except (LodestreamError, OSError) as error:
            self._refuse(error)
            return
        try:
            # uvicorn would write what is wrong into its log, and end the process with a code of its own.
            listening = await _listen(self.config.host, self.config.port, self.config.backlog)
        except LodestreamError as error:
            data.close()
            self._refuse(error)
            return
        self._state.data = data
        await super().startup(listening)
        if self.started:
            host, port = self.servers[0].sockets[0].getsockname()[:2]
            self._listening(f"http://[{host}]:{port}" if ":" in host else f"http://{host}:{port}")

    def _refuse(self, error: LodestreamError | OSError) -> None:
        self.refusal = error
        self.should_exit = True

    async def shutdown(self, sockets: list[Any] | None = None) -> None:
        """Notify connected clients, wait a little for them, and end."""
        parts = getattr(self._state, "parts", None)
        if parts is not None:
            parts.limits.end()
            parts.builder.leave()
        await super().shutdown(sockets)
        # The signal that was caught is raised again after this, and ends the process at once.
        await asyncio.to_thread(drain)


async def _listen(host: str, port: int, backlog: int) -> list[socket.socket]:
    """Return listening sockets, one for each address of a name."""
    listening = list[socket.socket]()
    try:
        # Nothing is accepted yet: the protocol is never used.
        bound = await asyncio.get_running_loop().create_server(asyncio.Protocol, host, port, start_serving=False)
        listening += [ours.dup() for ours in bound.sockets]
        bound.close()
        for ours in listening:
            ours.listen(backlog)
    except OSError as error:
        for ours in listening:
            ours.close()
        reason = os.strerror(error.errno) if error.errno and error.errno > 0 else error.strerror
        raise LodestreamError(f"cannot listen on {host} port {port}: {reason}") from None
    return listening


def make_server(settings: Settings, listening: Callable[[str], None]) -> Server:
    """Create a server that does not run yet.

    Parameters
    ----------
    settings : Settings
    listening : callable
        Called with the server's address once it accepts connections.

    Raises
    ------
    LodestreamError, OSError
        As `create_app` does.
    """
    app = create_app(settings)
    http, stream = connections(settings, Cuts(app.state.metrics), app.state.pace)
    config = uvicorn.Config(
        app,
        host=settings.host,
        port=settings.port,
        http=http,
        ws=stream,
        ws_max_size=MAX_MESSAGE,
        # What travels is coded already, and each connection would pay 64 KiB.
        ws_per_message_deflate=False,
        ws_ping_interval=_PING_INTERVAL,
        ws_ping_timeout=_PING_TIMEOUT,
        # Without it an open stream keeps the process alive for ever.
        timeout_graceful_shutdown=_GRACEFUL_SECONDS,
        log_config=None,
        access_log=False,
        server_header=False,
        root_path=settings.root_path,
        proxy_headers=bool(settings.trusted_proxies),
        forwarded_allow_ips=list(settings.trusted_proxies),
    )
    return Server(config, settings, listening)


def serve_alone(settings: Settings, listening: Callable[[str], None]) -> Server:
    """Run a server as the only task of its process, until it is told to end, and return it.

    Parameters
    ----------
    settings : Settings
    listening : callable
        Called with the server's address once it accepts connections.

    Raises
    ------
    LodestreamError, OSError
        As `create_app` does.
    """

    def started(address: str) -> None:
        # What is loaded by now stays: no collection, during which nobody is answered, has to look at it again.
        gc.collect()
        gc.freeze()
        # Beside 2,500 connections a collection of all that is not frozen takes a third of a second: every hundredth.
        gc.set_threshold(700, 10, 100)
        listening(address)

    server = make_server(settings, started)
    server.run()
    return server


@contextmanager
def running_server(data: Path | str, **settings: Any) -> Iterator[str]:
    """Run a server on a free port of this machine, in a thread, for the length of the ``with`` block.

    Parameters
    ----------
    data : Path or str
        The server's data folder, or the address of a bucket.
    **settings
        Fields of `Settings`.

    Yields
    ------
    str
        The server's address, ``http://127.0.0.1:PORT``.

    Raises
    ------
    LodestreamError, OSError
        If the server does not start.
    """
    address: list[str] = []
    settled = threading.Event()

    def listening(url: str) -> None:
        address.append(url)
        settled.set()

    server = make_server(Settings(data=data, **{"host": "127.0.0.1", "port": 0, **settings}), listening)

    def run() -> None:
        try:
            server.run()
        # A server that does not start ends with SystemExit, which a thread has no use for.
        except SystemExit:
            pass
        finally:
            settled.set()

    thread = threading.Thread(target=run, name="lodestream-server", daemon=True)
    thread.start()
    settled.wait(_START_SECONDS)
    try:
        if server.refusal is not None:
            raise server.refusal
        if not address:
            raise LodestreamError(f"the server did not start within {_START_SECONDS:g} s; see its log")
        yield address[0]
    finally:
        server.should_exit = True
        thread.join()
