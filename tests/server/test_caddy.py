"""The Caddyfile of docker/, with Caddy as a plain process in front of ``lodestream serve``."""

from __future__ import annotations

import os
import re
import shutil
import socket
import ssl
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import httpx
import numpy as np
import pytest

from lodestream_server.access.tokens import TokenFile
from tests.patience import PATIENCE
from tests.server.helpers import eventually, hills, npy, settled

ROOT = Path(__file__).parents[2]

pytestmark = pytest.mark.skipif(shutil.which("caddy") is None, reason="caddy is not installed")


@contextmanager
def serving(folder: Path) -> Iterator[tuple[str, str]]:
    """A server in a process of its own that trusts its proxy: its address, and a token with all rights."""
    token, _ = TokenFile(folder / "tokens.json").create("admin", ("admin",))
    command = [sys.executable, "-m", "lodestream_client", "serve", "--port", "0", "--data", str(folder)]
    command += ["--trusted-proxies", "127.0.0.1", "--workers", "1"]
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join(filter(None, sys.path))}
    # Nobody reads the pipe after the address has come: the server must not mind.
    with subprocess.Popen(command, env=environment, stderr=subprocess.PIPE, text=True) as process:
        try:
            assert process.stderr is not None
            lines = iter(process.stderr.readline, "")
            found = (re.fullmatch(r"Lodestream serving http://(127\.0\.0\.1:\d+)\n", line) for line in lines)
            yield next(match[1] for match in found if match), token
        finally:
            process.kill()


@contextmanager
def caddy(folder: Path, behind: str) -> Iterator[tuple[str, Path]]:
    """Caddy for https://localhost at a free port: its address, and the certificate of its own authority."""
    with socket.socket() as probe, socket.socket() as other:
        probe.bind(("127.0.0.1", 0))
        other.bind(("127.0.0.1", 0))
        port, http_port = probe.getsockname()[1], other.getsockname()[1]
    folder.mkdir()
    names = {"HOME": str(folder), "XDG_DATA_HOME": str(folder), "XDG_CONFIG_HOME": str(folder)}
    names |= {"LODESTREAM_DOMAIN": f"localhost:{port}", "LODESTREAM_UPSTREAM": behind}
    names["LODESTREAM_HTTP_PORT"] = str(http_port)
    command = ["caddy", "run", "--config", str(ROOT / "docker/Caddyfile"), "--adapter", "caddyfile"]
    root = folder / "caddy/pki/authorities/local/root.crt"
    with (
        (folder / "log").open("wb") as log,
        subprocess.Popen(command, cwd=folder, env=os.environ | names, stderr=log) as process,
    ):
        try:
            eventually(lambda: root.exists() or process.poll() is not None, "Caddy to start")
            address = f"https://localhost:{port}"
            eventually(lambda: answers(address, root), "Caddy to answer")
            yield address, root
        finally:
            process.terminate()
            process.wait(PATIENCE)


def client(address: str, root: Path, token: str = "") -> httpx.Client:
    headers = {"Authorization": f"Bearer {token}"} if token else {}
    trusted = ssl.create_default_context(cafile=str(root))
    return httpx.Client(base_url=address, headers=headers, verify=trusted, trust_env=False, timeout=PATIENCE)


def answers(address: str, root: Path) -> bool:
    try:
        with client(address, root) as http:
            return http.get("/healthz").is_success
    except (httpx.TransportError, OSError):
        return False


def test_a_surface_through_caddy(tmp_path: Path) -> None:
    heights = hills(120, 90)
    with (
        serving(tmp_path / "data") as (behind, token),
        caddy(tmp_path / "caddy", behind) as (address, root),
        client(address, root, token) as http,
    ):
        np.save(tmp_path / "hills.npy", heights)
        uploaded = http.post("/v1/surfaces", content=npy(heights), params={"filename": "hills.npy"})
        assert uploaded.status_code == 202, uploaded.text
        surface = settled(http, uploaded.headers["location"])
        assert surface["state"] == "ready"

        whole = http.get(f"{surface['url']}/container", follow_redirects=True)
        assert whole.status_code == 200
        part = http.get(whole.url, headers={"Range": "bytes=100-299"})
        assert (part.status_code, part.content) == (206, whole.content[100:300])

        for path in ("/metrics", "/metrics/", "/%6detrics", "//metrics"):
            assert http.get(f"{address}{path}").status_code in (403, 404), path
        assert http.get("/metrics").status_code == 403
        with client(address, root) as stranger:
            assert stranger.get("/v1/surfaces").status_code == 401
        with pytest.raises(httpx.ConnectError, match="CERTIFICATE_VERIFY_FAILED"):
            httpx.get(address, trust_env=False)

        # A stream over WebSocket, by the command, which trusts the authorities that OpenSSL is told of.
        trusting = {"SSL_CERT_FILE": str(root), "LODESTREAM_TOKEN": token, "LODESTREAM_CACHE": ""}
        pythonpath = os.pathsep.join(filter(None, sys.path))
        url, back = f"{address}{surface['url']}", tmp_path / "back.npy"
        command = [sys.executable, "-m", "lodestream_client", "pull", url, str(back)]
        pulled = subprocess.run(
            [*command, "--transport", "ws"],
            env=os.environ | trusting | {"PYTHONPATH": pythonpath},
            capture_output=True,
            text=True,
            timeout=PATIENCE,
            check=False,
        )
        assert pulled.returncode == 0, pulled.stderr
        assert np.array_equal(np.load(back), heights)
