"""A process that reads a stranger's file gives up, for good, everything that reading it does not need.

On Linux the kernel sees to it: Landlock to paths, seccomp to system calls. Only the standard library is imported here.
"""

from __future__ import annotations

import ctypes
import os
import sys
import warnings
from collections.abc import Collection
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from .places import library_places

if TYPE_CHECKING or sys.platform == "linux":
    from . import landlock, seccomp

__all__ = ["Rights", "available", "confine", "missing"]

_NO_NEW_PRIVILEGES = 38  # PR_SET_NO_NEW_PRIVS
_CAPABILITY_VERSION = 0x20080522  # _LINUX_CAPABILITY_VERSION_3


@dataclass(frozen=True)
class Rights:
    """What a process keeps, beside Python, libraries and their data, which it may read.

    Attributes
    ----------
    read : tuple of Path
        Files, and folders with all that is in them.
    write : tuple of Path
        Folders in which it may do anything with files and folders, and single files.
    processes : bool
        Whether it may start processes, which have the same rights.
    threads : bool
        Whether it may start threads, which have the same rights; it may where it may start processes.
    descriptors : bool
        Whether it may receive descriptors of open files, over a socket that it has when it confines itself.
    """

    read: tuple[Path, ...] = ()
    write: tuple[Path, ...] = ()
    processes: bool = False
    threads: bool = False
    descriptors: bool = False


def confine(rights: Rights) -> tuple[str, ...]:
    """Give up everything else, for this process and all that it starts.

    No sockets are opened, no other process is looked into, sent a signal or given other limits, also none that this one
    has started, nothing is executed, no mode, owner or time of a file is changed. What is open stays open. The process
    should have one thread: Landlock holds the thread that calls this, and those that it starts.

    Returns
    -------
    tuple of str
        What holds from now on, out of "landlock" and "seccomp"; the kernel may have neither.
    """
    if sys.platform != "linux":
        return ()
    libc = ctypes.CDLL(None, use_errno=True)
    if libc.prctl(_NO_NEW_PRIVILEGES, 1, 0, 0, 0):
        return ()
    held = []
    # A folder with more than libraries in it, such as that of a script, must not open the folder of the uploads.
    own = {above for path in (*rights.read, *rights.write) for above in (path.absolute(), *path.absolute().parents)}
    libraries = tuple(path for path in library_places(processes=rights.processes) if path not in own)
    write = (*rights.write, Path(os.devnull))
    if landlock.restrict(libc, (*libraries, *rights.read), write, libraries if rights.processes else ()):
        held.append("landlock")
    _drop_capabilities(libc)
    calls = {"processes": rights.processes, "threads": rights.threads, "descriptors": rights.descriptors}
    if seccomp.restrict(libc, os.getpid(), **calls):
        held.append("seccomp")
    return tuple(held)


def available() -> tuple[str, ...]:
    """Return what `confine` returns on this machine, found out by a forked process that confines itself and ends."""
    if sys.platform != "linux":
        return ()
    ours, theirs = os.pipe()
    with warnings.catch_warnings():
        # Python warns of threads, which may hold locks; the process waits for no lock of this one.
        warnings.simplefilter("ignore", DeprecationWarning)
        process = os.fork()
    if not process:
        try:
            os.write(theirs, " ".join(confine(Rights())).encode())
        finally:
            os._exit(0)
    os.close(theirs)
    with os.fdopen(ours, "rb") as pipe:
        held = pipe.read()
    os.waitpid(process, 0)
    return tuple(held.decode().split())


def missing(held: Collection[str]) -> tuple[str, ...]:
    """Say what a confined process may still do on this machine, a sentence for each mechanism that does not hold it.

    Parameters
    ----------
    held : collection of str
        What `confine` has returned, or would return (`available`).

    Returns
    -------
    tuple of str
        Each begins with "landlock" or "seccomp"; empty if both hold.
    """
    if sys.platform != "linux":
        return ("landlock and seccomp: only Linux has them, so a build may do what the server may do",)
    sentences = []
    known = landlock.version(ctypes.CDLL(None, use_errno=True)) if "landlock" in held else 0
    if "landlock" not in held:
        sentences.append("landlock: a build may open every file that the server may open")
    if "seccomp" not in held:
        sockets = "sockets" if known < landlock.NETWORK else "sockets other than TCP"
        signals = "send signals to other processes and change their limits"
        others = signals if known < landlock.SCOPES else "change limits of other processes"
        sentences.append(f"seccomp: a build may open {sockets}, {others}, and change modes and times of files")
    return tuple(sentences)


def _drop_capabilities(libc: ctypes.CDLL) -> None:
    """Be no more than its user, even if that is root; nothing to do where there are none."""
    header = (ctypes.c_uint32 * 2)(_CAPABILITY_VERSION, 0)
    nothing = (ctypes.c_uint32 * 6)()
    libc.capset(header, nothing)
