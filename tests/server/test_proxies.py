"""The configurations of docs/operating.md and docker/, each in front of ``lodestream serve``."""

from __future__ import annotations

import os
import re
import socket
import subprocess
import sys
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, ExitStack, contextmanager
from pathlib import Path
from typing import Any

import httpx
import numpy as np
import pytest

from lodestream_server import running_server
from lodestream_server.access.tokens import TokenFile
from tests.patience import PATIENCE
from tests.server import proxies
from tests.server.connections.sockets import Place, handshake
from tests.server.helpers import hills, npy, problem, settled
from tests.server.proxies import SECONDS, Front

Proxy = Callable[[Path, str], AbstractContextManager[Front]]

#: Streams of one address that the page allows, and requests beyond those of a second.
STREAMS, BURST = 64, 200


@contextmanager
def serving(folder: Path) -> Iterator[tuple[str, str]]:
    """A server in a process of its own that trusts its proxy: its address, and a token with all rights."""
    token, _ = TokenFile(folder / "tokens.json").create("admin", ("admin",))
    command = [sys.executable, "-m", "lodestream_client", "serve", "--port", "0", "--data", str(folder)]
    command += ["--trusted-proxies", "127.0.0.1", "--workers", "1", "--upload-bytes", str(1 << 20)]
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join(filter(None, sys.path))}
    # Nobody reads the pipe after the address has come: the server must not mind.
    with subprocess.Popen(command, env=environment, stderr=subprocess.PIPE, text=True) as process:
        try:
            assert process.stderr is not None
            lines = iter(process.stderr.readline, "")
            found = (re.fullmatch(r"Lodestream serving http://(127\.0\.0\.1:\d+)\n", line) for line in lines)
            yield f"http://{next(match[1] for match in found if match)}", token
        finally:
            process.kill()


def skip_if_missing(proxy: Proxy) -> None:
    if proxies.missing("nginx" if proxy is proxies.nginx else "caddy"):
        pytest.skip("it is not installed")


@contextmanager
def running(proxy: Proxy, folder: Path) -> Iterator[tuple[Front, str]]:
    """A server behind a proxy, and a token with all rights."""
    skip_if_missing(proxy)
    with serving(folder / "data") as (behind, token), proxy(folder / "proxy", behind) as front:
        yield front, token


def pulled(front: Front, token: str, url: str, *options: str) -> None:
    """Run ``pull``, which trusts the authorities that OpenSSL is told of."""
    names = {"SSL_CERT_FILE": str(front.authority), "LODESTREAM_TOKEN": token, "LODESTREAM_CACHE": ""}
    names["PYTHONPATH"] = os.pathsep.join(filter(None, sys.path))
    done = subprocess.run(
        [sys.executable, "-m", "lodestream_client", "pull", f"{front.url}{url}", *options],
        env=os.environ | names,
        capture_output=True,
        text=True,
        timeout=SECONDS,
        check=False,
    )
    assert done.returncode == 0, done.stderr


@pytest.mark.parametrize(
    "proxy", [proxies.nginx, proxies.caddy, pytest.param(proxies.caddy_of_image, marks=pytest.mark.long)]
)
def test_a_surface_through_a_proxy(proxy: Proxy, tmp_path: Path) -> None:
    heights = hills(120, 90)
    with running(proxy, tmp_path) as (front, token), front.client(token) as http:
        uploaded = http.post("/v1/surfaces", content=npy(heights), params={"filename": "hills.npy"})
        assert uploaded.status_code == 202, uploaded.text
        surface = settled(http, uploaded.headers["location"])
        assert surface["state"] == "ready"

        whole = http.get(f"{surface['url']}/container", follow_redirects=True)
        assert whole.status_code == 200
        part = http.get(whole.url, headers={"Range": "bytes=100-299"})
        assert (part.status_code, part.content) == (206, whole.content[100:300])

        for transport in ("ws", "http"):  # a stream, and requests with Range
            pulled(front, token, surface["url"], str(back := tmp_path / f"{transport}.npy"), "--transport", transport)
            assert np.array_equal(np.load(back), heights)
        pulled(front, token, surface["url"], str(back := tmp_path / "level.npy"), "--transport", "http", "--level", "2")
        assert np.load(back).shape == (5, 4)
        level = f"{surface['url']}/levels/3?format=npy"
        whole = http.get(level).raise_for_status()
        part = http.get(level, headers={"Range": "bytes=100-299"})
        assert (part.status_code, part.content) == (206, whole.content[100:300])

        # Refused before all of it has come, with its length and without.
        for content in (bytes(100 << 20), (bytes(1 << 16) for _ in range(1600))):
            assert problem(http.post("/v1/surfaces", content=content)) == (413, "too-large")

        for path in ("/metrics", "/metrics/", "/%6detrics", "//metrics"):
            assert http.get(f"{front.url}{path}").status_code in (403, 404), path
        assert http.get("/metrics").status_code == 403
        with front.client() as stranger:
            assert stranger.get("/v1/surfaces").status_code == 401
        with pytest.raises(httpx.ConnectError, match="CERTIFICATE_VERIFY_FAILED"):
            httpx.get(front.url, trust_env=False, timeout=SECONDS)


def asked(front: Front, data: bytes, least: int = 1) -> tuple[socket.socket, bytes]:
    """A connection over which something was sent, and what came until it had so many statuses."""
    port = int(front.url.rpartition(":")[2])
    plain = socket.create_connection(("127.0.0.1", port), timeout=SECONDS)
    connection = front.trust.wrap_socket(plain, server_hostname="localhost")
    connection.sendall(data)
    answer = b""
    while len(re.findall(rb"HTTP/1\.1 \d", answer)) < least and (piece := connection.recv(1 << 16)):
        answer += piece
    return connection, answer


def test_nginx_limits_the_streams_of_an_address(tmp_path: Path) -> None:
    skip_if_missing(proxies.nginx)
    # However long the handshakes take, the first ones are still there: their token is waited for.
    patient: dict[str, Any] = {"workers": 1, "trusted_proxies": ("127.0.0.1",), "head_seconds": PATIENCE}
    with (
        running_server(tmp_path / "data", **patient) as behind,
        proxies.nginx(tmp_path / "proxy", behind) as front,
        ExitStack() as held,
    ):
        opening, answers = handshake(Place("localhost", 443, f"/v1/surfaces/{'0' * 20}")), list[bytes]()
        for _ in range(STREAMS + 1):
            connection, answer = asked(front, opening)
            held.enter_context(connection)
            answers.append(answer[:12])
        assert answers == [b"HTTP/1.1 101"] * STREAMS + [b"HTTP/1.1 429"]


def test_nginx_limits_the_requests_of_an_address(tmp_path: Path) -> None:
    with running(proxies.nginx, tmp_path) as (front, _):
        # nginx refuses these by itself, far faster than so many may come.
        connection, answer = asked(front, b"GET /metrics HTTP/1.1\r\nHost: localhost\r\n\r\n" * 4 * BURST, 4 * BURST)
        connection.close()
        statuses = re.findall(rb"HTTP/1\.1 (\d+)", answer)
        assert set(statuses) == {b"403", b"429"}
        assert BURST <= statuses.count(b"403") < 4 * BURST
