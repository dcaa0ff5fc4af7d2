"""Web servers that hold plain files: one that knows Range, made here, and those of others."""

from __future__ import annotations

import hashlib
import mimetypes
import re
import shutil
import socket
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from functools import partial
from http.server import BaseHTTPRequestHandler, SimpleHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from typing import Any

from tests.patience import PATIENCE
from tests.ports import reserved_port

__all__ = ["Ranged", "nginx", "plain", "ranged", "running"]

_RANGE = re.compile(r"bytes=(\d+)-(\d+)")


class Ranged(ThreadingHTTPServer):
    """A server of one folder that knows Range, If-Range and entity tags.

    Attributes
    ----------
    requests : list of (str, str or None)
        Method and Range of every request.
    tags : bool
        Whether it tells what version a file is of.
    """

    daemon_threads = True

    def __init__(self, folder: Path) -> None:
        super().__init__(("127.0.0.1", 0), _RangedHandler)
        self.folder = folder
        self.requests: list[tuple[str, str | None]] = []
        self.tags = True

    @property
    def url(self) -> str:
        return f"http://127.0.0.1:{self.server_port}"

    def handle_error(self, request: Any, client_address: Any) -> None:
        # A client may leave in the middle of an answer.
        if not isinstance(sys.exc_info()[1], ConnectionError):
            super().handle_error(request, client_address)


class _RangedHandler(BaseHTTPRequestHandler):
    protocol_version = "HTTP/1.1"
    server: Ranged

    def do_GET(self) -> None:
        self._serve(True)

    def do_HEAD(self) -> None:
        self._serve(False)

    def _serve(self, body: bool) -> None:
        asked = self.headers.get("Range")
        self.server.requests.append((self.command, asked))
        path = self.server.folder / self.path.partition("?")[0].lstrip("/")
        if not path.is_file():
            self.send_error(404)
            return
        data = path.read_bytes()
        tag = f'"{hashlib.md5(data).hexdigest()}"'  # no SHA-256: that would name the container
        found = _RANGE.fullmatch(asked or "")
        if found is not None and self.headers.get("If-Range", tag) == tag:
            first, last = int(found[1]), min(int(found[2]), len(data) - 1)
            if first > last:
                self.send_error(416)
                return
            self.send_response(206)
            self.send_header("Content-Range", f"bytes {first}-{last}/{len(data)}")
            data = data[first : last + 1]
        else:
            self.send_response(200)
        if self.server.tags:
            self.send_header("ETag", tag)
        # Browsers run no module whose type they are not told.
        if (kind := mimetypes.guess_type(path.name)[0]) is not None:
            self.send_header("Content-Type", kind)
        self.send_header("Content-Length", str(len(data)))
        self.end_headers()
        if body:
            self.wfile.write(data)

    def log_message(self, *_: Any) -> None:
        pass


class _Quiet(SimpleHTTPRequestHandler):
    def log_message(self, *_: Any) -> None:
        pass


@contextmanager
def running(server: ThreadingHTTPServer) -> Iterator[None]:
    """A server that answers within the block."""
    thread = threading.Thread(target=server.serve_forever, kwargs={"poll_interval": 0.01})
    thread.start()
    try:
        yield
    finally:
        server.shutdown()
        thread.join()
        server.server_close()


@contextmanager
def ranged(folder: Path) -> Iterator[Ranged]:
    """A server that knows Range."""
    server = Ranged(folder)
    with running(server):
        yield server


@contextmanager
def plain(folder: Path) -> Iterator[str]:
    """The server of Python's library, which does not know Range."""
    server = ThreadingHTTPServer(("127.0.0.1", 0), partial(_Quiet, directory=str(folder)))
    server.daemon_threads = True
    with running(server):
        yield f"http://127.0.0.1:{server.server_port}"


_CONFIGURATION = """
daemon off;
master_process off;
pid {work}/nginx.pid;
error_log {work}/error.log;
events {{ worker_connections 64; }}
http {{
    access_log off;
    types {{ }}
    default_type application/octet-stream;
    client_body_temp_path {work}/body;
    proxy_temp_path {work}/proxy;
    fastcgi_temp_path {work}/fastcgi;
    uwsgi_temp_path {work}/uwsgi;
    scgi_temp_path {work}/scgi;
    server {{
        listen 127.0.0.1:{port};
        root {folder};
        location /maps/ {{
            proxy_pass {behind}/;
            proxy_http_version 1.1;
            proxy_set_header Host $http_host;
            proxy_set_header Upgrade $http_upgrade;
            proxy_set_header Connection $upgrading;
            proxy_buffering off;
        }}
    }}
    map $http_upgrade $upgrading {{ default upgrade; "" close; }}
}}
"""


@contextmanager
def nginx(folder: Path, work: Path, behind: str = "http://127.0.0.1:9") -> Iterator[str]:
    """A server of nginx, which has to be installed: the files of a folder, and another server as ``/maps/``."""
    program = shutil.which("nginx") or "/usr/sbin/nginx"
    configuration = work / "nginx.conf"
    with reserved_port() as port:
        configuration.write_text(_CONFIGURATION.format(work=work, folder=folder, port=port, behind=behind))
        process = subprocess.Popen([program, "-p", str(work), "-c", str(configuration)], stderr=subprocess.DEVNULL)
        try:
            until = time.monotonic() + PATIENCE
            while time.monotonic() < until and process.poll() is None:
                with socket.socket() as probe:
                    if probe.connect_ex(("127.0.0.1", port)) == 0:
                        break
                time.sleep(0.02)
            yield f"http://127.0.0.1:{port}"
        finally:
            process.terminate()
            process.wait(PATIENCE)
