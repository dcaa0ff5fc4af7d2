"""What a process keeps that has given everything else up, and what it can do no more."""

from __future__ import annotations

import ctypes
import json
import os
import platform
import re
import socket
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest

from lodestream.confinement import landlock, missing, places, seccomp
from tests.patience import PATIENCE

_LIBC = ctypes.CDLL(None)

linux = pytest.mark.skipif(sys.platform != "linux", reason="only Linux has them")
has_landlock = pytest.mark.skipif(
    sys.platform != "linux" or not landlock.version(_LIBC), reason="this kernel has no Landlock"
)
has_seccomp = pytest.mark.skipif(
    sys.platform != "linux" or platform.machine() not in ("x86_64", "aarch64"), reason="no filter for this machine"
)

# Runs expressions in a process that confines itself, and prints what came of each.
_PROGRAM = """
import json, os, socket, subprocess, sys, mmap, threading
from pathlib import Path
from lodestream.confinement import Rights, confine, landlock, missing
asked = json.loads(sys.argv[1])
if asked["without_landlock"]:
    landlock.restrict = lambda *_: False
paths = [tuple(map(Path, asked[name])) for name in ("read", "write")]
held = confine(Rights(*paths, asked["processes"], asked["threads"]))
found = []
for text in asked["tried"]:
    try:
        found.append(repr(eval(text)))
    except Exception as error:
        found.append(type(error).__name__ + " " + str(getattr(error, "errno", "")))
print(json.dumps({"held": held, "found": found}))
"""


def confined(tried: list[str], **rights: Any) -> dict[str, Any]:
    """What comes of some expressions in a confined process."""
    asked = {"read": [], "write": [], "processes": False, "threads": False, "without_landlock": False}
    asked |= {**rights, "tried": tried}
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join(filter(None, sys.path)), "OPENBLAS_NUM_THREADS": "1"}
    done = subprocess.run(
        [sys.executable, "-c", _PROGRAM, json.dumps(asked)],
        env=environment,
        capture_output=True,
        text=True,
        timeout=PATIENCE,
        check=True,
    )
    told: dict[str, Any] = json.loads(done.stdout)
    return told


@has_landlock
def test_only_its_own_paths_are_open(tmp_path: Path) -> None:
    mine, other, room = tmp_path / "mine", tmp_path / "other", tmp_path / "room"
    mine.write_text("my own")
    other.write_text("another's")
    room.mkdir()
    told = confined(
        [
            f"open({str(mine)!r}).read()",
            f"open({str(mine)!r}, 'a')",
            f"open({str(other)!r}).read()",
            f"os.listdir({str(tmp_path)!r})",
            f"open({str(room / 'new')!r}, 'w').write('12')",
            f"os.rename({str(room / 'new')!r}, {str(room / 'newer')!r})",
            f"os.rename({str(room / 'newer')!r}, {str(tmp_path / 'out')!r})",
            f"os.symlink({str(other)!r}, {str(room / 'link')!r})",
            f"open({str(room / 'link')!r}).read()",
            "len(os.listdir('/proc/self/fd')) > 2",
            "len(os.urandom(4)), len(open('/dev/urandom', 'rb').read(4))",
            "open(os.devnull, 'w').write('x')",
            "__import__('sqlite3').sqlite_version > ''",
        ],
        read=[str(mine)],
        write=[str(room)],
    )
    assert "landlock" in told["held"]
    assert told["found"] == [
        "'my own'",
        "PermissionError 13",
        "PermissionError 13",
        "PermissionError 13",
        "2",
        "None",
        "PermissionError 13",
        "None",
        "PermissionError 13",
        "True",
        "(4, 4)",
        "1",
        "True",
    ]
    assert other.read_text() == "another's"


@has_landlock
def test_a_folder_of_scripts_around_it_is_not_opened(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    mine, other = tmp_path / "data" / "mine", tmp_path / "data" / "other"
    mine.parent.mkdir()
    for path in (mine, other):
        path.write_text("x")
    monkeypatch.syspath_prepend(tmp_path)
    told = confined([f"open({str(path)!r}).read()" for path in (mine, other)], read=[str(mine)])
    assert told["found"] == ["'x'", "PermissionError 13"]


@pytest.mark.skipif(
    sys.platform != "linux" or landlock.version(_LIBC) < landlock.SCOPES, reason="this kernel's Landlock has no scopes"
)
def test_landlock_alone_keeps_signals_and_sockets_without_a_file_from_others() -> None:
    with socket.socket(socket.AF_UNIX) as listening:
        listening.bind("")  # the kernel chooses a name that no file has
        listening.listen()
        program = f"""
import ctypes, os, socket
from lodestream.confinement import landlock
libc = ctypes.CDLL(None)
libc.prctl(38, 1, 0, 0, 0)  # PR_SET_NO_NEW_PRIVS
assert landlock.restrict(libc, (), (), ())
os.kill(os.getpid(), 0)
client = socket.socket(socket.AF_UNIX)
for attempt in (lambda: os.kill(os.getppid(), 0), lambda: client.connect({listening.getsockname()!r})):
    try:
        attempt()
    except PermissionError as error:
        print(error.errno)
"""
        environment = {**os.environ, "PYTHONPATH": os.pathsep.join(filter(None, sys.path))}
        command = [sys.executable, "-c", program]
        done = subprocess.run(command, env=environment, capture_output=True, text=True, timeout=PATIENCE, check=False)
    assert (done.stdout, done.stderr) == ("1\n1\n", "")


@has_seccomp
def test_calls_that_no_reader_needs_are_refused(tmp_path: Path) -> None:
    told = confined(
        [
            "socket.socket()",
            "socket.socketpair()",
            "os.fork()",
            "threading.Thread(target=int).start()",
            "subprocess.run([sys.executable, '-c', ''])",
            "os.kill(os.getppid(), 0)",
            "os.kill(os.getpid(), 0)",
            "os.setsid()",
            "mmap.mmap(-1, 4096)",
            "mmap.mmap(-1, 4096, flags=mmap.MAP_PRIVATE | mmap.MAP_ANONYMOUS).close()",
            "os.memfd_create('x')",
            f"os.chmod({str(tmp_path)!r}, 0o700)",
            f"os.utime({str(tmp_path)!r})",
            f"os.truncate({str(tmp_path)!r}, 0)",
            f"os.open({str(Path(__file__))!r}, os.O_RDONLY | os.O_TRUNC)",
            "len([line for line in open('/proc/self/status') if line.startswith('CapEff:\\t0000000000000000')])",
        ],
        read=[str(Path(__file__))],
        write=[str(tmp_path)],
    )
    assert "seccomp" in told["held"]
    refused = "PermissionError 1"
    assert told["found"] == [
        *(refused, refused, refused),
        "RuntimeError ",
        *(refused, refused),
        *("None", refused, refused, "None", refused, refused, refused, refused, refused, "1"),
    ]


@has_seccomp
@has_landlock
def test_threads_may_be_allowed_without_processes(tmp_path: Path) -> None:
    (tmp_path / "other").write_text("x")
    pool = "__import__('concurrent.futures').futures.ThreadPoolExecutor"
    told = confined(
        [
            "(lambda made: (made.start(), made.join(), 'ran')[2])(threading.Thread(target=int))",
            "os.fork()",
            "subprocess.run([sys.executable, '-c', ''])",
            f"{pool}(1).submit(open, {str(tmp_path / 'other')!r}).result()",
        ],
        threads=True,
    )
    refused = "PermissionError 1"
    assert told["found"] == ["'ran'", refused, refused, "PermissionError 13"]


@has_seccomp
@pytest.mark.parametrize("processes", [False, True])
def test_nothing_is_changed_of_other_processes(processes: bool) -> None:
    # Whoever may lower a limit of another process, or choose the signal that a pipe sends it, can end it.
    limits, priority = "__import__('resource').prlimit", "os.setpriority(os.PRIO_PROCESS, {0}, 1)"
    told = confined(
        [
            f"{limits}(os.getppid(), 7)",
            f"{limits}(os.getpid(), 7) == {limits}(0, 7)",
            "__import__('resource').setrlimit(7, (64, 64))",
            "__import__('fcntl').fcntl(0, 8, os.getppid())",
            "len(__import__('fcntl').fcntl(1, 1).to_bytes(4, 'big'))",
            priority.format("os.getppid()"),
            priority.format("0"),
            "os.sched_setscheduler(os.getppid(), os.SCHED_BATCH, os.sched_param(0))",
            "os.sched_setscheduler(0, os.SCHED_BATCH, os.sched_param(0))",
            "os.sched_setaffinity(os.getppid(), os.sched_getaffinity(0))",
            "os.sched_setaffinity(0, os.sched_getaffinity(0))",
        ],
        processes=processes,
    )
    refused = "PermissionError 1"
    assert told["found"] == [
        *(refused, "True", "None"),
        *(refused, "4"),
        *(refused, refused, refused, refused),
        *(refused, "None"),
    ]


@has_seccomp
@has_landlock
def test_processes_have_the_same_rights(tmp_path: Path) -> None:
    (tmp_path / "other").write_text("x")
    program = f"print(open('/proc/self/stat').read(1) != '', open({str(tmp_path / 'other')!r}).read())"
    told = confined(
        [
            f"subprocess.run([sys.executable, '-c', {program!r}], capture_output=True, text=True).stderr",
            "subprocess.run(['/bin/sh', '-c', ''])",
            "socket.socket()",
            "os.kill(os.getppid(), 0)",
            "os.setsid()",
        ],
        processes=True,
    )
    assert "Permission denied" in told["found"][0]
    assert told["found"][1:3] == ["PermissionError 13", "PermissionError 1"]
    assert told["found"][3:] == ["PermissionError 1", "PermissionError 1"]


@has_seccomp
@pytest.mark.parametrize("without_landlock", [False, True])
def test_who_starts_processes_signals_none_on_any_kernel(without_landlock: bool) -> None:
    # Of the versions of Landlock only the sixth and later ones know of signals: what holds is not to depend on them.
    nothing = "stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL"
    child = f"subprocess.Popen([sys.executable, '-c', 'input()'], stdin=subprocess.PIPE, {nothing})"
    targets = ["os.getppid()", "1", "0", "-1", "-os.getpgrp()", f"(child := {child}).pid"]
    told = confined(
        [
            *(f"os.kill({target}, 0)" for target in targets),
            "os.killpg(0, 0)",
            "os.kill(os.getpid(), 0)",
            "__import__('signal').pidfd_send_signal(os.open('/proc/self', os.O_RDONLY), 0)",
            "__import__('ctypes').CDLL(None).syscall(434, os.getppid(), 0)",  # pidfd_open
            "missing(held)",
        ],
        processes=True,
        without_landlock=without_landlock,
    )
    refused = "PermissionError 1"
    assert told["found"][:7] == 7 * [refused]
    assert told["found"][7:10] == ["None", "OSError 38", "-1"]
    lacks = "('landlock: a build may open every file that the server may open',)"
    assert told["found"][10] == (lacks if without_landlock or not landlock.version(_LIBC) else "()")


def test_what_is_missing_is_said_for_each_mechanism(monkeypatch: pytest.MonkeyPatch) -> None:
    assert missing(("landlock", "seccomp")) == ()
    assert [sentence.partition(":")[0] for sentence in missing(())] == ["landlock", "seccomp"]
    (files,) = missing(("seccomp",))
    assert "every file" in files
    for version, words, others in ((1, "sockets,", "signals"), (4, "than TCP", "signals"), (6, "than TCP", "limits")):
        monkeypatch.setattr(landlock, "version", lambda _, version=version: version)
        (calls,) = missing(("landlock",))
        assert words in calls
        assert others in calls
        assert ("signals" in calls) is (version < 6)


@pytest.mark.parametrize("machine", seccomp._MACHINES)
def test_what_the_filter_does_call_by_call(machine: str) -> None:
    # The kernel's machine for it has few instructions: here the filters of both architectures run on it.
    architecture, calls = seccomp._MACHINES[machine]
    filters = {
        rights: b"".join(seccomp._program(architecture, calls, 77, *rights))
        for rights in ((False, False, False), (False, True, False), (True, False, False), (False, False, True))
    }

    def verdict(
        name: str | int,
        *arguments: int,
        processes: bool = False,
        threads: bool = False,
        descriptors: bool = False,
        other: int = 0,
    ) -> str:
        number = calls[name] if isinstance(name, str) else name
        return _run(filters[processes, threads, descriptors], number, other or architecture, arguments)

    assert verdict("socket") == "error 1"
    assert verdict("socket", other=0x40000003) == "kill"
    assert verdict(0x40000000 | 41) == "error 38"
    assert [verdict(number) for number in (425, 435, 437, 500, 439, 446)] == ["error 38"] * 4 + ["allow"] * 2
    assert [verdict("clone", 17), verdict("clone", 17, processes=True)] == ["error 1", "allow"]
    assert verdict("clone", 0x10000000 | 17, processes=True) == "error 1"
    thread = 0x3D0F00  # what the C library asks for
    assert [verdict("clone", thread), verdict("clone", thread, threads=True)] == ["error 1", "allow"]
    assert [verdict("clone", 17, threads=True), verdict("execve", threads=True)] == ["error 1", "error 1"]
    assert [verdict("execve"), verdict("execve", processes=True)] == ["error 1", "allow"]
    for name in seccomp._SIGNALS:
        assert [verdict(name, 77), verdict(name, 78)] == ["allow", "error 1"]
    for name in seccomp._SIGNALS:
        assert [verdict(name, pid, processes=True) for pid in (77, 78, 0)] == ["allow", "error 1", "error 1"]
    flags = [os.O_RDONLY, os.O_RDONLY | os.O_TRUNC, os.O_WRONLY | os.O_TRUNC, os.O_RDWR | os.O_TRUNC]
    assert [verdict("openat", 0, 0, flag) for flag in flags] == ["allow", "error 1", "allow", "allow"]
    assert [verdict("mmap", 0, 0, 0, flag) for flag in (0x01, 0x21, 0x23, 0x22)] == [
        *("allow", "error 1", "error 1", "allow")
    ]
    assert [verdict("prctl", 1, 9), verdict("prctl", 1, 0), verdict("prctl", 15, 0)] == [*("allow", "error 1", "allow")]
    for name in ("prlimit64", "sched_setaffinity"):
        assert [verdict(name, pid) for pid in (0, 77, 78, 1)] == ["allow", "allow", "error 1", "error 1"]
        assert [verdict(name, pid, processes=True) for pid in (0, 78)] == ["allow", "error 1"]
    # F_DUPFD, F_SETFL, F_SETOWN, F_GETOWN, F_SETSIG, F_SETOWN_EX
    assert [verdict("fcntl", 1, command, 78) for command in (0, 4, 8, 9, 10, 15)] == [
        *("allow", "allow", "error 1", "allow", "error 1", "error 1")
    ]
    for name in {*seccomp._DENIED.split()} & calls.keys():
        assert verdict(name) == verdict(name, processes=True) == "error 1", name
        assert verdict(name, descriptors=True) == ("allow" if name == "recvmsg" else "error 1"), name
    some = {"clone", "fcntl", "mmap", "open", "openat", "prctl", "seccomp", *seccomp._SIGNALS, *seccomp._LIMITS}
    assert {name for name in calls if verdict(name) == "allow"} <= some, "of all others no call is allowed"
    assert {
        "ptrace",
        "process_vm_writev",
        "chmod" if machine == "x86_64" else "fchmodat",
        "keyctl",
    } <= calls.keys() - some
    known = {*calls.values()}
    assert all(verdict(number) == "allow" for number in range(424) if number not in known)


def _run(program: bytes, number: int, architecture: int, arguments: tuple[int, ...]) -> str:
    """What a filter says of a call."""
    words = [number, architecture, 0, 0]
    for argument in (*arguments, 0, 0, 0, 0, 0, 0)[:6]:
        words += [argument & 0xFFFFFFFF, argument >> 32]
    place = value = 0
    while True:
        code = int.from_bytes(program[8 * place : 8 * place + 2], sys.byteorder)
        if_true, if_false = program[8 * place + 2], program[8 * place + 3]
        k = int.from_bytes(program[8 * place + 4 : 8 * place + 8], sys.byteorder)
        place += 1
        if code == 0x20:
            value = words[k // 4]
        elif code == 0x54:
            value &= k
        elif code == 0x06:
            return {0x7FFF0000: "allow", 0x80000000: "kill"}.get(k, f"error {k & 0xFFFF}")
        else:
            met = {0x15: value == k, 0x35: value >= k, 0x45: bool(value & k)}[code]
            place += if_true if met else if_false


@linux
def test_the_numbers_are_the_kernels() -> None:
    heads = {
        "x86_64": Path("/usr/include/x86_64-linux-gnu/asm/unistd_64.h"),
        "aarch64": Path("/usr/include/asm-generic/unistd.h"),
    }
    there = {machine: path for machine, path in heads.items() if path.is_file()}
    if not there:
        pytest.skip("the kernel's headers are not installed")
    for machine, path in there.items():
        text = path.read_text()
        told = {name: int(number) for name, number in re.findall(r"#define __NR(?:3264)?_(\w+)\s+(\d+)\b", text)}
        calls = seccomp._MACHINES[machine][1]
        wrong = {name: number for name, number in calls.items() if told.get(name, number) != number}
        assert wrong == {}
        assert len(calls.keys() & told.keys()) > 100
        # Every name that is refused is one of some machine.
        for name in (*seccomp._DENIED.split(), *seccomp._START, *seccomp._SIGNALS):
            assert name in calls or name not in told, (machine, name)


def test_places_are_absolute_and_hold_python() -> None:
    found = places.library_places()
    assert all(path.is_absolute() for path in found)
    assert Path(json.__file__).resolve().is_relative_to(next(p for p in found if p == Path(sys.base_prefix) / "lib"))
    assert Path("/") not in found
    assert Path("/proc") not in found
    assert Path("/proc") in places.library_places(processes=True)
