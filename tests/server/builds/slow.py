"""Builds that misbehave, for the build processes of the tests: they are found there by their names."""

from __future__ import annotations

import errno
import os
import resource
import shutil
import signal
import tempfile
import time
from collections.abc import Callable
from contextlib import suppress
from dataclasses import replace
from importlib import import_module
from pathlib import Path
from threading import Barrier, get_ident

from lodestream.confinement import landlock
from lodestream.parallel import spread, threads
from lodestream_server.builds import builder, level_maker, worker
from lodestream_server.builds.answers import Refusal
from lodestream_server.builds.fork_server import Allowed
from lodestream_server.builds.levels import LevelJob, MadeLevel, make_level
from lodestream_server.builds.worker import Built, Job, Parsed, Refused, build
from lodestream_server.store import durable
from tests.patience import PATIENCE as _PATIENCE
from tests.server.store.disks import FullDisk

__all__ = [
    "allow_levels_more",
    "allow_more",
    "answer_and_stay",
    "chat",
    "end_by",
    "end_once",
    "explode",
    "explode_later",
    "find_full",
    "fork_no_more",
    "full_at_each_step",
    "hoard",
    "hoard_level",
    "hold",
    "kill",
    "kill_level_once",
    "kill_once",
    "lack_memory_for_level",
    "leave",
    "limits",
    "listed",
    "lose_its_folder",
    "make_coarsest",
    "make_level_by_bands",
    "make_level_by_blocks",
    "make_when_told",
    "miss_when_told",
    "nothing",
    "number",
    "out_of_processor_time",
    "parse_only",
    "processor_seconds_left",
    "raise_error",
    "raise_full",
    "refuse",
    "refuse_large_level",
    "say",
    "share",
    "sleep",
    "sleep_with_another",
    "stay",
    "surroundings",
    "take",
    "touch",
    "use_processors",
    "vanish",
    "wait",
    "weaken",
]


def allow_more(job: Job, *args: object) -> Allowed:
    """What `builder` allows a build, and the data folder, where those below leave a mark for the next attempt."""
    return replace(_allowed(job, *args), write=job.folder.parents[3])


def allow_levels_more(job: LevelJob, *args: int) -> Allowed:
    """The same of those who make levels."""
    return replace(_allowed_level(job, *args), write=job.folder.parents[2], file_bytes=None)


# The server's limits are longer, and no test leaves it at that.

_allowed: Callable[..., Allowed] = builder._allowed
_allowed_level: Callable[..., Allowed] = level_maker._allowed


def weaken() -> None:
    """Landlock holds nobody any more."""
    landlock.restrict = lambda *_: False


def nothing() -> None:
    """Do nothing."""


def much() -> None:
    """Load something large."""
    _loaded.append(bytearray(200 << 20))


_loaded = list[bytearray]()


def fork_no_more() -> None:
    """The system has no room for another process."""

    def fail() -> int:
        raise BlockingIOError(errno.EAGAIN, "no room")

    os.fork = fail


def hold() -> None:
    """Open files, as a library may that is loaded."""
    handle = os.open("/dev/zero", os.O_RDONLY)
    os.dup2(handle, 200)


def stay() -> None:
    """Load for longer than any test waits."""
    time.sleep(600)


def vanish() -> None:
    """End what loads it."""
    os._exit(7)


def chat() -> None:
    """Print something, then fail."""
    os.write(1, b"hello\n")
    raise KeyError("missing")


def preload() -> None:
    """What `worker.preload` does, where calls of the tests find imported what they are called from."""
    import_module("tests.server.connections.hostile")
    worker.preload()


def number() -> int:
    """The process that is asked."""
    return os.getpid()


def sleep(begun: Path) -> None:
    """Say who sleeps, then sleep for longer than any test waits."""
    new = begun.with_suffix(".new")
    new.write_text(str(os.getpid()))
    new.replace(begun)
    time.sleep(600)


def sleep_with_another(begun: Path) -> None:
    """The same, and so does a process that this one has started."""
    other = os.fork()
    if other:
        begun.with_suffix(".other").write_text(str(other))
        sleep(begun)
    time.sleep(600)


def surroundings() -> dict[str, list[str]]:
    """What stands open in a process that has just begun, and the names in its environment."""
    found = []
    for handle in range(1 << 12):
        with suppress(OSError):
            found.append(os.readlink(f"/proc/self/fd/{handle}"))
    return {"open": found, "environment": sorted(os.environ)}


def touch(path: Path) -> list[str | None]:
    """Make a file, and say where temporary ones are made."""
    path.touch()
    return [tempfile.gettempdir(), os.environ.get("TMPDIR")]


def limits() -> dict[str, tuple[int, int]]:
    """The limits of the process."""
    return {name: resource.getrlimit(getattr(resource, f"RLIMIT_{name}")) for name in ("CORE", "FSIZE", "NOFILE")}


def raise_error(kind: str, number: int | None = None) -> None:
    """Raise an error of a built-in class."""
    error = {"KeyError": KeyError, "OSError": OSError, "ZeroDivisionError": ZeroDivisionError}[kind]
    raise error("secret") if number is None else error(number, "secret")


def say(count: int) -> str:
    """Answer with so many letters."""
    return "x" * count


def answer_and_stay() -> None:
    """Answer, and go on for longer than any test waits."""
    for handle in range(3, 64):
        with suppress(OSError):
            if os.readlink(f"/proc/self/fd/{handle}").startswith("pipe:"):
                os.write(handle, b'{"returned": null}')
                os.close(handle)
    time.sleep(600)


def leave(code: int) -> None:
    """End without an answer."""
    os._exit(code)


def end_by(number: int) -> None:
    """End as a signal ends a process."""
    os.kill(os.getpid(), number)


def share() -> list[int]:
    """Threads that it may have, those that take part where each waits for the others, and how nice it is."""
    together = Barrier(threads())
    taking_part = set(spread(lambda _: (together.wait(_PATIENCE), get_ident())[1], range(threads())))
    return [threads(), len(taking_part), os.getpriority(os.PRIO_PROCESS, 0)]


def processor_seconds_left() -> float:
    """Of the processor time that this process may use, what is left."""
    return resource.getrlimit(resource.RLIMIT_CPU)[0] - time.process_time()


def use_processors(seconds: float) -> float:
    """Compute for so long."""
    began = time.process_time()
    while time.process_time() - began < seconds:
        pass
    return time.process_time()


def out_of_processor_time(job: Job) -> Built | Parsed | Refused:
    """End as the kernel ends a process that has used up its processor time."""
    os.kill(os.getpid(), signal.SIGXCPU)
    return Refused("survived")


def wait(job: Job) -> Built | Parsed | Refused:
    """Report half, then go on when a file called ``go`` appears beside the surfaces' folders."""
    (job.folder / "progress").write_text("0.5")
    go = job.folder.parents[3] / "go"
    until = time.monotonic() + _PATIENCE
    while not go.exists():
        if time.monotonic() > until:
            return Refused("nobody said go")
        time.sleep(0.01)
    return build(job)


def listed(job: Job) -> Built | Parsed | Refused:
    """Write down in which order surfaces are built."""
    with (job.folder.parents[3] / "order").open("a") as file:
        file.write(job.folder.parent.name + "\n")
    return wait(job)


def kill(job: Job) -> Built | Parsed | Refused:
    """End as the kernel ends a process that takes too much memory."""
    os.kill(os.getpid(), signal.SIGKILL)
    return Refused("survived")


def end_once(job: Job) -> Built | Parsed | Refused:
    """Be told to end the first time, as all processes of a service are that is stopped."""
    marker = job.folder.parents[3] / "told"
    if not marker.exists():
        marker.touch()
        os.kill(os.getpid(), signal.SIGTERM)
        time.sleep(60)
    return build(job)


def explode(job: Job) -> Built | Parsed | Refused:
    """Raise what nobody foresaw."""
    raise ZeroDivisionError(f"with a secret: {job.folder}")


def explode_later(job: Job) -> Built | Parsed | Refused:
    """The same, once ``go`` is there."""
    wait(job)
    return explode(job)


def refuse(job: Job) -> Built | Parsed | Refused:
    """Refuse the bytes, as a reader does that has become stricter."""
    return Refused("expected a better file")


def kill_once(job: Job) -> Built | Parsed | Refused:
    """Be killed the first time."""
    marker = job.folder.parents[3] / "killed"
    if not marker.exists():
        marker.touch()
        os.kill(os.getpid(), signal.SIGKILL)
    return build(job)


def hoard(job: Job) -> Built | Parsed | Refused:
    """Take more memory than a process of the tests may have."""
    return Refused(f"got {len(bytearray(2 << 30))} bytes")


def take(count: int) -> int:
    """Take so many bytes of memory."""
    return len(bytearray(count))


def full_at_each_step(job: Job) -> Built | Parsed | Refused:
    """Find the disk full at the first step of writing the container, the next time at the second, and so on."""
    marker = job.folder.parents[3] / "fuller"
    done = int(marker.read_text()) if marker.exists() else 0
    marker.write_text(str(done + 1))
    durable.disk = FullDisk(done)
    return build(job)


def make_coarsest(job: LevelJob) -> MadeLevel | Refusal:
    """Say who makes a level, then make the coarsest at once and the others when ``go`` appears beside the folders."""
    begun = job.folder.parents[2] / "begun"
    with begun.open("a") as file:
        file.write(f"{os.getpid()} {job.level}\n")
    until = time.monotonic() + _PATIENCE
    while job.level and not (begun.parent / "go").exists():
        if time.monotonic() > until:
            return Refusal("OptionError", "nobody said go")
        time.sleep(0.01)
    return make_level(job)


def make_when_told(job: LevelJob) -> MadeLevel | Refusal:
    """Make a level once ``go`` appears beside ``begun`` in its folder, which is all that its process may write to."""
    begun, go = job.folder / "begun", job.folder / "go"
    begun.touch()
    until = time.monotonic() + _PATIENCE
    while not go.exists() and time.monotonic() < until:
        time.sleep(0.01)
    begun.unlink()
    go.unlink()
    return make_level(job)


def miss_when_told(job: LevelJob) -> MadeLevel | Refusal:
    """Miss the container of the first level once it was deleted, and say so when ``go`` appears beside the folders."""
    data, until = job.folder.parents[2], time.monotonic() + _PATIENCE
    first = not (data / "missed").exists()
    while first and job.container.exists() and time.monotonic() < until:
        (data / "begun").touch()
        time.sleep(0.01)
    try:
        return make_level(job)
    except FileNotFoundError:
        (data / "missed").touch()
        while not (data / "go").exists() and time.monotonic() < until:
            time.sleep(0.01)
        raise


def lose_its_folder(job: LevelJob) -> MadeLevel | Refusal:
    """Fail as a library may whose files are removed."""
    shutil.rmtree(job.folder)
    raise RuntimeError("there is nothing to write to")


def make_level_by_bands(job: LevelJob) -> MadeLevel | Refusal:
    """Make a level as one that takes more memory than there is, and say that values of it were in files."""
    made = make_level(replace(job, memory=1))
    if not (job.folder / "values").is_dir():
        raise AssertionError("expected values in files")
    return made


def make_level_by_blocks(job: LevelJob) -> MadeLevel | Refusal:
    """Make a level with the memory that blocks of 1,600 values take by themselves, and say that they were in files."""
    made = make_level(replace(job, memory=2 * 40 * 1600))
    if not (job.folder / "values").is_dir():
        raise AssertionError("expected values in files")
    return made


def hoard_level(job: LevelJob) -> MadeLevel | Refusal:
    """Take more memory than the process may have."""
    return Refusal("OptionError", f"got {len(bytearray(2 << 30))} bytes")


def kill_level_once(job: LevelJob) -> MadeLevel | Refusal:
    """Be killed the first time, with half a file written."""
    marker = job.folder.parents[2] / "killed"
    if not marker.exists():
        marker.touch()
        (job.folder / "level").write_bytes(b"half")
        os.kill(os.getpid(), signal.SIGKILL)
    return make_level(job)


def find_full(job: Job) -> Built | Parsed | Refused:
    """Find the disk full."""
    raise OSError(errno.ENOSPC, "no space left", str(job.folder))


def raise_full(job: LevelJob) -> MadeLevel | Refusal:
    """Find the disk full."""
    raise OSError(errno.ENOSPC, "no space left", str(job.folder))


def refuse_large_level(job: LevelJob) -> MadeLevel | Refusal:
    """What the decoder says of a level that does not fit into memory."""
    words = (
        "expected a surface that takes at most 9 MiB to decode (50% of the available memory), got one that takes more"
    )
    return Refusal("TooLargeError", f"{words}; max_vertices=7 allows it")


def lack_memory_for_level(job: LevelJob) -> MadeLevel | Refusal:
    """No memory is left."""
    raise MemoryError


def parse_only(job: Job) -> Built | Parsed | Refused:
    """Leave to others what nobody else is to build."""
    return Parsed(4)
