"""Landlock: which paths a process may open, by the system calls of Linux 5.13 and later."""

from __future__ import annotations

import ctypes
import errno
import os
import stat
import struct
import sys
from collections.abc import Iterable
from pathlib import Path

assert sys.platform == "linux"  # no other system has what follows

__all__ = ["NETWORK", "SCOPES", "restrict", "version"]

#: The versions of the interface that know of TCP, and of signals and abstract sockets to processes outside.
NETWORK, SCOPES = 4, 6

# The same numbers on every architecture.
_CREATE_RULESET, _ADD_RULE, _RESTRICT_SELF = 444, 445, 446
_VERSION = 1  # LANDLOCK_CREATE_RULESET_VERSION
_PATH_BENEATH = 1  # LANDLOCK_RULE_PATH_BENEATH

_EXECUTE, _WRITE_FILE, _READ_FILE, _READ_DIR = 1 << 0, 1 << 1, 1 << 2, 1 << 3
_REMOVE_DIR, _REMOVE_FILE, _MAKE_DIR, _MAKE_REG, _MAKE_SYM = 1 << 4, 1 << 5, 1 << 7, 1 << 8, 1 << 12
_TRUNCATE, _IOCTL_DEV = 1 << 14, 1 << 15

#: Rights to files that each version of the interface knows of, from the first on; later ones know all of them.
_KNOWN = ((1 << 13) - 1, (1 << 14) - 1, (1 << 15) - 1, (1 << 15) - 1, (1 << 16) - 1)

#: Of these alone a rule for a file may speak.
_OF_FILES = _EXECUTE | _WRITE_FILE | _READ_FILE | _TRUNCATE | _IOCTL_DEV

_READ = _READ_FILE | _READ_DIR
#: No devices, pipes or sockets are made, and nothing is moved or linked from one folder to another.
_WRITE = _READ | _WRITE_FILE | _TRUNCATE | _REMOVE_DIR | _REMOVE_FILE | _MAKE_DIR | _MAKE_REG | _MAKE_SYM

_ALL_NETWORK = 0b11  # bind and connect by TCP
_ALL_SCOPES = 0b11  # abstract sockets and signals to processes outside


def version(libc: ctypes.CDLL) -> int:
    """Return the version of the kernel's interface; 0 where there is none, or it is switched off."""
    return max(0, int(libc.syscall(_CREATE_RULESET, None, ctypes.c_size_t(0), _VERSION)))


def restrict(libc: ctypes.CDLL, read: Iterable[Path], write: Iterable[Path], execute: Iterable[Path]) -> bool:
    """Open nothing but these paths from now on; whether the kernel holds this thread to it.

    Paths that do not exist count for nothing. A process that may gain privileges cannot restrict itself.
    """
    known = version(libc)
    if not known:
        return False
    files = _KNOWN[min(known, len(_KNOWN)) - 1]
    attributes = struct.pack("=QQQ", files, _ALL_NETWORK, _ALL_SCOPES)
    # An older kernel knows only the beginning of it.
    size = 24 if known >= SCOPES else 16 if known >= NETWORK else 8
    ruleset = libc.syscall(_CREATE_RULESET, attributes, ctypes.c_size_t(size), 0)
    if ruleset < 0:
        return False
    try:
        for paths, rights in ((read, _READ), (write, _WRITE), (execute, _EXECUTE)):
            for path in paths:
                _allow(libc, ruleset, path, rights & files)
        return bool(libc.syscall(_RESTRICT_SELF, ruleset, 0) == 0)
    finally:
        os.close(ruleset)


def _allow(libc: ctypes.CDLL, ruleset: int, path: Path, rights: int) -> None:
    try:
        handle = os.open(path, os.O_PATH | os.O_CLOEXEC)
    except OSError:
        return
    try:
        if not stat.S_ISDIR(os.fstat(handle).st_mode):
            rights &= _OF_FILES
        rule = struct.pack("=Qi", rights, handle)
        if libc.syscall(_ADD_RULE, ruleset, _PATH_BENEATH, rule, 0):
            number = ctypes.get_errno()
            # A file of the kernel's own, such as those behind pipes, is not opened by a path, and needs no rule.
            if number != errno.EBADFD:
                raise OSError(number, os.strerror(number), os.fspath(path))
    finally:
        os.close(handle)
