"""nginx and Caddy as docs/operating.md has them, each as a plain process at a free port of this machine."""

from __future__ import annotations

import contextlib
import os
import re
import shutil
import ssl
import subprocess
import time
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import httpx
import pytest

from tests.ports import reserved_port

__all__ = [
    "SECONDS",
    "Front",
    "caddy",
    "caddy_of_image",
    "caddy_of_many",
    "configuration",
    "missing",
    "nginx",
    "self_signed",
]

#: Seconds after which something of a proxy hangs: a start, a request, a command.
SECONDS = 120.0

_ROOT = Path(__file__).parents[2]
_PAGE = _ROOT / "docs" / "operating.md"

# What Debian's own nginx.conf has around a site. One process, in the foreground; more connections than Debian's 768, as
# the page says.
_NGINX = """
daemon off;
master_process off;
pid {work}/nginx.pid;
error_log {work}/error.log;
worker_rlimit_nofile {files};
events {{ worker_connections {files}; }}
http {{
    access_log off;
    client_body_temp_path {work}/body;
    proxy_temp_path {work}/proxy;
    fastcgi_temp_path {work}/fastcgi;
    uwsgi_temp_path {work}/uwsgi;
    scgi_temp_path {work}/scgi;
    {site}
}}
"""
_FILES = 16384


@dataclass(frozen=True)
class Front:
    """A proxy.

    Attributes
    ----------
    url : str
        Its address, https.
    authority : Path
        The certificate that its own is to be checked with.
    """

    url: str
    authority: Path

    @property
    def trust(self) -> ssl.SSLContext:
        """What a client checks certificates with."""
        return ssl.create_default_context(cafile=str(self.authority))

    def client(self, token: str = "") -> httpx.Client:
        """A client that trusts this proxy and asks no other."""
        headers = {"Authorization": f"Bearer {token}"} if token else {}
        return httpx.Client(base_url=self.url, headers=headers, verify=self.trust, trust_env=False, timeout=SECONDS)


def missing(program: str) -> bool:
    """Whether a program is not installed; fails in CI, where all are."""
    found = _found(program) is not None
    assert found or not os.environ.get("CI"), f"expected {program} to be installed, since CI is set"
    return not found


def configuration(language: str, first: str) -> str:
    """Return the one block of docs/operating.md in a language that begins with some words."""
    blocks = re.findall(rf"^```{language}\n({re.escape(first)}.*?)^```", _PAGE.read_text(), re.DOTALL | re.MULTILINE)
    assert len(blocks) == 1, f"expected one block of {language} that begins with {first!r}, got {len(blocks)}"
    return str(blocks[0])


@contextlib.contextmanager
def nginx(folder: Path, behind: str, *, tls: bool = True) -> Iterator[Front]:
    """nginx with the configuration of the page, for https://localhost and a certificate of its own.

    Parameters
    ----------
    folder : Path
        Where its files go; it is made.
    behind : str
        The address of the server, ``http://127.0.0.1:PORT``.
    tls : bool
        Whether it speaks TLS, or is at http://127.0.0.1.
    """
    folder.mkdir()
    certificate, key = self_signed(folder)
    path = folder / "nginx.conf"
    with reserved_port() as port:
        site = _with(
            configuration("nginx", "map "),
            {
                "listen 443 ssl;": f"listen 127.0.0.1:{port}{' ssl' * tls};",
                "maps.example.org;": "localhost;",
                "/etc/letsencrypt/live/maps.example.org/fullchain.pem": str(certificate),
                "/etc/letsencrypt/live/maps.example.org/privkey.pem": str(key),
                "http://127.0.0.1:8000;": f"{behind};",
            },
        )
        path.write_text(_NGINX.format(work=folder, files=_FILES, site=site))
        with _running([str(_found("nginx")), "-p", str(folder), "-c", str(path)], folder):
            url = f"https://localhost:{port}" if tls else f"http://127.0.0.1:{port}"
            yield _answering(Front(url, certificate), folder)


@contextlib.contextmanager
def caddy(folder: Path, behind: str) -> Iterator[Front]:
    """Caddy with the configuration of the page, for https://localhost and a certificate of its own authority."""
    folder.mkdir()
    path = folder / "Caddyfile"
    with reserved_port() as port, reserved_port() as plain:
        text = _with(
            configuration("text", "{\n    servers"),
            {
                "{\n    servers": f"{{\n    admin off\n    skip_install_trust\n    http_port {plain}\n    servers",
                "maps.example.org {": f"localhost:{port} {{",
                "127.0.0.1:8000": behind,
            },
        )
        path.write_text(text)
        with _caddy(folder, path, {}, port) as front:
            yield front


@contextlib.contextmanager
def caddy_of_image(folder: Path, behind: str) -> Iterator[Front]:
    """Caddy with the Caddyfile of docker/."""
    folder.mkdir()
    with reserved_port() as port, reserved_port() as plain:
        names = {"LODESTREAM_DOMAIN": f"localhost:{port}", "LODESTREAM_UPSTREAM": behind}
        names["LODESTREAM_HTTP_PORT"] = str(plain)
        with _caddy(folder, _ROOT / "docker/Caddyfile", names, port) as front:
            yield front


@contextlib.contextmanager
def caddy_of_many(folder: Path, writers: list[str], readers: list[str]) -> Iterator[Front]:
    """Caddy with the Caddyfile of docker/ for several servers."""
    folder.mkdir()
    with reserved_port() as port, reserved_port() as plain:
        names = {"LODESTREAM_DOMAIN": f"localhost:{port}", "LODESTREAM_HTTP_PORT": str(plain)}
        names |= {"LODESTREAM_WRITERS": " ".join(writers), "LODESTREAM_READERS": " ".join(readers)}
        with _caddy(folder, _ROOT / "docker/Caddyfile.scale", names, port) as front:
            yield front


@contextlib.contextmanager
def _caddy(folder: Path, path: Path, names: dict[str, str], port: int) -> Iterator[Front]:
    homes = dict.fromkeys(("HOME", "XDG_DATA_HOME", "XDG_CONFIG_HOME"), str(folder))
    command = [str(_found("caddy")), "run", "--config", str(path), "--adapter", "caddyfile"]
    with _running(command, folder, homes | names):
        yield _answering(Front(f"https://localhost:{port}", folder / "caddy/pki/authorities/local/root.crt"), folder)


@contextlib.contextmanager
def _running(command: list[str], folder: Path, names: dict[str, str] | None = None) -> Iterator[None]:
    with (
        (folder / "log").open("wb") as log,
        subprocess.Popen(command, cwd=folder, env=os.environ | (names or {}), stdout=log, stderr=log) as process,
    ):
        try:
            yield
        finally:
            process.terminate()
            try:
                process.wait(SECONDS)
            except subprocess.TimeoutExpired:
                process.kill()


def _answering(front: Front, folder: Path) -> Front:
    """Wait until a proxy answers."""
    until = time.monotonic() + SECONDS
    while time.monotonic() < until:
        with contextlib.suppress(httpx.TransportError, OSError), front.client() as http:
            http.get("/healthz", timeout=SECONDS / 10).raise_for_status()
            return front
        time.sleep(0.05)
    said = "".join((folder / name).read_text() for name in ("log", "error.log") if (folder / name).exists())
    raise AssertionError(f"expected {front.url} to answer within {SECONDS:g} s: {said[-2000:]}")


def _with(text: str, changes: dict[str, str]) -> str:
    """Return a configuration with other addresses and files, each of which it must have."""
    for old, new in changes.items():
        assert old in text, f"expected {old!r} in the configuration of the page"
        text = text.replace(old, new)
    return text


def _found(program: str) -> str | None:
    return shutil.which(program) or shutil.which(program, path="/usr/sbin")


def self_signed(folder: Path) -> tuple[Path, Path]:
    """Make a certificate for localhost that is signed by itself, and its key."""
    certificate, key = folder / "certificate.pem", folder / "key.pem"
    if missing("openssl"):
        pytest.skip("openssl is not installed")
    command = ["openssl", "req", "-x509", "-nodes", "-newkey", "rsa:2048", "-days", "2", "-subj", "/CN=localhost"]
    names = ["-addext", "subjectAltName=DNS:localhost,IP:127.0.0.1", "-keyout", str(key), "-out", str(certificate)]
    subprocess.run([*command, *names], check=True, capture_output=True, timeout=SECONDS)
    return certificate, key
