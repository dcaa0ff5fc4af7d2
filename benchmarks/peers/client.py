"""A receiver in a process of its own: ``python -m benchmarks.peers.client``, with its work as JSON on standard input.

The first line names the surface, the settings of each peer, and the folder for their files; after it, each line is one
thing to receive, and is answered by the seconds from the connection to the points: by the clock, and of this process's
processors.
"""

from __future__ import annotations

import http.client
import json
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any
from urllib.parse import urlsplit

import numpy as np
from numpy.typing import NDArray

import lodestream as ls
from lodestream_client import Client

from .registry import function_of
from .surfaces import Specimen, specimen
from .trial import Restore, Streams, Trial

Decode = Callable[[Streams], NDArray[Any]]


class Kept(Trial):
    """Makes the streams of some settings, and keeps them with what decodes them."""

    def __init__(self, surface: Specimen, wanted: list[str]) -> None:
        super().__init__(surface)
        self.kept: dict[str, tuple[Streams, Decode]] = {}
        self._wanted = wanted

    def case(
        self,
        setting: str,
        encode: Callable[[], Streams],
        decode: Decode,
        side: int = 0,
        restore: Restore | None = None,
    ) -> None:
        """Encode what is wanted."""
        if setting in self._wanted:
            self.kept[setting] = (encode(), decode)

    def decoded(
        self,
        setting: str,
        streams: Streams,
        decode: Decode,
        encoding: tuple[float, int | None],
        side: int = 0,
        restore: Restore | None = None,
    ) -> None:
        """Keep what is wanted."""
        if setting in self._wanted:
            self.kept[setting] = (streams, decode)


def main() -> None:
    """Prepare, and answer."""
    asked = json.loads(sys.stdin.readline())
    surface = specimen(asked["surface"])
    decoders: dict[str, Decode] = {}
    for number, (coder, settings) in enumerate(asked["peers"].items()):
        trial = Kept(surface, settings)
        function_of(coder)(trial)
        for setting, (streams, decode) in trial.kept.items():
            name = f"{number}-{settings.index(setting)}"
            Path(asked["folder"], name).write_bytes(b"".join(streams))
            decode(streams)
            decoders[name] = decode
    ls.decode(ls.encode(np.zeros((5, 5))))  # loads what is imported when it is first needed
    print(json.dumps(sorted(decoders)), flush=True)
    for line in sys.stdin:
        print(json.dumps(_receive(json.loads(line), surface, decoders)), flush=True)


def _receive(asked: dict[str, Any], surface: Specimen, decoders: dict[str, Decode]) -> tuple[float, float]:
    """Seconds from the connection to the points, by the clock and of processors."""
    url, error = asked["url"], asked.get("error")
    start, spent = time.perf_counter(), time.process_time()
    if asked["way"] == "stream":
        points = _streamed(url, error)
    elif asked["way"] == "file":
        points = decoders[asked["name"]]([_fetched(url)])
    else:
        points = np.frombuffer(_fetched(url), surface.points.dtype)
    seconds = time.perf_counter() - start, time.process_time() - spent
    assert points.size == surface.points.size
    return seconds


def _streamed(url: str, error: float | None) -> NDArray[Any]:
    """Points of an RMS error relative to the extent, or all of them exact."""
    target = ls.Target(until_rms=ls.Tolerance(error, relative=True)) if error else None
    view = None
    with Client(url).connect(url, target=target) as stream:
        for view in stream:
            view.prepare()  # while the rest is on its way; the last one is what was waited for
    assert view is not None
    return view.points


def _fetched(url: str) -> bytes:
    parts = urlsplit(url)
    connection = http.client.HTTPConnection(parts.netloc, timeout=300)
    connection.request("GET", parts.path)
    answer = connection.getresponse()
    data = answer.read()
    connection.close()
    assert answer.status == 200, answer.reason
    return data


if __name__ == "__main__":
    main()
