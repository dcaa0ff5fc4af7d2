"""What the process of a build might do whose reader a file has taken over: found there by their names."""

from __future__ import annotations

import base64
import ctypes
import fcntl
import hashlib
import json
import mmap
import os
import pickle
import resource
import socket
import subprocess
import sys
import threading
import time
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path
from typing import NoReturn

import numpy as np

from lodestream.errors import Choice
from lodestream.library import library
from lodestream.parallel import VARIABLE
from lodestream_server.builds import worker
from lodestream_server.builds.answers import Refusal
from lodestream_server.builds.levels import LevelJob, MadeLevel
from lodestream_server.builds.worker import Built, Job, Parsed, Refused, build
from tests.patience import PATIENCE

__all__ = [
    "burn",
    "dig",
    "escape",
    "forge_choices",
    "forge_container",
    "forge_errors",
    "forge_folder",
    "forge_hash",
    "forge_level",
    "forge_level_link",
    "forge_log",
    "forge_nothing",
    "forge_path",
    "forge_reason",
    "forge_second_name",
    "forge_thumbnail",
    "linger",
    "say_a_class",
    "say_deep",
    "say_garbage",
    "say_garbage_of_level",
    "say_much",
    "say_nothing",
    "say_pickle",
    "say_something_else",
    "trick_progress",
    "write_much",
]


def escape(job: Job) -> Built | Parsed | Refused:
    """Try every way out that a build should not have, and a few that it has; what came of each stands in the reason."""
    data, work = job.folder.parents[3], job.folder.parents[1]
    victim = data / "victim"
    trials: dict[str, Callable[[], object]] = {
        "read the upload": lambda: job.files[0].read_bytes(),
        "write the folder": lambda: (job.folder / "mine").write_text("x"),
        "read another file": victim.read_bytes,
        "read another by a link": lambda: _linked(job.folder / "link", victim),
        "link another": lambda: os.link(victim, job.folder / "hard"),
        "list the uploads": lambda: os.listdir(data / "uploads"),
        "list other builds": lambda: os.listdir(work),
        "read the passwords": lambda: Path("/etc/passwd").read_bytes(),
        "read the parent's environment": lambda: Path(f"/proc/{os.getppid()}/environ").read_bytes(),
        "write beside the folder": lambda: (work / "mine").write_text("x"),
        "write the temporary folder": lambda: Path("/tmp/lodestream-escaped").write_text("x"),
        "write another file": lambda: victim.write_text("x"),
        "cut another file": lambda: os.truncate(victim, 0),
        "cut the upload": lambda: os.open(job.files[0], os.O_RDONLY | os.O_TRUNC),
        "write the upload": lambda: job.files[0].write_bytes(b""),
        "change a mode": lambda: os.chmod(victim, 0),
        "change a time": lambda: os.utime(victim, (0, 0)),
        "change an owner": lambda: os.chown(victim, 1, 1),
        "remove another file": victim.unlink,
        "rename another file": lambda: victim.rename(job.folder / "taken"),
        "write the code": lambda: os.open(worker.__file__, os.O_WRONLY),
        "write the kernels": _write_kernels,
        "open a socket": socket.socket,
        "open a local socket": lambda: socket.socket(socket.AF_UNIX),
        "open a pair of sockets": socket.socketpair,
        "make a named pipe": lambda: os.mkfifo(job.folder / "pipe"),
        "fork": _fork,
        "execute": lambda: os.execv("/bin/true", ["true"]),
        "start a program": lambda: subprocess.run([sys.executable, "-c", ""], check=True),
        "start a thread": lambda: threading.Thread(target=int).start(),
        "signal the parent": lambda: os.kill(os.getppid(), 0),
        "signal everybody": lambda: os.kill(-1, 0),
        "signal the parent by a pipe": lambda: fcntl.fcntl(os.pipe()[0], fcntl.F_SETOWN, os.getppid()),
        "limit the parent": lambda: resource.prlimit(os.getppid(), resource.RLIMIT_CORE, (0, 0)),
        "slow the parent down": lambda: os.setpriority(os.PRIO_PROCESS, os.getppid(), 1),
        "slow everybody down": lambda: os.setpriority(os.PRIO_USER, 0, 1),
        "come before others": lambda: os.sched_setscheduler(0, os.SCHED_BATCH, os.sched_param(0)),
        "leave the group": os.setsid,
        "share memory": lambda: mmap.mmap(-1, 4096),
        "make memory a file": lambda: os.memfd_create("x"),
        "outlive the parent": _unfollow,
        "gain a privilege": lambda: os.setuid(1) if not os.getuid() else os.setuid(0),
        "raise a limit": _raise_limit,
        "open thousands of files": lambda: [os.open(job.files[0], os.O_RDONLY) for _ in range(5000)],
    }
    if os.environ.get(VARIABLE) != "1":
        del trials["start a thread"]  # which builds that have several may
    done, handles = [], _handles()
    for name, trial in trials.items():
        with suppress(OSError, ValueError, RuntimeError, subprocess.SubprocessError):
            trial()
            done.append(name)
    # Of the settings a build is told only how many threads it has.
    secrets = [name for name in os.environ if name.startswith("LODESTREAM") and name != VARIABLE]
    return Refused(json.dumps([done, handles, secrets]))


def _linked(link: Path, target: Path) -> bytes:
    link.symlink_to(target)
    return link.read_bytes()


def _write_kernels() -> None:
    (Path(library()._name).parent / "planted").write_text("x")


def _fork() -> None:
    if not os.fork():
        os._exit(0)


def _unfollow() -> None:
    if ctypes.CDLL(None).prctl(1, 0):
        raise OSError("it follows its parent")


def _raise_limit() -> None:
    hard = resource.getrlimit(resource.RLIMIT_DATA)[1]
    resource.setrlimit(resource.RLIMIT_DATA, (2 * hard, 2 * hard))


def _handles() -> list[str]:
    """What stands open in a process that has just begun, the pipe of the answer and the standard streams aside."""
    found = []
    for handle in range(3, 64):
        with suppress(OSError):
            found.append(os.readlink(f"/proc/self/fd/{handle}"))
    return [target for target in found if not target.startswith(("pipe:", "/proc/", str(Path(os.devnull))))]


def burn(job: Job) -> Built | Parsed | Refused:
    """Compute for ever."""
    while True:
        pass


def write_much(job: Job) -> Built | Parsed | Refused:
    """Write a file far larger than any container may be."""
    with (job.folder / "container").open("wb") as file:
        file.seek(1 << 40)
        file.write(b"x")
    return Refused("written")


def dig(job: Job) -> Built | Parsed | Refused:
    """Make folders that are too deep for most programs that would remove them, and then one that may not be entered."""
    os.chdir(job.folder)
    for _ in range(3000):
        os.mkdir("d")
        os.chdir("d")
    os.mkdir("closed", 0)
    return Refused("dug")


def trick_progress(job: Job) -> Built | Parsed | Refused:
    """Make the file that the server looks at a link, and then something huge."""
    progress = job.folder / "progress"
    progress.symlink_to("/dev/zero")
    go = job.folder.parents[3] / "go"
    until = time.monotonic() + PATIENCE
    while not go.exists() and time.monotonic() < until:
        time.sleep(0.01)
    progress.unlink()
    progress.write_text("9" * 1_000_000)
    time.sleep(0.2)
    return build(job)


def _say(text: bytes) -> NoReturn:
    """Answer with these bytes, as only somebody does who has taken the process over."""
    pipes = [handle for handle in range(3, 64) if _is_pipe(handle)]
    with os.fdopen(pipes[0], "wb", 0) as pipe:
        pipe.write(text)
    os._exit(0)


def _is_pipe(handle: int) -> bool:
    try:
        return os.readlink(f"/proc/self/fd/{handle}").startswith("pipe:")
    except OSError:
        return False


def say_nothing(job: Job) -> Built | Parsed | Refused:
    _say(b"")


def say_garbage(job: Job) -> Built | Parsed | Refused:
    _say(bytes(range(256)))


def say_pickle(job: Job) -> Built | Parsed | Refused:
    _say(pickle.dumps({"returned": {"reason": "unpickled", "final": True}}))


def say_much(job: Job) -> Built | Parsed | Refused:
    _say(b'{"returned": {"final": true, "reason": "' + b"x" * (64 << 20) + b'"}}')


def say_deep(job: Job) -> Built | Parsed | Refused:
    _say(b"[" * 200_000)


def say_something_else(job: Job) -> Built | Parsed | Refused:
    _say(json.dumps({"returned": {"path": "/etc/passwd", "sha256": 5}}).encode())


def say_a_class(job: Job) -> Built | Parsed | Refused:
    _say(json.dumps({"raised": {"kind": "x\n2026 INFO forged", "errno": None, "traceback": ""}}).encode())


def forge_log(job: Job) -> Built | Parsed | Refused:
    text = "x\n2026 INFO forged \x1b[2J\r2026 INFO forged"
    _say(json.dumps({"raised": {"kind": "ValueError", "errno": None, "traceback": text}}).encode())


def forge_nothing(job: Job) -> Built | Parsed | Refused:
    """Say that something was built, where nothing was."""
    return Built("0" * 64)


def forge_hash(job: Job) -> Built | Parsed | Refused:
    build(job)
    return Built("0" * 64)


def forge_path(job: Job) -> Built | Parsed | Refused:
    """Put a link to another's file where the container should be, with the hash of that."""
    built = build(job)
    assert isinstance(built, Built)
    job.container.rename(job.folder / "real")
    job.container.symlink_to(job.folder / "real")
    return built


def forge_second_name(job: Job) -> Built | Parsed | Refused:
    built = build(job)
    os.link(job.container, job.folder / "second")
    return built


def forge_folder(job: Job) -> Built | Parsed | Refused:
    job.container.mkdir()
    return Built("0" * 64)


def forge_container(job: Job) -> Built | Parsed | Refused:
    """Make something with the right hash that is no container."""
    data = np.arange(1000).tobytes()
    job.container.write_bytes(data)
    return Built(hashlib.sha256(data).hexdigest())


def forge_errors(job: Job) -> Built | Parsed | Refused:
    """Say of a surface that was built here that the errors of its maker were checked."""
    built = build(job)
    assert isinstance(built, Built)
    return Built(built.sha256, "checked")


def forge_thumbnail(job: Job) -> Built | Parsed | Refused:
    """Say that a page with a script is the thumbnail."""
    built = build(job)
    assert isinstance(built, Built)
    return Built(built.sha256, thumbnail=base64.b64encode(b"<script>" * 1000).decode())


def forge_choices(job: Job) -> Built | Parsed | Refused:
    """Offer what is no option, what nobody can read, and more than anybody wants."""
    bad = [{"token": "x"}, {"variable": "a\x1b[31m"}, {"variable": "v" * 5000}, {}]
    many = [{"variable": f"{number:0100d}"} for number in range(1000)]
    return Refused("x", choices=tuple(Choice(options, (-1, 5)) for options in (*bad, *many)))


def forge_reason(job: Job) -> Built | Parsed | Refused:
    return Refused("two\nlines \x1b[31m" + "and more " * 1000)


def forge_level(job: LevelJob) -> MadeLevel | Refusal:
    """Say that a level was made, where none was."""
    return MadeLevel(5)


def forge_level_link(job: LevelJob) -> MadeLevel | Refusal:
    """Make a link to the container in its place."""
    job.path.symlink_to(job.container)
    return MadeLevel(job.container.stat().st_size)


def say_garbage_of_level(job: LevelJob) -> MadeLevel | Refusal:
    _say(bytes(range(256)))


def linger(job: Job) -> Built | Parsed | Refused:
    """Leave processes behind, which only the readers of some formats could; their numbers stand in the reason."""
    left = []
    for _ in range(3):
        process = os.fork()
        if not process:
            while True:
                (job.folder / "lingering").write_text("x")
        left.append(process)
    while not (job.folder / "lingering").exists():
        time.sleep(0.01)
    return Refused(json.dumps(left))
