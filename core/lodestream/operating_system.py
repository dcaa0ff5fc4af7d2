"""What differs between operating systems, for all other modules.

Linux and macOS have the interface of POSIX, Windows does not. Where a system lacks something, a function here does it
another way or does nothing, as its docstring says. Other modules ask which system this is only where they need Linux:
the confinement (`lodestream.confinement`), and the server, which forks and confines its builds.
`lodestream.library` names the kernels of each system.
"""

from __future__ import annotations

import ctypes
import errno
import gc
import os
import shutil
import signal
import stat
import struct
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

if TYPE_CHECKING:
    import subprocess

if sys.platform == "win32":
    import msvcrt
else:
    import fcntl
    import resource
    import termios

__all__ = [
    "NO_LOCKS",
    "allocate",
    "cache_home",
    "close_and_remove",
    "file_limit",
    "give_to_owner",
    "is_of_another_user",
    "is_writable_by_others",
    "keep_out_of_forks",
    "kill_session",
    "limit_files",
    "limit_memory",
    "limit_processor",
    "limited_file_size",
    "lock",
    "lower_limit",
    "memory_of_machine",
    "memory_of_process",
    "new_session",
    "open_own",
    "processors",
    "raise_file_limit",
    "read_at",
    "read_cached",
    "remove_closed",
    "remove_folder",
    "run_in_forks",
    "synchronise_file",
    "synchronise_folder",
    "touch",
    "unacknowledged",
    "unlock",
    "write_at",
]

#: Numbers of the errors of file systems without locks.
NO_LOCKS = {errno.ENOLCK, errno.ENOSYS, errno.EOPNOTSUPP}

#: The byte that a lock covers on Windows, where others cannot read locked bytes: the last one of `msvcrt.locking`.
_LOCKED_BYTE = (1 << 31) - 2

_DIE_WITH_PARENT = 1  # PR_SET_PDEATHSIG of Linux
_NEW_PROCESS_GROUP = 0x200  # CREATE_NEW_PROCESS_GROUP of Windows


def open_own(path: Path, create: bool = False, *, write: bool = True) -> int:
    """Open a file of this program to read and write, or to read it alone; return its descriptor.

    Symbolic links are not followed, pipes are not waited for, and child processes do not inherit the file.

    Parameters
    ----------
    path : Path
    create : bool
        Create the file, for this user only, if it does not exist.
    write : bool

    Raises
    ------
    OSError
        If it cannot be opened, or is a symbolic link.
    """
    flags = (os.O_RDWR if write else os.O_RDONLY) | (os.O_CREAT if create else 0)
    if sys.platform == "win32":
        if path.is_symlink():
            raise OSError(errno.ELOOP, os.strerror(errno.ELOOP), str(path))
        return os.open(path, flags | os.O_BINARY | os.O_NOINHERIT, 0o600)
    return os.open(path, flags | os.O_NOFOLLOW | os.O_NONBLOCK | os.O_CLOEXEC, 0o600)


def lock(handle: int, *, wait: bool = False) -> bool:
    """Lock an open file against other programs until it is closed; return whether it was free.

    Raises
    ------
    OSError
        If the file system has no locks (`NO_LOCKS`), or fails; with ``wait`` also if it refuses the lock.
    """
    try:
        if sys.platform == "win32":
            _at_locked_byte(handle, msvcrt.LK_LOCK if wait else msvcrt.LK_NBLCK)
        else:
            fcntl.flock(handle, fcntl.LOCK_EX | (0 if wait else fcntl.LOCK_NB))
    except OSError as error:
        if wait or error.errno not in (errno.EAGAIN, errno.EACCES):  # the latter is what Windows says
            raise
        return False
    return True


def unlock(handle: int) -> None:
    """Release a lock; a process that was forked meanwhile may have the file open too."""
    with suppress(OSError):
        if sys.platform == "win32":
            _at_locked_byte(handle, msvcrt.LK_UNLCK)
        else:
            fcntl.flock(handle, fcntl.LOCK_UN)


def _at_locked_byte(handle: int, mode: int) -> None:
    if sys.platform == "win32":
        with _at(handle, _LOCKED_BYTE):
            msvcrt.locking(handle, mode, 1)


@contextmanager
def _at(handle: int, offset: int) -> Iterator[None]:
    """Move the position of a file for the length of a block."""
    position = os.lseek(handle, 0, os.SEEK_CUR)
    os.lseek(handle, offset, os.SEEK_SET)
    try:
        yield
    finally:
        os.lseek(handle, position, os.SEEK_SET)


def read_at(handle: int, length: int, offset: int) -> bytes:
    """Read up to ``length`` bytes at an offset; the position of the file stays. On Windows one thread at a time may."""
    if sys.platform == "win32":
        with _at(handle, offset):
            return os.read(handle, length)
    return os.pread(handle, length, offset)


def read_cached(handle: int, length: int, offset: int) -> bytes | None:
    """Read exactly so many bytes at an offset without waiting for the disk.

    None if they are not all in memory or the file is shorter, and always on macOS and Windows.
    """
    if sys.platform == "linux" and hasattr(os, "RWF_NOWAIT"):
        buffer = bytearray(length)
        with suppress(OSError):
            if os.preadv(handle, [buffer], offset, os.RWF_NOWAIT) == length:
                return bytes(buffer)
    return None


def write_at(handle: int, data: bytes, offset: int) -> int:
    """Write bytes at an offset and return how many were written; as `read_at`."""
    if sys.platform == "win32":
        with _at(handle, offset):
            return os.write(handle, data)
    return os.pwrite(handle, data, offset)


def touch(handle: int, path: Path) -> None:
    """Set the modification time of an open file, of this path, to now."""
    os.utime(handle if os.utime in os.supports_fd else path)


def close_and_remove(handle: int, path: Path) -> None:
    """Remove an open file and close it.

    Programs that wait for it see that it has no name any more. On Windows open files cannot be removed: it is closed
    first, and stays if another program opens it in between.

    Raises
    ------
    OSError
        If it cannot be removed; it is closed nevertheless.
    """
    if sys.platform == "win32":
        os.close(handle)
        with suppress(PermissionError):
            path.unlink(missing_ok=True)
        return
    try:
        path.unlink(missing_ok=True)
    finally:
        os.close(handle)


def remove_closed(path: Path) -> None:
    """Remove a file that could not be removed with its folder because it was open, and the folder; only on Windows.

    Both stay if another program has opened the file, or created another one, in between.
    """
    if sys.platform == "win32":
        with suppress(OSError):
            path.unlink()
            path.parent.rmdir()


def remove_folder(folder: Path) -> None:
    """Remove a folder with its contents, as far as possible.

    On Windows files that are mapped or open cannot be removed: maps that nothing refers to any more are closed first.
    """
    if sys.platform == "win32":
        gc.collect()
    shutil.rmtree(folder, ignore_errors=True)


def is_of_another_user(status: os.stat_result) -> bool:
    """Return whether a file belongs to another user than that of this process; False on Windows."""
    return sys.platform != "win32" and status.st_uid != os.geteuid()


def is_writable_by_others(status: os.stat_result) -> bool:
    """Return whether other users may write to a file by its mode; False on Windows, where modes do not say it."""
    return sys.platform != "win32" and bool(status.st_mode & (stat.S_IWGRP | stat.S_IWOTH))


def give_to_owner(path: Path, status: os.stat_result) -> None:
    """Give a file to the owner of another one, if this process may; nothing on Windows."""
    if sys.platform != "win32":
        with suppress(PermissionError):
            os.chown(path, status.st_uid, status.st_gid)


def synchronise_file(handle: int) -> None:
    """Put the bytes of an open file on disk; on macOS that includes the memory of the disk.

    Raises
    ------
    OSError
        If the disk fails: bytes that were written may be lost, and synchronising again does not tell.
    """
    if sys.platform == "darwin":
        with suppress(OSError):  # not every file system can
            fcntl.fcntl(handle, fcntl.F_FULLFSYNC)
            return
    os.fsync(handle)


def synchronise_folder(folder: Path, *, must: bool = False) -> None:
    """Put the names in a folder on disk, where folders can be opened; Windows does so by itself.

    Parameters
    ----------
    folder : Path
    must : bool
        Whether a failure is an error; otherwise the names are put there as far as possible.

    Raises
    ------
    OSError
        If the folder cannot be opened or the disk fails, with ``must``.
    """
    if sys.platform == "win32":
        return
    try:
        handle = os.open(folder, os.O_RDONLY | os.O_DIRECTORY)
        try:
            os.fsync(handle)
        finally:
            os.close(handle)
    except OSError as error:  # a process that is confined, or a file system that cannot
        if must and error.errno not in (errno.EINVAL, errno.ENOTSUP):
            raise


def allocate(path: Path) -> None:
    """Preallocate a file of its present length: writing to a map of it on a full disk would kill the process (SIGBUS).

    Nothing on macOS, which has no such call, and on Windows, where files have their space when they have their length.

    Raises
    ------
    OSError
        If the disk has no space for it.
    """
    if sys.platform == "win32" or sys.platform == "darwin":
        return
    with path.open("r+b") as file:
        try:
            os.posix_fallocate(file.fileno(), 0, os.fstat(file.fileno()).st_size)
        except OSError as error:
            if error.errno in (errno.ENOSPC, errno.EDQUOT, errno.EFBIG):
                raise OSError(error.errno, os.strerror(error.errno), os.fspath(path)) from None
            # Some file systems cannot.


def cache_home() -> Path:
    """Return the folder in which programs of this user keep what they can do without.

    Raises
    ------
    FileNotFoundError
        If this user has no home, as in a container under a number that has no name.
    """
    if chosen := os.environ.get("XDG_CACHE_HOME", "").strip():
        return Path(chosen)
    if sys.platform == "win32" and (local := os.environ.get("LOCALAPPDATA")):
        return Path(local)
    try:
        home = Path.home()
    except RuntimeError:
        raise FileNotFoundError(errno.ENOENT, "this user has no home; set XDG_CACHE_HOME to a folder") from None
    return home / ("Library/Caches" if sys.platform == "darwin" else ".cache")


def processors() -> int:
    """Return how many processors this process may use; of macOS and Windows, how many there are."""
    if sys.platform == "win32" or sys.platform == "darwin":
        return os.cpu_count() or 1
    return max(1, len(os.sched_getaffinity(0)))


def memory_of_machine() -> int:
    """Return the memory of the machine in bytes, 0 where it is unknown."""
    if sys.platform == "win32":
        status = _MemoryStatus(length=ctypes.sizeof(_MemoryStatus))
        known = ctypes.windll.kernel32.GlobalMemoryStatusEx(ctypes.byref(status))
        return int(status.total_physical) if known else 0
    try:
        return os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES")
    except (OSError, ValueError):
        return 0


class _MemoryStatus(ctypes.Structure):
    """MEMORYSTATUSEX of Windows."""

    _fields_ = [
        ("length", ctypes.c_uint32),
        ("load", ctypes.c_uint32),
        ("total_physical", ctypes.c_uint64),
        ("others", ctypes.c_uint64 * 6),
    ]


def memory_of_process() -> list[int]:
    """Return the limits of the memory of this process in bytes; none on Windows."""
    limits: list[int] = []
    if sys.platform != "win32":
        limits = [resource.getrlimit(kind)[0] for kind in (resource.RLIMIT_AS, resource.RLIMIT_DATA)]
        limits = [limit for limit in limits if limit != resource.RLIM_INFINITY]
    return limits


def limit_memory(budget: int) -> None:
    """Let this process take so many bytes more, and end it with its parent; only on Linux."""
    if sys.platform == "linux":
        ctypes.CDLL(None).prctl(_DIE_WITH_PARENT, signal.SIGKILL)
        with open("/proc/self/status", encoding="utf-8") as status:
            used = next(int(line.split()[1]) << 10 for line in status if line.startswith("VmData"))
        lower_limit("DATA", used + budget)


def limit_processor(seconds: int) -> None:
    """Let this process take so many seconds of a processor, and write no file; not on Windows."""
    lower_limit("CPU", seconds)
    lower_limit("CORE", 0)
    lower_limit("FSIZE", 0)


def limit_files(count: int) -> None:
    """Let this process open so many files beside those that are open; not on Windows."""
    if sys.platform != "win32":
        free = os.open(os.devnull, os.O_RDONLY)
        os.close(free)
        lower_limit("NOFILE", free + count)


def lower_limit(name: Literal["CORE", "CPU", "DATA", "FSIZE", "NOFILE"], limit: int, *, grace: int = 0) -> None:
    """Lower a limit of POSIX (``RLIMIT_`` and the name) for this process for good; nothing on Windows.

    Parameters
    ----------
    name : str
    limit : int
        The process is told by a signal when it exceeds the limit, or its call fails.
    grace : int
        How much more it may take until it is killed, for a limit that does so.
    """
    if sys.platform != "win32":
        kind = getattr(resource, f"RLIMIT_{name}")
        hard = _at_most(limit + grace, resource.getrlimit(kind)[1])
        resource.setrlimit(kind, (min(limit, hard), hard))


def _at_most(limit: int, hard: int) -> int:
    if sys.platform != "win32" and hard != resource.RLIM_INFINITY:
        return min(limit, hard)
    return limit


@contextmanager
def limited_file_size(limit: int) -> Iterator[Callable[[], bool]]:
    """Limit the files that this process writes for the length of a block; no limit on Windows.

    Parameters
    ----------
    limit : int
        Length of a file in bytes.

    Yields
    ------
    callable
        Returns whether a file was to become longer, whatever the library that writes it makes of that.
    """
    exceeded: list[int] = []
    if sys.platform != "win32":
        before, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
        handler = signal.signal(signal.SIGXFSZ, lambda number, frame: exceeded.append(number))
        resource.setrlimit(resource.RLIMIT_FSIZE, (_at_most(limit, hard), hard))
    try:
        yield lambda: bool(exceeded)
    finally:
        if sys.platform != "win32":
            resource.setrlimit(resource.RLIMIT_FSIZE, (before, hard))
            signal.signal(signal.SIGXFSZ, handler)


def file_limit() -> int | None:
    """Return how many files this process may have open; None if that is not limited, as on Windows."""
    if sys.platform != "win32" and (limit := resource.getrlimit(resource.RLIMIT_NOFILE)[0]) != resource.RLIM_INFINITY:
        return limit
    return None


def raise_file_limit(count: int) -> int:
    """Let this process open at least so many files, or as many as the system allows; return which of the two holds."""
    if sys.platform != "win32":
        soft, hard = resource.getrlimit(resource.RLIMIT_NOFILE)
        count = _at_most(count, hard)
        if soft != resource.RLIM_INFINITY and soft < count:
            resource.setrlimit(resource.RLIMIT_NOFILE, (count, hard))
    return count


def unacknowledged(handle: int) -> int:
    """Return the bytes in a socket's send buffer that the other side has not acknowledged; 0 on Windows.

    Raises
    ------
    OSError
        If the system does not tell.
    ValueError
        If the socket is closed.
    """
    if sys.platform != "win32":
        return int(struct.unpack("i", fcntl.ioctl(handle, termios.TIOCOUTQ, bytes(4)))[0])
    return 0


def run_in_forks(function: Callable[[], Any]) -> None:
    """Have a function called in each process that is forked from this one; Windows has no forks."""
    if sys.platform != "win32":
        os.register_at_fork(after_in_child=function)


def keep_out_of_forks(begin: Callable[[], Any], end: Callable[[], Any]) -> None:
    """Have functions called in this process before each fork of it, and after; Windows has no forks."""
    if sys.platform != "win32":
        os.register_at_fork(before=begin, after_in_parent=end)


def new_session() -> dict[str, Any]:
    """Return arguments of `subprocess.Popen` for a process that Ctrl-C in this terminal does not reach."""
    if sys.platform == "win32":
        return {"creationflags": _NEW_PROCESS_GROUP}
    return {"start_new_session": True}


def kill_session(process: subprocess.Popen[bytes]) -> None:
    """Kill a process that was started in a session of its own, with all processes of that; on Windows, it alone."""
    if sys.platform == "win32":
        process.kill()
    else:
        os.killpg(process.pid, signal.SIGKILL)
