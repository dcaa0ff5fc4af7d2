"""Builds that misbehave, for the build processes of the tests: they are found there by their names."""

from __future__ import annotations

import os
import signal
import time

from lodestream_server.worker import Built, Job, Refused, build

__all__ = ["end_once", "explode", "kill", "wait"]


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
