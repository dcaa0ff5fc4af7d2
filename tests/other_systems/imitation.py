"""Imitate macOS or Windows for the modules of Lodestream, in a process of its own.

`imitate` changes what these modules see, not what Python and other libraries see: the name of the system, modules and
names that it does not have, and for Windows also its rules for files. An open or mapped file cannot be removed, renamed
or replaced, names of devices and some characters are refused, a file is locked by `msvcrt`, and text files without an
encoding are an error. What confines processes and forks builds is for Linux and is not imitated.
"""

from __future__ import annotations

import builtins
import ctypes
import errno
import fcntl
import io
import os
import re
import shutil
import signal
import subprocess
import sys
import warnings
from collections.abc import Callable
from pathlib import Path
from types import ModuleType, SimpleNamespace
from typing import Any

__all__ = ["SYSTEMS", "imitate"]

SYSTEMS = ("darwin", "win32")

#: Modules that Windows does not have.
_MODULES = {"fcntl", "grp", "pty", "pwd", "resource", "termios", "tty"}
#: Names that neither has, and those that Windows does not have, of `os` and `signal`.
_LINUX = """
    O_PATH O_TMPFILE copy_file_range eventfd memfd_create pidfd_open posix_fadvise posix_fallocate sched_getaffinity
    sched_setaffinity splice
"""
_POSIX = """
    O_ACCMODE O_ASYNC O_CLOEXEC O_DIRECTORY O_NOCTTY O_NOFOLLOW O_NONBLOCK O_SYNC WNOHANG chown ctermid fchdir fchmod
    fchown fork forkpty getegid geteuid getgid getgroups getloadavg getpgid getpriority getuid killpg lchown mkfifo
    mknod nice posix_spawn pread preadv pwrite pwritev register_at_fork sched_yield sendfile setpgid setsid statvfs
    sysconf uname wait
"""
_SIGNALS = "SIGALRM SIGCHLD SIGHUP SIGKILL SIGPIPE SIGQUIT SIGUSR1 SIGUSR2 alarm pthread_sigmask setitimer sigwait"

#: Modules that load or confine what is of this machine.
_AS_THEY_ARE = ("lodestream.library", "lodestream.kernels", "lodestream.confinement")

_REFUSED = re.compile(r'[<>:"|?*\x00-\x1f]|[. ]$')
_DEVICES = re.compile(r"(con|prn|aux|nul|com[0-9]|lpt[0-9])(\..*)?", re.IGNORECASE)
_MEMORY = 6 << 30


class _Seen(ModuleType):
    """A module without some of its names, and with others in their place."""

    def __init__(self, module: ModuleType, absent: str = "", **changed: Any) -> None:
        super().__init__(module.__name__)
        vars(self).update(changed, _module=module, _absent=frozenset(absent.split()))

    def __getattr__(self, name: str) -> Any:
        if name in self._absent:
            raise AttributeError(f"module {self.__name__!r} has no attribute {name!r}")
        return getattr(self._module, name)

    def __setattr__(self, name: str, value: Any) -> None:
        setattr(self._module, name, value)


def imitate(system: str, *, also_tests: bool = False) -> None:
    """Imitate a system of `SYSTEMS` for all modules of Lodestream that are imported from now on, and for its tests."""
    # Other libraries look at this machine when they are imported.
    import h5netcdf  # noqa: F401
    import matplotlib.figure  # noqa: F401
    import rasterio  # noqa: F401
    import xarray  # noqa: F401

    modules: dict[str, ModuleType] = {"sys": _Seen(sys, platform=system), "os": _Seen(os, _LINUX)}
    absent: set[str] = set()
    if system == "darwin":
        modules["fcntl"] = _Seen(fcntl, F_FULLFSYNC=51)  # which Linux refuses, as some file systems do there
    if system == "win32":
        absent = _MODULES
        supported = frozenset(os.supports_fd) - {os.utime}
        binary = {"O_BINARY": 0, "O_NOINHERIT": os.O_CLOEXEC, "supports_fd": supported}
        modules["os"] = _Seen(os, _LINUX + _POSIX, **binary)
        modules["signal"] = _Seen(signal, _SIGNALS)
        modules["subprocess"] = _Seen(subprocess, Popen=_popen)
        modules["msvcrt"] = _msvcrt()
        kernel32 = SimpleNamespace(GlobalMemoryStatusEx=_memory)
        modules["ctypes"] = _Seen(ctypes, windll=SimpleNamespace(kernel32=kernel32))
        _refuse_open_files()
        _refuse_names()
        warnings.filterwarnings("error", category=EncodingWarning, module="lodestream")
    _import(modules, absent, ("lodestream", "tests") if also_tests else ("lodestream",))


def _import(modules: dict[str, ModuleType], absent: set[str], importers: tuple[str, ...]) -> None:
    ordinary = builtins.__import__

    def imported(name: str, globals: Any = None, locals: Any = None, fromlist: Any = (), level: int = 0) -> ModuleType:
        importer = (globals or {}).get("__name__", "")
        top = name.partition(".")[0]
        if level == 0 and importer.startswith(importers) and not importer.startswith(_AS_THEY_ARE):
            if top in absent:
                raise ModuleNotFoundError(f"No module named {name!r}", name=name)
            if top in modules and name == top:
                return modules[top]
        return ordinary(name, globals, locals, fromlist, level)

    builtins.__import__ = imported


def _popen(*arguments: Any, creationflags: int = 0, **options: Any) -> subprocess.Popen[bytes]:
    return subprocess.Popen(*arguments, **options)


def _memory(status: Any) -> int:
    status._obj.total_physical = _MEMORY
    return 1


def _msvcrt() -> ModuleType:
    """Locks of a file for each time that it was opened, as Windows has them for ranges of bytes."""
    module = ModuleType("msvcrt")
    free, wait, lock = 0, 1, 2
    flags = {free: fcntl.LOCK_UN, wait: fcntl.LOCK_EX, lock: fcntl.LOCK_EX | fcntl.LOCK_NB}

    def locking(handle: int, mode: int, count: int) -> None:
        try:
            fcntl.flock(handle, flags[mode])
        except BlockingIOError:
            raise PermissionError(errno.EACCES, "Permission denied") from None

    vars(module).update(LK_UNLCK=free, LK_LOCK=wait, LK_NBLCK=lock, locking=locking)
    return module


def _open_files() -> set[str]:
    """Return the files that this process has open or mapped."""
    paths = set()
    for handle in os.listdir("/proc/self/fd"):
        try:
            path = os.readlink(f"/proc/self/fd/{handle}")
        except FileNotFoundError:
            continue
        if os.path.isfile(path):
            paths.add(path)
    with open("/proc/self/maps", encoding="utf-8") as maps:
        paths.update(line.split(maxsplit=5)[5].rstrip("\n") for line in maps if len(line.split(maxsplit=5)) == 6)
    return paths


def _refuse_open_files() -> None:
    """Refuse to remove, rename or replace a file that is open or mapped, or a folder with one."""
    shutil._use_fd_functions = False  # type: ignore[attr-defined]

    def check(*paths: Any) -> None:
        files = _open_files()
        for path in paths:
            name = os.path.join(os.path.realpath(os.path.dirname(os.path.abspath(path))), os.path.basename(path))
            if name in files or any(file.startswith(f"{name}/") for file in files):
                raise PermissionError(errno.EACCES, "The process cannot access the file, it is in use", os.fspath(path))

    def wrapped(function: Callable[..., None], targets: int, may_replace: bool = True) -> Callable[..., None]:
        def call(*arguments: Any, **options: Any) -> None:
            if not may_replace and os.path.lexists(arguments[1]):
                raise FileExistsError(errno.EEXIST, "File exists", os.fspath(arguments[1]))
            check(*arguments[:targets])
            function(*arguments, **options)

        return call

    os.unlink = os.remove = wrapped(os.unlink, 1)
    os.replace = wrapped(os.replace, 2)
    os.rename = wrapped(os.rename, 2, may_replace=False)


def _refuse_names() -> None:
    """Refuse to create files and folders of names that Windows does not take."""

    def check(path: Any) -> None:
        if isinstance(path, int):
            return
        for name in Path(os.fsdecode(path)).parts[1:]:
            if _REFUSED.search(name) or _DEVICES.fullmatch(name):
                raise OSError(errno.EINVAL, "The name is incorrect", os.fspath(path))

    def wrapped(function: Callable[..., Any], place: int = 0) -> Callable[..., Any]:
        def call(*arguments: Any, **options: Any) -> Any:
            if len(arguments) > place:
                check(arguments[place])
            return function(*arguments, **options)

        return call

    opened = io.open

    def open_(file: Any, mode: str = "r", *arguments: Any, **options: Any) -> Any:
        check(file)
        if "b" not in mode and not arguments[1:2] and options.get("encoding") is None:
            warnings.warn("'encoding' argument not specified", EncodingWarning, stacklevel=2)
        return opened(file, mode, *arguments, **options)

    builtins.open = io.open = open_
    os.open, os.mkdir = wrapped(os.open), wrapped(os.mkdir)
    os.replace, os.rename = wrapped(os.replace, 1), wrapped(os.rename, 1)
