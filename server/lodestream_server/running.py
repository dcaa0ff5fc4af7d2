"""Running a server: uvicorn as Lodestream needs it, and a server beside the caller's own work."""

from __future__ import annotations

import asyncio
import logging
import resource
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import uvicorn

from lodestream.errors import LodestreamError
from lodestream.messages import MAX_MESSAGE

from .app import create_app
from .connections import connections
from .logs import drain
from .settings import Settings

__all__ = ["Server", "make_server", "raise_file_limit", "running_server"]

_log = logging.getLogger(__name__)

_START_SECONDS = 60.0
_GRACEFUL_SECONDS = 4

# A connection and the container that is sent over it, and what everything else needs.
_FILES_EACH = 2
_OTHER_FILES = 200

# A ping waits behind what is in flight: a full window of 256 KiB takes 33 s on a link of 64 kbit/s.
_PING_INTERVAL = 20.0
_PING_TIMEOUT = 60.0


class Server(uvicorn.Server):
    """A uvicorn server that says where it listens, once it does."""

    def __init__(self, config: uvicorn.Config, listening: Callable[[str], None]) -> None:
        super().__init__(config)
        self._listening = listening
        self._state = getattr(config.app, "state", None)

    async def startup(self, sockets: list[Any] | None = None) -> None:
        """Start, then tell the address."""
        await super().startup(sockets)
        if self.started:
            host, port = self.servers[0].sockets[0].getsockname()[:2]
            self._listening(f"http://[{host}]:{port}" if ":" in host else f"http://{host}:{port}")

    async def shutdown(self, sockets: list[Any] | None = None) -> None:
        """Tell whoever is connected, wait a little for them, and end."""
        parts = getattr(self._state, "parts", None)
        if parts is not None:
            parts.limits.end()
        await super().shutdown(sockets)
        # The signal that was caught is raised again after this, and ends the process at once.
        await asyncio.to_thread(drain)


def make_server(settings: Settings, listening: Callable[[str], None]) -> Server:
    """A server that is not running yet.

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
    config = uvicorn.Config(
        create_app(settings),
        host=settings.host,
        port=settings.port,
        http=connections(settings),
        ws="websockets-sansio",
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
    return Server(config, listening)


def raise_file_limit(settings: Settings) -> None:
    """Let this process open as many files as it may need, or as many as the system lets it."""
    needed = _FILES_EACH * settings.max_connections + _OTHER_FILES
    soft, hard = resource.getrlimit(resource.RLIMIT_NOFILE)
    allowed = needed if hard == resource.RLIM_INFINITY else min(needed, hard)
    if soft < allowed:
        resource.setrlimit(resource.RLIMIT_NOFILE, (allowed, hard))
    if allowed < needed:
        _log.warning(
            "%d connections may need %d open files and this process may open %d: raise the limit (ulimit -n) or set "
            "LODESTREAM_MAX_CONNECTIONS",
            settings.max_connections,
            needed,
            allowed,
        )


@contextmanager
def running_server(data: Path, **settings: Any) -> Iterator[str]:
    """A server on a free port of this machine, in a thread, for as long as the ``with`` block lasts.

    Builds run in spawned processes: a script that uses this guards its own start with ``if __name__ == "__main__"``.

    Parameters
    ----------
    data : Path
        The server's folder.
    **settings
        Fields of `Settings`.

    Yields
    ------
    str
        The server's address, ``http://127.0.0.1:PORT``.

    Raises
    ------
    LodestreamError
        When the server does not start.
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
        if not address:
            raise LodestreamError(
                f"expected a server that starts within {_START_SECONDS:g} s; its log says why it did not"
            )
        yield address[0]
    finally:
        server.should_exit = True
        thread.join()
