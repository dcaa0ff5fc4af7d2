"""What an operator sees: figures, the log, and an end that is an end."""

from __future__ import annotations

import asyncio
import io
import json
import logging
import os
import re
import signal
import socket
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from functools import partial
from pathlib import Path
from types import SimpleNamespace
from typing import Any
from urllib.parse import urlsplit

import httpx
import pytest
from prometheus_client.parser import text_string_to_metric_families
from starlette.responses import Response
from starlette.types import ASGIApp, Message, Receive, Scope, Send
from websockets.exceptions import ConnectionClosed, InvalidStatus

import lodestream as ls
from lodestream.protocol.messages import BASE_CREDIT, Bye, End, Layer, Open, Opened, Stop
from lodestream_server import running_server
from lodestream_server.operation import logs
from lodestream_server.operation.metrics import Metrics
from lodestream_server.operation.observation import Observation
from lodestream_server.operation.settings import choices
from tests.server.helpers import PATIENCE, Raw, closed, data_of, eventually, hills, npy, push, raw_stream


@pytest.fixture(scope="module")
def made(http: httpx.Client) -> dict[str, Any]:
    return push(http, npy(hills(420, 400)))


def figures(http: httpx.Client) -> dict[tuple[str, ...], float]:
    """Every sample: its name and the values of its labels."""
    answer = http.get("/metrics")
    assert answer.status_code == 200
    assert answer.headers["content-type"].startswith("text/plain; version=")
    return {
        (sample.name, *sample.labels.values()): sample.value
        for family in text_string_to_metric_families(answer.text)
        for sample in family.samples
    }


def whole(surface: dict[str, Any]) -> int:
    """Bytes of the surface alone, the index left out."""
    size: int = surface["levels"][-1]["bytes"]
    return size


def grown(http: httpx.Client, before: dict[tuple[str, ...], float], *name: str) -> float:
    return figures(http).get(name, 0.0) - before.get(name, 0.0)


def is_counted(http: httpx.Client, before: dict[tuple[str, ...], float], result: str) -> bool:
    """Whether one stream more has ended so."""
    return grown(http, before, "lodestream_streams_total", result) == 1


def test_streams_are_counted_and_what_stopping_saved(http: httpx.Client, server: str, made: dict[str, Any]) -> None:
    before = figures(http)
    with raw_stream(server + made["url"]) as stream:
        stream.send(Open(ls.Target(max_bytes=5000)))
        assert isinstance(stream.receive(), Opened)
        assert figures(http)["lodestream_streams_open",] == before["lodestream_streams_open",] + 1
        sent = data_of(stream.until_end())
    eventually(
        lambda: figures(http)["lodestream_streams_open",] == before["lodestream_streams_open",], "the stream to be over"
    )
    assert grown(http, before, "lodestream_streams_total", "bytes") == 1
    assert grown(http, before, "lodestream_stream_bytes_total") == sent
    assert grown(http, before, "lodestream_stream_saved_bytes_total") == whole(made) - sent
    assert grown(http, before, "lodestream_first_surface_seconds_count") == 1
    assert 0 < grown(http, before, "lodestream_first_surface_seconds_sum") < PATIENCE


def test_a_complete_stream_saves_nothing_and_a_stop_does(http: httpx.Client, server: str, made: dict[str, Any]) -> None:
    before = figures(http)
    with raw_stream(server + made["url"]) as stream:
        stream.send(Open(ls.Target(level=0), BASE_CREDIT))
        assert any(isinstance(event, Layer) for event in stream.until_end())
    with raw_stream(server + made["url"]) as stream:
        stream.send(Open(credit=1000))
        stream.receive()
        stream.send(Stop())
        stream.until_end()
    for result in ("level", "stopped"):
        eventually(partial(is_counted, http, before, result), "the stream to be counted")
    assert whole(made) < grown(http, before, "lodestream_stream_saved_bytes_total") < 2 * whole(made)
    before = figures(http)
    small = push(http, npy(hills(9, 9, seed=5)))
    with raw_stream(server + small["url"]) as stream:
        stream.send(Open())
        stream.until_end()
    eventually(lambda: grown(http, before, "lodestream_streams_total", "complete") == 1, "the end to be counted")
    assert grown(http, before, "lodestream_stream_saved_bytes_total") == 0
    assert whole(small) <= grown(http, before, "lodestream_stream_bytes_total") <= small["bytes"]


def test_what_was_sent_before_another_open_is_counted_once(
    http: httpx.Client, server: str, made: dict[str, Any]
) -> None:
    before = figures(http)
    with raw_stream(server + made["url"]) as stream:
        sent = 0
        for first in (None, ((0, 5), (0, 5)), None):
            stream.send(Open(ls.Target(first=first), 3000))
            events = [stream.receive()]
            while data_of(events) < 3000:
                events.append(stream.receive())
            stream.send(Stop())
            while not isinstance(events[-1], End):
                events.append(stream.receive())
            sent += data_of(events)
        stream.send(Bye())
        closed(stream, 1000)
    eventually(lambda: grown(http, before, "lodestream_streams_total", "stopped") == 1, "the stream to be counted")
    assert sent == 9000
    assert grown(http, before, "lodestream_stream_saved_bytes_total") == whole(made) - sent


def test_what_the_client_held_is_not_saved(http: httpx.Client, server: str, made: dict[str, Any]) -> None:
    before = figures(http)
    with raw_stream(server + made["url"]) as stream:
        stream.send(Open(ls.Target(max_bytes=5000), held=((0, 3000),), container=made["container_sha256"]))
        sent = data_of(stream.until_end())
    eventually(lambda: grown(http, before, "lodestream_streams_total", "bytes") == 1, "the stream to be counted")
    assert sent < 5000
    assert grown(http, before, "lodestream_stream_saved_bytes_total") == whole(made) - 3000 - sent


def test_builds_uploads_and_errors_are_counted(http: httpx.Client, server: str) -> None:
    # A surface is ready a moment before its build is over and counted.
    eventually(lambda: figures(http)["lodestream_builds_pending",] == 0, "the builds of before to be over")
    before = figures(http)
    push(http, npy(hills(8, 8, seed=6)))
    push(http, npy(hills(8, 8, seed=7))[:-8])
    eventually(lambda: figures(http)["lodestream_builds_pending",] == 0, "the builds to be over")
    assert grown(http, before, "lodestream_build_seconds_count", "ready") == 1
    assert grown(http, before, "lodestream_build_seconds_count", "failed") == 1
    assert grown(http, before, "lodestream_upload_bytes_total") > 500
    assert figures(http)["lodestream_surfaces",] == len(http.get("/v1/surfaces?limit=1000").json()["surfaces"])
    assert figures(http)["lodestream_disk_free_bytes",] > 0
    assert figures(http)["process_resident_memory_bytes",] > 0
    http.get("/v1/surfaces/nothing")
    with raw_stream(f"{server}/v1/surfaces/nothing") as stream, pytest.raises(ConnectionClosed):
        stream.until_end()
    assert grown(http, before, "lodestream_errors_total", "not-found") == 2


def test_the_page_tells_of_every_figure_and_of_settings_that_there_are(http: httpx.Client) -> None:
    page = (Path(__file__).parents[3] / "docs" / "operating.md").read_text()
    families = text_string_to_metric_families(http.get("/metrics").text)
    there = {f"{family.name}_total" if family.type == "counter" else family.name for family in families}
    told = set(re.findall(r"^\| `(lodestream_\w+)` \|", page, re.MULTILINE))
    assert told == {name for name in there if name.startswith("lodestream_")}
    variables = {choice.variable for choice in choices().values()} | {"LODESTREAM_TOKEN"}
    # compose.yaml takes some that are no settings of the server.
    compose = (Path(__file__).parents[3] / "docker" / "compose.yaml").read_text()
    variables |= set(re.findall(r"\$\{(LODESTREAM_[A-Z_]+)", compose))
    assert set(re.findall(r"LODESTREAM_[A-Z_]+", page)) - variables == set()


def test_strangers_cannot_make_figures(http: httpx.Client) -> None:
    before = set(figures(http))
    for number in range(5):
        http.get(f"/nowhere/{number}")
        http.request(f"BREW{number}", "/v1/surfaces")
        http.get(f"/v1/surfaces/{number}", headers={"authorization": f"Bearer {number}"})
    new = [name for name in set(figures(http)) - before if name[0] == "lodestream_requests_total"]
    assert {name[1] for name in new} <= {"GET", "other"}
    assert {name[2] for name in new} <= {"none", "/v1/surfaces/{surface}", "/v1/surfaces"}


def test_an_answer_carries_its_id(http: httpx.Client, server: str, made: dict[str, Any]) -> None:
    given = http.get("/healthz").headers["x-request-id"]
    assert re.fullmatch("[0-9a-f]{16}", given)
    assert http.get("/healthz").headers["x-request-id"] != given
    assert http.get("/nowhere", headers={"x-request-id": "mine.1_2-3"}).headers["x-request-id"] == "mine.1_2-3"
    for unusable in ("", "a b", "x" * 65, 'a"b', "a,b"):
        answer = http.get("/healthz", headers={"x-request-id": unusable})
        assert re.fullmatch("[0-9a-f]{16}", answer.headers["x-request-id"])
    with raw_stream(server + made["url"], additional_headers={"x-request-id": "stream-1"}) as stream:
        assert stream.socket.response is not None
        assert stream.socket.response.headers["x-request-id"] == "stream-1"
    with pytest.raises(InvalidStatus) as refused, raw_stream(server + made["url"], subprotocols=None):
        pass
    assert refused.value.response.headers["x-request-id"]


def formatted(style: str, log: logging.Logger, say: Any) -> str:
    handler = logging.StreamHandler(io.StringIO())
    root = logging.getLogger()
    before = root.handlers, root.level
    try:
        logs.configure(style, "info")
        formatter = root.handlers[0].formatter
        handler.setFormatter(formatter)
        root.handlers = [handler]
        log.setLevel(logging.DEBUG)
        say(log)
    finally:
        root.handlers = before[0]
        root.setLevel(before[1])
    written: str = handler.stream.getvalue()
    return written


def test_lines_are_lines_whatever_strangers_say() -> None:
    def say(log: logging.Logger) -> None:
        logs.event(log, "request", path="/a\nERROR forged\x1b[2J", status=404, seconds=0.12345678, nothing=None)
        log.warning("bad name %s", "x\r\nforged\u2028")

    log = logging.getLogger("tests.server.lines")
    text = formatted("text", log, say).splitlines()
    assert len(text) == 2
    assert 'path="/a\\nERROR forged\\u001b[2J" status=404 seconds=0.123457' in text[0]
    assert "nothing" not in text[0]
    assert "\\r\\nforged" in text[1]
    documents = [json.loads(line) for line in formatted("json", log, say).splitlines()]
    assert [document["message"] for document in documents] == ["request", "bad name x\r\nforged\u2028"]
    assert documents[0]["path"] == "/a\nERROR forged\x1b[2J"
    assert documents[0]["level"] == "info"


def test_an_error_keeps_its_traceback() -> None:
    def say(log: logging.Logger) -> None:
        try:
            raise ZeroDivisionError("here\n2026-01-01 ERROR forged\x1b[2J")
        except ZeroDivisionError:
            log.exception("failed")

    log = logging.getLogger("tests.server.errors")
    first, *rest = formatted("text", log, say).splitlines()
    assert first.endswith("ERROR tests.server.errors: failed")
    assert all(line.startswith("    ") and line.isprintable() for line in rest)
    assert "    ZeroDivisionError: here" in rest
    assert "ZeroDivisionError: here" in json.loads(formatted("json", log, say))["error"]


SCRIPT = """
import argparse, sys
from lodestream_server.commands.serve import register
if __name__ == "__main__":
    parser = argparse.ArgumentParser()
    register(parser.add_subparsers())
    args = parser.parse_args()
    sys.exit(args.run(args))
"""


@contextmanager
def serving(tmp_path: Path, *arguments: str) -> Iterator[tuple[subprocess.Popen[str], str, Path]]:
    """A server in a process of its own, its address, and its log."""
    script, log = tmp_path / "serve.py", tmp_path / "log"
    script.write_text(SCRIPT)
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join(filter(None, sys.path)), "LODESTREAM_WORKERS": "1"}
    command = [sys.executable, str(script), "serve", "--port", "0", "--data", str(tmp_path / "data"), *arguments]
    with (
        log.open("w") as written,
        subprocess.Popen(command, env=environment, stderr=written, text=True) as process,
    ):
        try:
            found = eventually(lambda: re.search(r"^Lodestream serving (\S+)$", log.read_text(), re.M), "an address")
            yield process, found[1], log
        finally:
            process.kill()


def last_word(stream: Raw) -> int | None:
    """The close code that comes after everything else."""
    while True:
        try:
            stream.receive()
        except ConnectionClosed as over:
            return None if over.rcvd is None else over.rcvd.code


def test_told_to_end_a_server_ends_whatever_is_under_way(tmp_path: Path) -> None:
    with ExitStack() as running:
        process, url, log = running.enter_context(serving(tmp_path, "--log-format", "json"))
        http = running.enter_context(httpx.Client(base_url=url, trust_env=False, timeout=PATIENCE))
        made = push(http, npy(hills(90, 80)))
        # Streams that wait, one that never reads, an upload that does not go on, a build that takes its time.
        waiting = running.enter_context(raw_stream(url + made["url"], additional_headers={"x-request-id": "waits"}))
        waiting.send(Open(credit=100))
        assert isinstance(waiting.receive(), Opened)
        silent = running.enter_context(raw_stream(url + made["url"], close_timeout=0.1))
        silent.send(Open())
        address = urlsplit(url)
        upload = running.enter_context(socket.create_connection((address.hostname, address.port), timeout=PATIENCE))
        upload.sendall(
            f"POST /v1/surfaces HTTP/1.1\r\nHost: {address.netloc}\r\nContent-Length: 100000\r\n\r\nxxx".encode()
        )
        queued = http.post("/v1/surfaces", content=npy(hills(900, 900, seed=2)))
        assert queued.status_code == 202
        process.send_signal(signal.SIGTERM)
        assert last_word(waiting) == 1012
        answer = b""
        while piece := upload.recv(65536):
            answer += piece
        assert answer.startswith(b"HTTP/1.1 503 ")
        assert b"retry-after" in answer
        assert process.wait(PATIENCE) in (0, -signal.SIGTERM)
        lines = log.read_text().splitlines()
    said = [json.loads(line) for line in lines if line.startswith("{")]
    streams = [line for line in said if line.get("surface") == made["id"] and line.get("request") == "waits"]
    assert [line["message"] for line in streams] == ["stream opened", "stream ended"]
    assert streams[1]["result"] == "restarting"
    assert streams[1]["bytes"] == 100
    assert not any("Traceback" in line for line in lines)
    # What was acknowledged is taken up again.
    with serving(tmp_path) as (_, url, _), httpx.Client(base_url=url, trust_env=False, timeout=PATIENCE) as http:
        found = http.get(queued.headers["location"]).json()
        assert found["state"] in ("queued", "building", "ready")
        assert http.get(made["url"]).json() == made


def asked_until_cancelled(app: ASGIApp, kind: str = "http") -> tuple[list[Message], bool]:
    """What `Observation` sends for a request that is cancelled once it waits, and whether it ends as cancelled."""
    sent: list[Message] = []
    state = SimpleNamespace(metrics=Metrics())
    scope = {"type": kind, "method": "GET", "path": "/x", "headers": [], "app": SimpleNamespace(state=state)}

    async def receive() -> Message:
        return {"type": "http.disconnect"}

    async def send(message: Message) -> None:
        sent.append(message)

    async def ask() -> bool:
        task = asyncio.ensure_future(Observation(app, state.metrics, log_reads=False)(scope, receive, send))
        await asyncio.sleep(0.01)
        task.cancel("the server ends")
        await asyncio.wait((task,))
        return task.cancelled()

    return sent, asyncio.run(ask())


async def hang(scope: Scope, receive: Receive, send: Send) -> None:
    await asyncio.sleep(PATIENCE)


def test_a_request_that_outlasts_the_server_is_told_to_come_back(caplog: pytest.LogCaptureFixture) -> None:
    with caplog.at_level(logging.INFO):
        (start, body), cancelled = asked_until_cancelled(hang)
    assert not cancelled
    assert start["status"] == 503
    headers = dict(start["headers"])
    assert headers[b"retry-after"] == b"5"
    assert headers[b"x-request-id"]
    assert json.loads(body["body"])["code"] == "restarting"
    assert [logs._fields(record)["status"] for record in caplog.records if record.getMessage() == "request"] == [503]


def test_an_answer_that_has_begun_is_not_begun_again() -> None:
    async def begin(scope: Scope, receive: Receive, send: Send) -> None:
        await send({"type": "http.response.start", "status": 200, "headers": []})
        await hang(scope, receive, send)

    sent, cancelled = asked_until_cancelled(begin)
    assert [message["type"] for message in sent] == ["http.response.start"]
    assert cancelled


def test_a_stream_that_is_cut_off_gets_no_answer_of_http() -> None:
    assert asked_until_cancelled(hang, "websocket") == ([], True)


def test_a_request_whose_own_work_was_cancelled_is_a_fault() -> None:
    async def fail(scope: Scope, receive: Receive, send: Send) -> None:
        raise asyncio.CancelledError

    assert asked_until_cancelled(fail) == ([], True)


def test_the_log_tells_of_requests_that_write_but_not_of_tokens(tmp_path: Path) -> None:
    with serving(tmp_path) as (_, url, log):
        with httpx.Client(base_url=url, trust_env=False, timeout=PATIENCE) as http:
            http.get("/v1/surfaces?token=secret-1", headers={"authorization": "Bearer secret-2"})
            headers = {"authorization": "Bearer secret-3", "x-request-id": "r-7"}
            http.delete("/v1/surfaces/0?token=secret-4", headers=headers)
        eventually(lambda: "r-7" in log.read_text(), "the line")
        text = log.read_text()
    line = next(line for line in text.splitlines() if "r-7" in line)
    assert "method=DELETE path=/v1/surfaces/0 status=422" in line
    assert "client=127.0.0.1" in line
    assert "secret" not in text
    assert "method=GET" not in text


@pytest.mark.parametrize(
    ("method", "status", "log_reads", "level"),
    [
        ("GET", 200, False, logging.DEBUG),
        ("HEAD", 404, False, logging.DEBUG),
        ("GET", 503, False, logging.INFO),
        ("POST", 202, False, logging.INFO),
        ("GET", 200, True, logging.INFO),
        ("HEAD", 304, True, logging.INFO),
        ("POST", 202, True, logging.INFO),
    ],
)
def test_reads_are_logged_at_info_when_asked_for(
    method: str, status: int, log_reads: bool, level: int, caplog: pytest.LogCaptureFixture
) -> None:
    async def answered(scope: Scope, receive: Receive, send: Send) -> None:
        await Response(status_code=status)(scope, receive, send)

    async def ask() -> None:
        watched = Observation(answered, Metrics(), log_reads=log_reads)
        async with httpx.AsyncClient(transport=httpx.ASGITransport(watched), base_url="http://x") as client:
            await client.request(method, "/v1/surfaces")

    with caplog.at_level(logging.DEBUG, "lodestream_server"):
        asyncio.run(ask())
    assert [record.levelno for record in caplog.records if record.getMessage() == "request"] == [level]


@contextmanager
def log_to_pipe(style: str = "text") -> Iterator[tuple[logs._Queue, int]]:
    """The handler of a log that is written to a pipe, and the end of the pipe that is read."""
    read, write = os.pipe()
    handler = logs._Queue(write)
    handler.setFormatter(logs._Json() if style == "json" else logs._Text())
    thread = handler._writer._thread
    assert thread is not None
    try:
        yield handler, read
    finally:
        # A thread that hangs in a write goes on once there is nobody to write to; it may have been told to end already.
        os.close(read)
        handler._writer.enqueue_sentinel()
        thread.join(PATIENCE)
        os.close(write)


def line(text: str = "here") -> logging.LogRecord:
    return logging.LogRecord("x", logging.INFO, "", 0, text, None, None)


@pytest.mark.parametrize("style", ["text", "json"])
def test_a_log_that_nobody_reads_stops_nobody(style: str) -> None:
    with log_to_pipe(style) as (handler, read):
        started = time.monotonic()
        for _ in range(20_000):
            handler.handle(line("l" * 100))
        assert time.monotonic() - started < PATIENCE
        assert handler._lines.qsize() <= 10_000
        # Now somebody does. Some may have been lost already before the pipe was full.
        taken, lost, until = b"", 0, time.monotonic() + PATIENCE
        while lost <= 9000 and time.monotonic() < until:
            taken += os.read(read, 1 << 16)
            handler.handle(line())
            lost = sum(map(int, re.findall(rb"(\d+) log lines were dropped, because", taken)))
        assert 9000 < lost < 20_000
        assert taken.count(b"l" * 100) + lost >= 20_000
        told = next(each for each in taken.splitlines() if b"were dropped" in each)
        assert (json.loads(told)["level"] == "warning") if style == "json" else (b" WARNING lodestream_server." in told)


def test_the_end_of_the_log_waits_for_its_reader_only_so_long() -> None:
    with log_to_pipe() as (handler, read):
        for _ in range(100):
            handler.handle(line())
        handler.end()
        assert os.read(read, 1 << 16).count(b"x: here\n") == 100
    with log_to_pipe() as (handler, read):
        for _ in range(20_000):
            handler.handle(line("l" * 100))
        started = time.monotonic()
        handler.end()
        assert time.monotonic() - started < PATIENCE / 2
        # What it has not said so far it says now, should somebody read on.
        taken = b""
        while b"log lines were dropped, because" not in taken:
            taken += os.read(read, 1 << 16)


def test_no_line_is_lost_where_writing_does_not_wait() -> None:
    with log_to_pipe() as (handler, read):
        os.set_blocking(handler._writer._descriptor, False)
        for _ in range(1000):
            handler.handle(line("l" * 1000))
        handler.end()  # most of it is not written yet
        taken = b""
        while taken.count(b"\n") < 1000:
            taken += os.read(read, 1 << 20)
        assert taken.count(b": " + b"l" * 1000 + b"\n") == 1000


def test_a_log_that_was_ended_is_no_longer_written_to(monkeypatch: pytest.MonkeyPatch) -> None:
    root = logging.getLogger()
    monkeypatch.setattr(root, "handlers", [])
    before = root.level
    try:
        logs.configure("text", "info")
        (handler,) = root.handlers
        assert isinstance(handler, logs._Queue)
        logs.drain()
        assert root.handlers == []
        logs.drain()
    finally:
        root.setLevel(before)


def test_a_lack_of_files_is_told_once_a_minute_and_what_strangers_send_not_at_all() -> None:
    worth = logs._Worth()
    lack = [line(f"socket.accept() out of system resource\nsocket: {number}") for number in range(3)]
    lack[2].created = lack[0].created + 61
    assert [worth.filter(record) for record in lack] == [True, False, True]
    assert not worth.filter(line("Invalid HTTP request received."))
    assert worth.filter(line("anything else"))
    odd = line()
    odd.msg = ["of", "a", "library"]
    assert worth.filter(odd)


def test_lines_of_threads_have_the_id_of_their_request() -> None:
    async def ask(handler: logging.Handler) -> None:
        async def one(name: str) -> None:
            logs.new_request(name)
            await asyncio.to_thread(handler.handle, line(f"of {name}"))

        await asyncio.gather(one("r-1"), one("r-2"))

    with log_to_pipe("json") as (handler, read):
        asyncio.run(ask(handler))
        handler.handle(line("of none"))
        handler.end()
        said = [json.loads(each) for each in os.read(read, 1 << 16).splitlines()]
    assert {each["message"]: each.get("request") for each in said} == {
        "of r-1": "r-1",
        "of r-2": "r-2",
        "of none": None,
    }


def test_links_and_clients_behind_a_proxy(tmp_path: Path) -> None:
    arguments = {"root_path": "/maps", "trusted_proxies": ("127.0.0.1",), "public_reads": True}
    with (
        running_server(tmp_path, workers=1, **arguments) as url,
        httpx.Client(base_url=url, trust_env=False, timeout=PATIENCE) as http,
    ):
        answer = http.get("/v1/surfaces", headers={"x-forwarded-for": "192.0.2.1", "x-forwarded-proto": "https"})
        assert answer.status_code == 200
        assert http.get("/docs").status_code == 200
        assert "/maps/openapi.json" in http.get("/docs").text
        refused = http.post("/v1/surfaces", content=b"x")
        assert (refused.status_code, refused.json()["type"]) == (401, "/maps/errors#no-token")
