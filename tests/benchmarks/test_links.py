"""Streams over emulated links: what is compared, and the link itself."""

from __future__ import annotations

import socket
import threading
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.peers.client import Kept
from benchmarks.peers.curves import Results
from benchmarks.peers.linked import best, linked
from benchmarks.peers.links import chosen
from benchmarks.peers.surfaces import Specimen
from benchmarks.peers.trial import Trial, stacked
from benchmarks.wire import Wire, piece, room


def _row(setting: str, size: int, rms: float) -> dict[str, Any]:
    return {"setting": setting, "bytes": size, "rms": rms, "max": 4 * rms}


def test_each_family_sends_its_smallest_stream_that_meets_the_error() -> None:
    runs = {
        "hill|JPEG 2000 9/7, layers": {"rows": [_row("3 layers", 100, 1e-2), _row("9 layers", 900, 1e-4)]},
        "hill|JPEG 2000 5/3, layers": {"rows": [_row("8 layers", 800, 1e-4), _row("10 layers", 2000, 0.0)]},
        "hill|LERC": {"rows": [_row("lossless", 3000, 0.0)]},
    }
    found = chosen(Results({"surfaces": {"hill": {}}, "runs": runs}), "hill")
    assert found[1e-3] == {
        "JPEG 2000": ("JPEG 2000 5/3, layers", "8 layers"),
        "LERC": ("LERC", "lossless"),
    }
    assert found[0.0]["JPEG 2000"] == ("JPEG 2000 5/3, layers", "10 layers")


def test_the_raw_array_is_no_peer() -> None:
    cell = {"seconds": {"ours": 0.5, "raw": 0.1, "LERC": 0.3, "SZ3": 0.2}}
    assert best(cell) == ("SZ3", 0.2)


def test_the_table_has_both_numbers_of_threads() -> None:
    cells = [
        {
            "threads": threads,
            "rate": 1e8,
            "trip": 0.02,
            "error": 0.0,
            "seconds": {"ours": 0.3 / threads, "raw": 0.4, "LERC": 0.3},
            "processor": {"ours": 0.25},
        }
        for threads in (1, 2)
    ]
    data = {"links": {"surface": "hill", "date": "today", "load": None, "processors": 2, "cells": cells}}
    lines = list(linked(Results(data | {"surfaces": {}, "runs": {}})))
    assert "### Over emulated links: all 2 cores" in "\n".join(lines)
    exact = [line for line in lines if line.startswith("| 100 Mbit/s, 20 ms, exact")]
    assert [line.split(" | ")[-1] for line in exact] == ["1.000 |", "0.500 |"]


def test_pieces_are_packets_on_slow_links_and_bounded_on_fast_ones() -> None:
    assert piece(1e6 / 8) == 1400
    assert piece(1e8 / 8) == 6250
    assert piece(1e12) == 1 << 16


def test_a_slow_link_has_64_kib_of_queue() -> None:
    assert room(1 << 13) == 8.0
    assert room(1e9) == 0.005


def test_a_link_carries_both_ways_until_their_ends() -> None:
    with socket.create_server(("127.0.0.1", 0)) as listening:
        port = listening.getsockname()[1]
        heard = bytearray()

        def serve() -> None:
            connection, _ = listening.accept()
            with connection:
                while data := connection.recv(1 << 16):
                    heard.extend(data)
                connection.sendall(bytes(reversed(heard)))

        thread = threading.Thread(target=serve)
        thread.start()
        sent = bytes(range(256)) * 1000
        with Wire(f"http://127.0.0.1:{port}", 1e9, 0.002) as link:
            address = link.url(f"http://127.0.0.1:{port}/file")
            assert address.endswith("/file")
            with socket.create_connection(("127.0.0.1", int(address.split(":")[2].partition("/")[0]))) as client:
                client.sendall(sent)
                client.shutdown(socket.SHUT_WR)
                answer = b"".join(iter(lambda: client.recv(1 << 16), b""))
        thread.join()
    assert bytes(heard) == sent
    assert answer == sent[::-1]


def _surface() -> Specimen:
    points = np.arange(12, dtype=np.int16).reshape(3, 4)
    return Specimen("steps", "tiny", "", (False, False), points)


def _code(trial: Trial) -> None:
    numbers = trial.surface.points
    for setting in ("one", "two"):
        trial.case(
            setting,
            lambda: [numbers.tobytes()],
            lambda streams: stacked([np.frombuffer(streams[0], np.int16).reshape(3, 4)]),
            8,
            lambda found: found.astype(np.float64),
        )
    trial.case("broken", lambda: [b""], lambda _: np.zeros(0))


def test_a_trial_writes_its_rows_and_what_failed(tmp_path: Path) -> None:
    trial = Trial(_surface(), tmp_path / "run.json")
    _code(trial)
    assert [(row["setting"], row["bytes"], row["rms"]) for row in trial.rows] == [("one", 32, 0.0), ("two", 32, 0.0)]
    assert [note.partition(":")[0] for note in trial.notes] == ["broken"]
    assert '"setting": "two"' in (tmp_path / "run.json").read_text()


def test_a_receiver_keeps_the_streams_that_it_is_to_decode() -> None:
    trial = Kept(_surface(), ["two"])
    _code(trial)
    assert list(trial.kept) == ["two"]
    streams, decode = trial.kept["two"]
    assert np.array_equal(decode(streams)[..., 0], _surface().points)
    assert not trial.rows
