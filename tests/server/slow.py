"""Builds that misbehave, for the build processes of the tests: they are found there by their names."""

from __future__ import annotations

import os
import signal
import time
from pathlib import Path

from lodestream_server import durable
from lodestream_server.worker import Built, Job, Refused, build
from tests.server.disks import FullDisk

__all__ = [
    "end_once",
    "explode",
    "full_at_each_step",
    "hoard",
    "kill",
    "kill_once",
    "number",
    "raise_error",
    "sleep",
    "wait",
]


def number() -> int:
    """The process that is asked."""
    return os.getpid()


def sleep(begun: Path) -> None:
    """Say who sleeps, then sleep for longer than any test waits."""
    new = begun.with_suffix(".new")
    new.write_text(str(os.getpid()))
    new.replace(begun)
    time.sleep(600)


def raise_error(error: BaseException) -> None:
    """Raise what is given."""
    raise error


def wait(job: Job) -> Built | Refused:
    """Report half, then go on when a file called ``go`` appears beside the surfaces' folders."""
    (job.folder / "progress").write_text("0.5")
    go = job.folder.parent.parent / "go"
    until = time.monotonic() + 60
    while not go.exists():
        if time.monotonic() > until:
            return Refused("nobody said go")
        time.sleep(0.01)
    return build(job)


def kill(job: Job) -> Built | Refused:
    """End as the kernel ends a process that takes too much memory."""
    os.kill(os.getpid(), signal.SIGKILL)
    return Refused("survived")


def end_once(job: Job) -> Built | Refused:
    """Be told to end the first time, as all processes of a service are that is stopped."""
    marker = job.folder.parent.parent / "told"
    if not marker.exists():
        marker.touch()
        os.kill(os.getpid(), signal.SIGTERM)
        time.sleep(60)
    return build(job)


def explode(job: Job) -> Built | Refused:
    """Raise what nobody foresaw."""
    raise ZeroDivisionError(f"with a secret: {job.folder}")


def kill_once(job: Job) -> Built | Refused:
    """Be killed the first time."""
    marker = job.folder.parent.parent / "killed"
    if not marker.exists():
        marker.touch()
        os.kill(os.getpid(), signal.SIGKILL)
    return build(job)


def hoard(job: Job) -> Built | Refused:
    """Take more memory than a process of the tests may have."""
    return Refused(f"got {len(bytearray(2 << 30))} bytes")


def full_at_each_step(job: Job) -> Built | Refused:
    """Find the disk full at the first step of writing the container, the next time at the second, and so on."""
    marker = job.folder.parent.parent / "fuller"
    done = int(marker.read_text()) if marker.exists() else 0
    marker.write_text(str(done + 1))
    durable.disk = FullDisk(done)
    return build(job)
