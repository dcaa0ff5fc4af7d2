"""A temporary server in a process of its own, on a free port, with a temporary data folder."""

from __future__ import annotations

import contextlib
import socket
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import httpx

from lodestream.errors import LodestreamError
from lodestream.operating_system import kill_session, new_session

from ..terminal.interrupts import raising

__all__ = ["own_server"]

_READY_SECONDS = 300.0  # of a slow machine: a second or two otherwise
_LOOK_SECONDS = 0.1
_END_SECONDS = 10.0
_LOG_TAIL = 2000


@contextmanager
def own_server() -> Iterator[str]:
    """Start a server, yield its URL once it is ready, and end it with the block.

    Raises
    ------
    LodestreamError
        If it does not start; with the last lines of its log.
    """
    with tempfile.TemporaryDirectory(prefix="lodestream-demo-", ignore_cleanup_errors=True) as folder, raising():
        log = Path(folder) / "server.log"
        port = _free_port()
        # It reads what the demo uploads, from this machine alone.
        command = [sys.executable, "-m", "lodestream_client", "serve", "--unconfined"]
        command += ["--host", "127.0.0.1", "--port", str(port), "--data", str(Path(folder) / "data")]
        with log.open("wb") as output:
            # A session of its own: a Ctrl-C is ours to handle, and then ours to pass on.
            process = subprocess.Popen(command, stdin=subprocess.DEVNULL, stdout=output, stderr=output, **new_session())
        try:
            url = f"http://127.0.0.1:{port}"
            _await(process, url, log)
            yield url
        finally:
            _end(process)


def _free_port() -> int:
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        port: int = probe.getsockname()[1]
    return port


def _await(process: subprocess.Popen[bytes], url: str, log: Path) -> None:
    until = time.monotonic() + _READY_SECONDS
    with httpx.Client(trust_env=False, timeout=_READY_SECONDS) as client:
        while time.monotonic() < until:
            if process.poll() is not None:
                lines = log.read_text(errors="replace")[-_LOG_TAIL:].strip().splitlines() or ["it said nothing"]
                raise LodestreamError(f"the server ended with code {process.returncode}: {lines[-1]}")
            with contextlib.suppress(httpx.TransportError):
                if client.get(f"{url}/readyz").is_success:
                    return
            time.sleep(_LOOK_SECONDS)
    raise LodestreamError(f"the server was not ready within {_READY_SECONDS:.0f} seconds")


def _end(process: subprocess.Popen[bytes]) -> None:
    process.terminate()
    try:
        process.wait(_END_SECONDS)
    except subprocess.TimeoutExpired:
        # Its workers too: they are in its session, which is its own.
        kill_session(process)
        process.wait()
