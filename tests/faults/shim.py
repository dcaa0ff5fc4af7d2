"""The shim below Python: compiling `shim.c`, and telling it which call is to fail.

A `Fault` names a call by what it is, where in the server's folder its path lies, and its number among such calls since
the shim was told. Nothing is known of the server's code: every call that a scenario makes is seen, and each can fail.
"""

from __future__ import annotations

import ctypes
import errno
import mmap
import os
import platform
import re
import shutil
import subprocess
import sys
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

__all__ = ["ERRORS", "SHORT", "CannotError", "Fault", "Shim", "Site", "library"]

#: In place of an errno: fewer bytes than were asked for.
SHORT = "short"

_SOURCE = Path(__file__).with_name("shim.c")
_FLAGS = ("-O1", "-fPIC", "-shared", "-Wall", "-Wextra", "-Werror")

_FRAME = re.compile(r'File "([^"]+)", line (\d+) in')

_PASS, _COUNT, _FAIL = range(3)

_READING = ("EIO", "EACCES", "ESTALE")
_NAMING = ("EIO", "EACCES", "EROFS", "ESTALE")
_WRITING = ("EIO", "ENOSPC", "ESTALE")

#: What each call may fail with. None of these says that there is nothing: that would be an answer, not a failure.
ERRORS: dict[str, tuple[str, ...]] = {
    "open to read": (*_READING, "EMFILE"),
    "open to write": (*_NAMING, "ENOSPC", "EMFILE"),
    "read": ("EIO", "ESTALE", SHORT),
    "pread": ("EIO", "ESTALE", SHORT),
    "write": (*_WRITING, SHORT),
    "fsync": _WRITING,
    "rename": (*_NAMING, "ENOSPC", "EXDEV"),
    "unlink": _NAMING,
    "rmdir": _NAMING,
    "mkdir": (*_NAMING, "ENOSPC"),
    "opendir": (*_READING, "EMFILE"),
    "readdir": ("EIO", "ESTALE"),
    "stat": _READING,
    "fstat": ("EIO", "ESTALE"),
    "access": _READING,
    "link": (*_NAMING, "ENOSPC", "EXDEV"),
    "symlink": (*_NAMING, "ENOSPC"),
    "readlink": _READING,
    "truncate": (*_NAMING, "ENOSPC"),
    "flock": ("EIO", "ENOLCK", "ESTALE"),
    "statvfs": _READING,
    "sendfile": (*_WRITING, SHORT),
    "copy_file_range": (*_WRITING, "EXDEV", SHORT),
    "utime": _NAMING,
    "chmod": _NAMING,
    "chown": _NAMING,
    "close": _WRITING,
}


class CannotError(Exception):
    """Calls cannot be made to fail on this machine, for the reason that it gives."""


@dataclass(frozen=True, order=True)
class Fault:
    """A call that is to fail.

    Attributes
    ----------
    call : str
        A key of `ERRORS`.
    place : str
        Where its path lies: one of the names given to `library`, and what is there, such as ``uploads/*/N``.
    number : int
        Which of these calls, from 0.
    error : str
        Name of an errno, or `SHORT`.
    times : int
        How many calls from this one on fail.
    """

    call: str
    place: str
    number: int
    error: str
    times: int = 1

    def __str__(self) -> str:
        again = "" if self.times == 1 else f", {self.times} times"
        return f"{self.call} {self.place or 'the folder'} #{self.number}: {self.error}{again}"


@dataclass(frozen=True, order=True)
class Site:
    """Where calls come from.

    Attributes
    ----------
    call, place : str
        As in `Fault`.
    lines : str
        The lines of this program's files that lead to it, the innermost first.
    """

    call: str
    place: str
    lines: str


class Shim:
    """The page that all processes under the shim share.

    Parameters
    ----------
    library : Path
        As `library` made it.
    page : Path
        A file to be made for the page, outside the folders in which calls fail.
    """

    def __init__(self, library: Path, page: Path) -> None:
        names = ctypes.CDLL(str(library))
        self._calls = _names(names.lode_call)
        self._places = _names(names.lode_place)
        names.lode_size.restype = ctypes.c_size_t
        kind = _layout(len(self._calls), len(self._places))
        assert ctypes.sizeof(kind) == names.lode_size(), "expected the page of shim.c"
        assert set(self._calls) == set(ERRORS), "expected errors for every call of shim.c"
        page.write_bytes(bytes(ctypes.sizeof(kind)))
        with page.open("r+b") as file:
            self._page: Any = kind.from_buffer(mmap.mmap(file.fileno(), 0))
        self._log = page.with_suffix(".calls")
        self._environment = {
            "LD_PRELOAD": str(library),
            "LODE_FAULT_CONTROL": str(page),
            "LODE_FAULT_CALLS": str(self._log),
        }

    def environment(self) -> dict[str, str]:
        """The environment of a process whose calls are to be counted and to fail."""
        return {**os.environ, **self._environment}

    def beneath(self, root: Path) -> None:
        """Say in which folder calls are counted and fail."""
        self._page.mode = _PASS
        self._page.root = os.fsencode(os.path.realpath(root))

    @contextmanager
    def counting(self) -> Iterator[None]:
        """Write down what is called meanwhile, for `sites`."""
        # Emptied, not removed: those who write into it have it open.
        self._log.write_bytes(b"")
        with self._at_work(_COUNT):
            yield

    @contextmanager
    def failing(self, fault: Fault) -> Iterator[None]:
        """Let a call fail meanwhile."""
        page = self._page
        page.mode = _PASS
        page.call, page.place = self._calls.index(fault.call), self._places.index(fault.place)
        page.number, page.times = fault.number, fault.times
        page.error = -1 if fault.error == SHORT else getattr(errno, fault.error)
        with self._at_work(_FAIL):
            yield

    @contextmanager
    def _at_work(self, mode: int) -> Iterator[None]:
        page = self._page
        ctypes.memset(page.counts, 0, ctypes.sizeof(page.counts))
        page.hits = 0
        page.hit = b""
        page.mode = mode
        try:
            yield
        finally:
            page.mode = _PASS

    @property
    def hits(self) -> int:
        """How many calls have failed since the last `failing`."""
        return int(self._page.hits)

    @property
    def hit(self) -> str:
        """Which path that was, the last one."""
        return os.fsdecode(self._page.hit)

    def sites(self) -> dict[Site, list[int]]:
        """Which calls there were since `counting`: by site, their numbers among the same calls in the same place."""
        found: dict[Site, list[int]] = {}
        for entry in self._log.read_text().split("= ")[1:]:
            head, *lines = entry.splitlines()
            call, place, number = map(int, head.split())
            frames = [frame for line in lines if (frame := _FRAME.search(line))]
            # Of Python's own files only where there is none of ours: what a library does by itself.
            ours = [frame for frame in frames if "lodestream" in frame[1]] or frames[:2]
            words = (f"{frame[1].rpartition('/')[2]}:{frame[2]}" for frame in ours)
            # A process that does not say where it is: each of its calls counts as a site.
            lines_of = " < ".join(words) or f"a process that builds, number {number}"
            found.setdefault(Site(self._calls[call], self._places[place], lines_of), []).append(number)
        return found


def library(folder: Path, places: Sequence[str]) -> Path:
    """Compile the shim into a folder, and see whether it works here.

    Parameters
    ----------
    folder : Path
    places : sequence of str
        The files and folders in which calls are told apart, by their paths; one within another comes after it.

    Raises
    ------
    CannotError
        When there is no compiler, or calls cannot be intercepted.
    """
    compiler = next(filter(None, map(shutil.which, ("cc", "gcc", "clang"))), None)
    if compiler is None:
        raise CannotError("there is no C compiler")
    if sys.platform != "linux" or platform.libc_ver()[0] != "glibc":
        raise CannotError("calls are intercepted on Linux with glibc only")
    made = folder / "shim.so"
    tops = " ".join(f'X("{name}")' for name in ("", *places, "other"))
    command = [compiler, *_FLAGS, f"-DTOPS(X)={tops}", "-o", str(made), str(_SOURCE), "-ldl"]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    _probe(made, folder, places[0])
    return made


def _probe(made: Path, folder: Path, place: str) -> None:
    root = folder / "probe"
    root.mkdir()
    shim = Shim(made, folder / "probe.page")
    shim.beneath(root)
    with shim.failing(Fault("mkdir", place, 0, "EIO")):
        program = f"import os; os.mkdir({str(root / place)!r})"
        command = [sys.executable, "-I", "-c", program]
        done = subprocess.run(command, env=shim.environment(), capture_output=True, text=True, check=False)
    if shim.hits == 0:
        raise CannotError(f"LD_PRELOAD has no effect on {sys.executable}: {done.stderr.strip()[-200:]}")


def _names(ask: Any) -> list[str]:
    ask.restype = ctypes.c_char_p
    names: list[str] = []
    while (name := ask(len(names))) is not None:
        names.append(name.decode())
    return names


def _layout(calls: int, places: int) -> type[ctypes.Structure]:
    class Page(ctypes.Structure):
        _fields_ = (
            ("mode", ctypes.c_uint32),
            ("call", ctypes.c_int32),
            ("place", ctypes.c_int32),
            ("number", ctypes.c_uint32),
            ("times", ctypes.c_uint32),
            ("error", ctypes.c_int32),
            ("hits", ctypes.c_uint32),
            ("writing", ctypes.c_uint32),
            ("counts", ctypes.c_uint32 * places * calls),
            ("root", ctypes.c_char * 4096),
            ("hit", ctypes.c_char * 4096),
        )

    return Page
