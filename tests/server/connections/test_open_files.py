"""More connections than files: whoever has one is served, and the log does not grow."""

from __future__ import annotations

import logging
import os
import re
import resource
import socket
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path
from urllib.parse import urlsplit

import httpx
import pytest

from lodestream_server import Settings
from lodestream_server.connections.open_files import most_connections, raise_file_limit
from tests.patience import PATIENCE
from tests.server.helpers import eventually, hills, npy, push

# `serve` under a small limit.
SCRIPT = """
import argparse, resource, sys
from lodestream_server.commands.serve import register
if __name__ == "__main__":
    resource.setrlimit(resource.RLIMIT_NOFILE, (int(sys.argv[1]), int(sys.argv[1])))
    parser = argparse.ArgumentParser()
    register(parser.add_subparsers())
    args = parser.parse_args(sys.argv[2:])
    sys.exit(args.run(args))
"""


@contextmanager
def serving(folder: Path, files: int, *arguments: str) -> Iterator[tuple[str, Path]]:
    """The address of a server that may open so many files, and its log."""
    script, log = folder / "serve.py", folder / "log"
    script.write_text(SCRIPT)
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join(filter(None, sys.path))}
    options = ["--port", "0", "--workers", "1", "--data", str(folder / "data"), *arguments]
    command = [sys.executable, str(script), str(files), "serve", *options]
    with log.open("w") as written, subprocess.Popen(command, env=environment, stderr=written, text=True) as process:
        try:
            found = eventually(lambda: re.search(r"^Lodestream serving (\S+)$", log.read_text(), re.M), "an address")
            yield found[1], log
        finally:
            process.terminate()
            process.wait(PATIENCE)


@pytest.mark.long
def test_more_connections_than_files_neither_stop_the_server_nor_fill_its_log(tmp_path: Path) -> None:
    with serving(tmp_path, 90) as (url, log), httpx.Client(base_url=url, trust_env=False, timeout=PATIENCE) as http:
        made = push(http, npy(hills()))
        address = urlsplit(url)
        with ExitStack() as held:
            for _ in range(150):
                each = held.enter_context(socket.create_connection((address.hostname, address.port), timeout=PATIENCE))
                each.sendall(b"GET /healthz HTTP/1.1\r\nHost: ")  # and no more
            # Its connection is from before: it is served, with a file of its own.
            for _ in range(3):
                assert http.get(made["url"] + "/container", follow_redirects=True).status_code == 200
                time.sleep(0.7)
        fresh = httpx.Client(base_url=url, trust_env=False, timeout=5)
        with fresh:
            assert eventually(lambda: _answered(fresh), "an answer once they have gone").status_code == 200
        said = log.read_text()
    assert len(said) < 20_000
    assert "enough for 21: raise the limit" in said


def _answered(http: httpx.Client) -> httpx.Response | None:
    try:
        answer = http.get("/healthz")
    except httpx.TransportError:
        return None
    return answer if answer.status_code == 200 else None


@pytest.mark.parametrize(
    ("soft", "expected"), [(90, 21), (1024, 488), (60, 6), (10, 1), (100_000, 5000), (resource.RLIM_INFINITY, 5000)]
)
def test_as_many_connections_as_files_are_enough_for(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, soft: int, expected: int
) -> None:
    monkeypatch.setattr(resource, "getrlimit", lambda kind: (soft, resource.RLIM_INFINITY))
    assert most_connections(Settings(data=tmp_path, workers=1)) == expected
    assert most_connections(Settings(data=tmp_path, workers=1, max_connections=7)) == 7


@pytest.mark.parametrize(
    ("limits", "chosen", "raised", "warned"),
    [
        ((256, 4096), None, 4096, True),
        ((256, resource.RLIM_INFINITY), None, 10_048, False),
        ((256, 4096), 50, None, False),
        ((256, 4096), 300, 648, False),
        ((resource.RLIM_INFINITY, resource.RLIM_INFINITY), 300, None, False),
    ],
)
def test_the_limit_is_raised_as_far_as_it_is_needed(
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    caplog: pytest.LogCaptureFixture,
    limits: tuple[int, int],
    chosen: int | None,
    raised: int | None,
    warned: bool,
) -> None:
    changes: list[tuple[int, int]] = []
    monkeypatch.setattr(resource, "getrlimit", lambda kind: limits)
    monkeypatch.setattr(resource, "setrlimit", lambda kind, both: changes.append(both))
    with caplog.at_level(logging.WARNING):
        raise_file_limit(Settings(data=tmp_path, workers=1, max_connections=chosen))
    assert changes == ([] if raised is None else [(raised, limits[1])])
    assert bool(caplog.records) == warned
