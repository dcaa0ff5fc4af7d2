"""The real server and client over emulated links, beside each peer's file and the raw array by HTTP."""

from __future__ import annotations

import contextlib
import json
import os
import re
import statistics
import subprocess
import sys
import tempfile
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import lodestream
from lodestream_client import Client

from ..arrays import ROOT
from ..server import Server
from ..wire import Wire
from .curves import Results, Row
from .registry import PEERS
from .seconds import ERRORS, LINKS
from .surfaces import specimen

__all__ = ["FAMILIES", "RAW", "SURFACE", "TRIPS", "chosen", "measure"]

SURFACE = "bigtujunga.tif"
TRIPS = (0.005, 0.02, 0.1)
FAMILIES = ("JPEG XL", "JPEG 2000", "HTJ2K", "SPERR", "SZ3", "LERC", "pcodec")
RAW = "raw"
ROUNDS = 3
#: At this link one round is enough, and the number of threads does not matter.
SLOWEST = LINKS[0]


def chosen(results: Results, surface: str) -> dict[float, dict[str, tuple[str, str]]]:
    """Coder and setting of each family's smallest stream that meets each error."""
    found: dict[float, dict[str, tuple[str, str]]] = {}
    for error in ERRORS:
        for name in FAMILIES:
            some = [
                (row["bytes"], coder, row["setting"])
                for coder in PEERS
                if coder.startswith(name)
                for row in results.rows(surface, coder)
                if _meets(row, error)
            ]
            if some:
                found.setdefault(error, {})[name] = min(some)[1:]
    return found


def _meets(row: Row, error: float) -> bool:
    return bool(row["rms"] <= error and (error or not row["max"]))


def measure(results: Results, surface: str = SURFACE) -> dict[str, Any]:
    """Seconds of each way, by number of threads, link, round trip and error."""
    picked = chosen(results, surface)
    settings: dict[str, list[str]] = {}
    for by_family in picked.values():
        for coder, setting in by_family.values():
            if setting not in settings.setdefault(coder, []):
                settings[coder].append(setting)
    coders = list(settings)
    files = {
        error: {
            name: f"{coders.index(coder)}-{settings[coder].index(setting)}" for name, (coder, setting) in some.items()
        }
        for error, some in picked.items()
    }
    found: list[dict[str, Any]] = []
    with contextlib.ExitStack() as stack:
        folder = Path(stack.enter_context(tempfile.TemporaryDirectory()))
        shared = folder / "files"
        shared.mkdir()
        points = specimen(surface).points
        (shared / RAW).write_bytes(points.tobytes())
        server = Server(folder)
        stack.callback(server.close)
        url = Client(server.url).upload(lodestream.Surface(points)).url
        plain = stack.enter_context(_plain(shared))
        for threads in dict.fromkeys((1, os.cpu_count() or 1)):
            asked = {"surface": surface, "peers": settings, "folder": str(shared)}
            with _client(asked, threads) as client:
                for rate in LINKS:
                    if rate == SLOWEST and threads > 1:
                        continue
                    for trip in TRIPS:
                        with Wire(url, rate, trip) as ours, Wire(plain, rate, trip) as theirs:
                            cell = {"threads": threads, "rate": rate, "trip": trip}
                            rounds = 1 if rate == SLOWEST else ROUNDS
                            found += _cells(client, (ours.url(url), theirs.url(plain)), files, cell, rounds)
    load = os.getloadavg()[0] if hasattr(os, "getloadavg") else None
    return {"surface": surface, "cells": found, "load": load, "processors": os.cpu_count()}


def _cells(
    client: subprocess.Popen[str],
    urls: tuple[str, str],
    files: dict[float, dict[str, str]],
    cell: dict[str, Any],
    rounds: int,
) -> Iterator[dict[str, Any]]:
    """Each error over one link: medians of rounds, in which all take turns."""
    ours, plain = urls
    raw: list[tuple[float, float]] = []
    for error, names in files.items():
        ways: dict[str, dict[str, Any]] = {"ours": {"way": "stream", "url": ours, "error": error}}
        for family, name in names.items():
            ways[family] = {"way": "file", "name": name, "url": f"{plain}/{name}"}
        if not raw:  # the same for all errors
            ways[RAW] = {"way": RAW, "url": f"{plain}/{RAW}"}
        told: dict[str, list[tuple[float, float]]] = {name: [] for name in ways}
        for _ in range(rounds):
            for name, asked in ways.items():
                wall, spent = _ask(client, asked)
                told[name].append((wall, spent))
        raw = raw or told[RAW]
        told[RAW] = raw
        seconds, processor = (
            {name: statistics.median(pair[which] for pair in pairs) for name, pairs in told.items()} for which in (0, 1)
        )
        yield cell | {"error": error, "seconds": seconds, "processor": processor}


def _ask(client: subprocess.Popen[str], asked: dict[str, Any]) -> Any:
    assert client.stdin is not None
    assert client.stdout is not None
    print(json.dumps(asked), file=client.stdin, flush=True)
    line = client.stdout.readline()
    if not line:
        raise RuntimeError(f"expected an answer to {asked}, and the receiver ended")
    return json.loads(line)


@contextlib.contextmanager
def _client(asked: dict[str, Any], threads: int) -> Iterator[subprocess.Popen[str]]:
    environment = {**os.environ, "LODESTREAM_THREADS": str(threads), "OPJ_NUM_THREADS": str(threads)}
    command = [sys.executable, "-m", "benchmarks.peers.client"]
    with subprocess.Popen(
        command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True, cwd=ROOT, env=environment
    ) as client:
        try:
            _ask(client, asked)
            yield client
        finally:
            assert client.stdin is not None
            client.stdin.close()


@contextlib.contextmanager
def _plain(folder: Path) -> Iterator[str]:
    """Files by HTTP, from a process of its own."""
    command = [sys.executable, "-u", "-m", "http.server", "0", "--bind", "127.0.0.1", "--directory", str(folder)]
    command += ["--protocol", "HTTP/1.1"]
    with subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL, text=True) as server:
        try:
            assert server.stdout is not None
            line = server.stdout.readline()
            port = re.search(r"port (\d+)", line)
            if port is None:
                raise RuntimeError(f"expected a port, got {line!r}")
            yield f"http://127.0.0.1:{port[1]}"
        finally:
            server.terminate()
