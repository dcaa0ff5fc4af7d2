"""``lodestream serve``, its settings, and what it stands on."""

from __future__ import annotations

import argparse
import asyncio
import os
import re
import signal
import socket
import subprocess
import sys
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import httpx
import pytest
import uvicorn

import lodestream_server
from lodestream.errors import LodestreamError, OptionError, UnavailableError
from lodestream_server import Settings, create_app, running_server
from lodestream_server.access.tokens import TokenFile
from lodestream_server.commands.serve import register
from lodestream_server.running import make_server
from tests.server.helpers import PATIENCE, hills, npy, push

SCRIPT = """
import argparse, sys
from lodestream_server.commands.serve import register
if __name__ == "__main__":
    parser = argparse.ArgumentParser()
    register(parser.add_subparsers())
    args = parser.parse_args()
    sys.exit(args.run(args))
"""


def parse(*arguments: str) -> argparse.Namespace:
    parser = argparse.ArgumentParser(prog="lodestream")
    register(parser.add_subparsers())
    return parser.parse_args(["serve", *arguments])


@contextmanager
def serving(tmp_path: Path, *arguments: str) -> Iterator[tuple[subprocess.Popen[str], str]]:
    """A server in a process of its own, and its address."""
    script = tmp_path / "serve.py"
    script.write_text(SCRIPT)
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join(filter(None, sys.path)), "LODESTREAM_WORKERS": "1"}
    command = [sys.executable, str(script), "serve", "--port", "0", "--data", str(tmp_path / "data"), *arguments]
    # Nobody reads the pipe after the address has come: the server must not mind.
    with subprocess.Popen(command, env=environment, stderr=subprocess.PIPE, text=True) as process:
        try:
            assert process.stderr is not None
            lines = iter(process.stderr.readline, "")
            found = (re.fullmatch(r"Lodestream serving (http://127\.0\.0\.1:\d+)\n", line) for line in lines)
            yield process, next(match[1] for match in found if match)
        finally:
            process.kill()


def test_the_server_says_where_it_listens_and_ends_when_told(tmp_path: Path) -> None:
    with serving(tmp_path) as (process, address):
        with httpx.Client(base_url=address, trust_env=False, timeout=PATIENCE) as http:
            assert http.get("/healthz").status_code == 200
        process.send_signal(signal.SIGTERM)
        assert process.wait(PATIENCE) in (0, -signal.SIGTERM)
        assert process.stderr is not None
        assert "Traceback" not in process.stderr.read()


def test_what_was_acknowledged_is_there_after_a_kill(tmp_path: Path) -> None:
    with (
        serving(tmp_path) as (process, address),
        httpx.Client(base_url=address, trust_env=False, timeout=PATIENCE) as http,
    ):
        ready = push(http, npy(hills(seed=1)))
        queued = http.post("/v1/surfaces", content=npy(hills(200, 200, seed=2)))
        assert queued.status_code == 202
        process.kill()
        process.wait(PATIENCE)
    with serving(tmp_path) as (_, address), httpx.Client(base_url=address, trust_env=False, timeout=PATIENCE) as http:
        assert http.get(ready["url"]).json() == ready
        assert push(http, npy(hills(200, 200, seed=2)))["url"] == queued.headers["location"]


@pytest.mark.usefixtures("called_here")
@pytest.mark.parametrize("host", ["0.0.0.0", "::", "192.0.2.1", "example.org"])
def test_an_address_that_others_reach_needs_a_token_or_a_word(host: str, tmp_path: Path) -> None:
    args = parse("--host", host, "--data", str(tmp_path))
    with pytest.raises(LodestreamError, match="--insecure") as refused:
        args.run(args)
    assert host in str(refused.value)
    assert str(tmp_path / "tokens.json") in str(refused.value)
    create_app(Settings(host=host, data=tmp_path, insecure=True))
    TokenFile(tmp_path / "tokens.json").create("mine", ("read",))
    create_app(Settings(host=host, data=tmp_path))


@pytest.mark.usefixtures("called_here")
def test_a_variable_of_the_environment_that_cannot_be_used_is_named(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    args = parse("--data", str(tmp_path))
    monkeypatch.setenv("LODESTREAM_HOST", "0.0.0.0")
    with pytest.raises(LodestreamError, match=r"0\.0\.0\.0"):
        args.run(args)
    monkeypatch.setenv("LODESTREAM_PORT", "many")
    with pytest.raises(OptionError, match=r"LODESTREAM_PORT: expected a whole number, got 'many'"):
        args.run(args)


@pytest.mark.parametrize(
    "arguments",
    [
        ["--port", "x"],
        ["--port", "70000"],
        ["--upload-bytes", "4 pounds"],
        ["--memory", "1MiB"],
        ["--idle-seconds", "1"],
        ["--log-format", "xml"],
        ["--nonsense"],
        ["extra"],
    ],
)
def test_a_wrong_command_line_exits_with_2(arguments: list[str]) -> None:
    with pytest.raises(SystemExit) as ended:
        parse(*arguments)
    assert ended.value.code == 2


def test_a_variable_of_the_environment_sets_what_the_command_line_does_not(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("LODESTREAM_WORKERS", "7")
    monkeypatch.setenv("LODESTREAM_PORT", "1234")
    settings = Settings(port=0)
    assert (settings.workers, settings.port) == (7, 0)


def test_a_folder_that_another_server_has_is_refused(tmp_path: Path) -> None:
    with (
        running_server(tmp_path),
        pytest.raises(LodestreamError, match="which another one uses"),
        running_server(tmp_path),
    ):
        pass


def test_registering_the_command_does_not_load_the_web_framework() -> None:
    code = (
        "import sys, argparse; from lodestream_server.commands.serve import register;"
        "register(argparse.ArgumentParser().add_subparsers());"
        "print([name for name in ('fastapi', 'uvicorn', 'numpy') if name in sys.modules])"
    )
    assert output_of(code) == "[]\n"


def output_of(code: str) -> str:
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join(filter(None, sys.path))}
    done = subprocess.run(
        [sys.executable, "-c", code], env=environment, capture_output=True, text=True, timeout=PATIENCE
    )
    assert not done.returncode, done.stderr
    return done.stdout


def test_the_public_names_are_there() -> None:
    assert {name: getattr(lodestream_server, name).__name__ for name in lodestream_server.__all__} == {
        name: name for name in lodestream_server.__all__
    }
    with pytest.raises(AttributeError):
        _ = lodestream_server.nothing


def test_an_application_runs_without_a_socket(tmp_path: Path) -> None:
    async def ask() -> list[int]:
        app = create_app(Settings(data=tmp_path, workers=1))
        async with (
            app.router.lifespan_context(app),
            httpx.AsyncClient(transport=httpx.ASGITransport(app), base_url="http://localhost/") as http,
        ):
            posted = await http.post("/v1/surfaces", content=npy(hills()))
            looked = await http.get(posted.headers["location"])
            missing = await http.get("/v1/surfaces/0")
            return [posted.status_code, looked.status_code, missing.status_code]

    assert asyncio.run(ask()) == [202, 200, 404]


def test_links_keep_the_prefix_of_a_proxy(tmp_path: Path) -> None:
    async def ask() -> list[str]:
        app = create_app(Settings(data=tmp_path, workers=1))
        transport = httpx.ASGITransport(app, root_path="/maps")
        async with (
            app.router.lifespan_context(app),
            httpx.AsyncClient(transport=transport, base_url="http://localhost/") as http,
        ):
            posted = await http.post("/maps/v1/surfaces", content=npy(hills()))
            return [posted.headers["location"], posted.json()["url"]]

    location, url = asyncio.run(ask())
    assert location == url
    assert re.fullmatch("/maps/v1/surfaces/[0-9a-f]{20}", location)


def test_the_server_blocks_when_a_client_does_not_read(tmp_path: Path) -> None:
    """What memory under slow readers stands on: uvicorn before 0.52.1 took every message at once."""
    accepted = threading.Event()

    async def flood(scope: Any, receive: Any, send: Any) -> None:
        if scope["type"] == "websocket":
            await receive()
            await send({"type": "websocket.accept"})
            for _ in range(2000):
                await send({"type": "websocket.send", "bytes": bytes(64 * 1024)})
            accepted.set()

    settings = Settings(data=tmp_path, port=0)
    addresses: list[str] = []
    listening = threading.Event()

    def tell(address: str) -> None:
        addresses.append(address)
        listening.set()

    config = make_server(settings, tell).config
    assert config.ws_per_message_deflate is False
    assert config.timeout_graceful_shutdown is not None
    flooding = make_server(settings, tell)
    flooding.config = uvicorn.Config(
        flood, port=0, http=config.http, ws=config.ws, lifespan="off", log_config=None, timeout_graceful_shutdown=1
    )
    thread = threading.Thread(target=flooding.run, daemon=True)
    thread.start()
    assert listening.wait(PATIENCE)
    try:
        # A bare socket: a library would read ahead.
        host, port = addresses[0].removeprefix("http://").rsplit(":", 1)
        with socket.create_connection((host, int(port)), timeout=PATIENCE) as client:
            client.sendall(
                f"GET / HTTP/1.1\r\nHost: {host}:{port}\r\nUpgrade: websocket\r\nConnection: Upgrade\r\n"
                "Sec-WebSocket-Key: AAAAAAAAAAAAAAAAAAAAAA==\r\nSec-WebSocket-Version: 13\r\n\r\n".encode()
            )
            assert client.recv(12) == b"HTTP/1.1 101"
            assert not accepted.wait(1.0)
    finally:
        flooding.should_exit = True
        thread.join(PATIENCE)


@pytest.mark.parametrize("library", ["fastapi", "uvicorn"])
def test_a_library_of_the_server_that_is_missing_is_named_with_its_extra(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, library: str
) -> None:
    monkeypatch.setitem(sys.modules, library, None)
    args = parse("--data", str(tmp_path / "data"), "--port", "0", "--host", "0.0.0.0")  # refused, without a token
    with pytest.raises(
        UnavailableError, match=rf"{library}, which is not installed: pip install 'lodestream\[server\]'"
    ):
        args.run(args)


@pytest.mark.parametrize("command", ["token", "serve"])
def test_commands_of_the_server_need_its_extra(command: str) -> None:
    code = (
        "import sys; sys.modules['pydantic_settings'] = None; sys.stderr = sys.stdout;"
        f"from lodestream_client.program import main; print(main(['{command}']))"
    )
    assert re.search(r"pydantic_settings.*; pip install 'lodestream\[server\]'\n1\n$", output_of(code))
