"""A server on a disk of a megabyte or two: filled, emptied and filled again, until what stayed is compared."""

from __future__ import annotations

import random
import shutil
import subprocess
import time
from dataclasses import dataclass
from pathlib import Path
from typing import Any, TypeAlias

import httpx
import numpy as np
from numpy.typing import NDArray

import lodestream as ls
from tests.server.helpers import eventually, hills, npy
from tests.server.programs import server

__all__ = ["SmallDisk", "can_mount", "run"]

_Stored: TypeAlias = dict[str, NDArray[np.float32]]

# With so much room beside what was uploaded its container fits, and the page or two of what is written down of it.
_MARGIN = 1.2
_MARGIN_BYTES = 32 << 10


@dataclass
class SmallDisk:
    """What happened.

    Attributes
    ----------
    uploads, refused, deletes : int
        Answered 202 or 200, 507, and 204.
    kept : int
        Surfaces that were there at the end, each as it was uploaded.
    """

    uploads: int = 0
    refused: int = 0
    deletes: int = 0
    kept: int = 0
    seconds: float = 0.0


def can_mount() -> bool:
    """Whether a small disk can be had: in name spaces of its own, which asks nobody's permission on most machines."""
    if shutil.which("unshare") is None:
        return False
    command = ["unshare", "-Urm", "mount", "-t", "tmpfs", "-o", "size=1m", "tmpfs", "/tmp"]
    return subprocess.run(command, capture_output=True, check=False).returncode == 0


def run(folder: Path, count: int, seconds: float | None = None, *, seed: int = 1, size: str = "1m") -> SmallDisk:
    """Fill and empty a small disk by so many requests, or as many as the seconds allow.

    Raises
    ------
    AssertionError
        When an answer is another than that it is stored or that there is no room, or what was stored is another.
    """
    disk = folder / "disk"
    disk.mkdir()
    mount = f'mount -t tmpfs -o size={size} tmpfs "{disk}" && exec "$0" "$@"'
    random_, done, started = random.Random(seed), SmallDisk(), time.monotonic()
    stored: _Stored = {}
    with (
        server(disk, ["unshare", "-Urm", "sh", "-c", mount], keep_free=0) as running,
        running.client() as http,
    ):
        for number in range(count):
            if seconds is not None and time.monotonic() - started > seconds:
                break
            if stored and random_.random() < 0.3:
                location = random_.choice(sorted(stored))
                _asked(http, "DELETE", location).raise_for_status()
                del stored[location]
                done.deletes += 1
                continue
            points = hills(random_.randrange(20, 200), random_.randrange(20, 200), seed=number)
            answer = _asked(http, "POST", "/v1/surfaces", content=npy(points))
            # Either the server saw that there is too little room, or the disk said so.
            assert answer.status_code in (202, 507), answer.text
            if answer.status_code == 202:
                stored[answer.headers["location"]] = points
                done.uploads += 1
            else:
                done.refused += 1
        _compare(http, stored, done, random_)
    done.seconds = time.monotonic() - started
    return done


def _compare(
    http: httpx.Client, stored: dict[str, NDArray[np.float32]], done: SmallDisk, random_: random.Random
) -> None:
    entries = _asked(http, "GET", "/v1/surfaces?limit=1000").raise_for_status().json()["surfaces"]
    assert sorted(entry["url"] for entry in entries) == sorted(stored)
    # Where there is no room for a container its build waits until there is: that is made here.
    while waiting := [location for location in stored if _waits(http, location)]:
        location = random_.choice(waiting)
        _asked(http, "DELETE", location).raise_for_status()
        del stored[location]
    for location, points in stored.items():
        container = _asked(http, "GET", f"{location}/container", follow_redirects=True).raise_for_status().content
        assert np.array_equal(ls.decode(container).points, points)
    done.kept = len(stored)


def _waits(http: httpx.Client, location: str) -> bool:
    return eventually(lambda: _settled(http, location), "the build to end or to wait") == "waits"


def _settled(http: httpx.Client, location: str) -> str | None:
    entry = _asked(http, "GET", location).raise_for_status().json()
    assert entry["state"] != "failed", entry
    if entry["state"] == "queued":
        # What has room may not have been tried again since another was deleted. Where there is none, there may be none
        # to note the reason either.
        return "waits" if _free(http) < _MARGIN * entry["upload_bytes"] + _MARGIN_BYTES else None
    return "ready" if entry["state"] == "ready" else None


def _asked(http: httpx.Client, method: str, url: str, **given: Any) -> httpx.Response:
    """Ask, and again while the index is made again: where there is no room for it at all, it is removed."""
    return eventually(lambda: _unless_busy(http.request(method, url, **given)), "an answer")


def _unless_busy(answer: httpx.Response) -> httpx.Response | None:
    return None if answer.status_code == 503 else answer


def _free(http: httpx.Client) -> float:
    """Bytes that are free on the server's disk."""
    lines = http.get("/metrics").raise_for_status().text.splitlines()
    (line,) = (line for line in lines if line.startswith("lodestream_disk_free_bytes "))
    return float(line.split()[1])
