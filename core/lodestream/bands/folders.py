"""The folder of a build: one process at a time builds in it, and nothing is removed there but what builds have made.

A file marks a folder of a build, and says which process is at work. It is locked as long as the build goes on, by the
process that hands out the tasks, and not by processes that were forked meanwhile.
"""

from __future__ import annotations

import errno
import hashlib
import os
import platform
import secrets
import shutil
import stat
from collections.abc import Collection, Iterator
from contextlib import ExitStack, contextmanager, suppress
from pathlib import Path
from tempfile import TemporaryDirectory

from ..errors import InputError
from ..scratch import FolderScratch

try:
    import fcntl
except ImportError:  # not on Windows
    fcntl = None  # type: ignore[assignment]

__all__ = ["TASKS", "Folder", "build_folder", "check_out", "passing_folder", "remove", "replacing"]

#: What `encode` makes in its folder: copies of a source, and builds by what they are of.
_SOURCE, TASKS = "source", "tasks"

_MARK = ".lodestream-build"
_OURS = b"A folder of a build of Lodestream, which has made it and removes it.\n"
_THEIRS = b"A folder that a build of Lodestream works in. What it has made is removed with this file.\n"
_PASSING = (
    b"A folder of a command of Lodestream, on the way to a file. It is removed when no process has it any more.\n"
)
#: How the name of such a folder ends.
_ON_THE_WAY = ".lodestream"
#: Bytes of a mark that are read.
_MOST = 1 << 10
#: What is on its way out: nobody can write there under its former name any more.
_REMOVED = ".lodestream-removed-"
#: Descriptors of the marks that this process has locked.
_HELD: set[int] = set()
#: What file systems without locks say.
_NO_LOCKS = {errno.ENOLCK, errno.ENOSYS, errno.EOPNOTSUPP}


class Folder:
    """The folder of a call of `encode`, which is made when it is needed.

    Parameters
    ----------
    stack : ExitStack
        When it ends, so does the use of the folder.
    scratch : path-like or None
        The folder that was named; None: one beside ``out``.
    out : path-like or None
        The container; None: the folder is one of the system's temporary ones.

    Raises
    ------
    InputError
        If ``out`` would stand in the folder that was named.
    """

    def __init__(
        self, stack: ExitStack, scratch: str | os.PathLike[str] | None, out: str | os.PathLike[str] | None
    ) -> None:
        self._stack, self._scratch, self._out = stack, scratch, out
        self._folder: Path | None = None
        self._copies: FolderScratch | None = None
        if scratch is not None and out is not None and Path(scratch).resolve() == Path(out).resolve().parent:
            raise InputError(f"expected a scratch folder of its own, got {scratch}, which {Path(out).name} goes to")

    def open(self) -> Path:
        """The folder; see `build_folder` for the errors."""
        if self._folder is None:
            if self._scratch is None and self._out is None:
                made = TemporaryDirectory(prefix="lodestream-", ignore_cleanup_errors=True)
                self._folder = Path(self._stack.enter_context(made))
            else:
                named = self._scratch is not None
                out = Path(self._out or "")
                folder = Path(str(self._scratch)) if named else out.with_name(f"{_short(out.name)}.build")
                self._folder = self._stack.enter_context(build_folder(folder, (_SOURCE, TASKS), named))
        return self._folder

    def copies(self) -> FolderScratch:
        """Where all copies of this call go of what is read once; those of a call before are removed."""
        if self._copies is None:
            folder = self.open() / _SOURCE
            remove(folder)
            self._copies = FolderScratch(folder / secrets.token_hex(8))
        return self._copies


def _short(name: str) -> str:
    """A name to which a few letters can be added: 255 bytes are what file systems take."""
    encoded = os.fsencode(name)
    return name if len(encoded) < 240 else f"{name[:50]}.{hashlib.sha256(encoded).hexdigest()[:16]}"


def check_out(path: Path) -> None:
    """Say before any work that a file cannot be written.

    Raises
    ------
    OSError
        If its folder is not there, or it is a folder itself.
    """
    if not path.parent.is_dir():
        raise FileNotFoundError(
            errno.ENOENT, "expected a folder to write a container into, there is none", str(path.parent)
        )
    if path.is_dir():
        raise IsADirectoryError(errno.EISDIR, "expected the name of a container to write, got a folder", str(path))


@contextmanager
def replacing(path: Path) -> Iterator[Path]:
    """A path for a new file, which takes the place of ``path`` when it is whole; no other process writes to it.

    A link stays a link. A pipe or a device is not replaced: the file is copied into it.
    """
    if path.exists() and not path.is_file():  # before links are followed: that of a pipe leads to no path
        with TemporaryDirectory(prefix="lodestream-") as folder:
            yield (made := Path(folder) / "container")
            with made.open("rb") as whole, path.open("wb") as out:
                shutil.copyfileobj(whole, out)
        return
    path = path.resolve()
    unfinished = path.with_name(f".{path.name[:50]}.{secrets.token_hex(6)}.part")
    try:
        yield unfinished
        os.replace(unfinished, path)
    finally:
        unfinished.unlink(missing_ok=True)


@contextmanager
def build_folder(folder: Path, entries: Collection[str], named: bool) -> Iterator[Path]:
    """Have a folder for oneself, for the files of a build.

    Parameters
    ----------
    folder : Path
        Is made where it is not there; else it is empty, or was used in this way before.
    entries : collection of str
        Names in it under which the build keeps all that it makes. They are gone afterwards, and the folder too if it
        was made here. Other files stay.
    named : bool
        Somebody has named it: the folders above it are made as well, and if the block fails all stays as it is.

    Raises
    ------
    InputError
        If there is something else, another build is at work there, or it belongs to another user and was not named.
    OSError
        If it cannot be made.
    """
    folder = folder.absolute()
    handle = _marked(folder, named)
    _HELD.add(handle)
    try:
        _clean(folder, [])
        try:
            yield folder
        except BaseException:
            if not named:
                _end(folder, handle, entries)
            raise
        _end(folder, handle, entries)
    finally:
        _let_go(handle)


@contextmanager
def passing_folder(beside: Path, entries: Collection[str]) -> Iterator[Path]:
    """A folder beside a file for what is made on the way to it, gone afterwards.

    Such folders that a killed process of this user and machine has left there are removed first.

    Parameters
    ----------
    beside : Path
    entries : collection of str
        Names in it under which all is that is made there; nothing else is ever removed.

    Raises
    ------
    OSError
        If it cannot be made.
    """
    above = beside.resolve().parent
    for left in above.glob(f".*{_ON_THE_WAY}") if fcntl is not None else ():
        with suppress(OSError):  # it is another user's, or somebody is at work there
            _remove_left(left, entries)
    folder = above / f".{beside.name[:50]}.{secrets.token_hex(6)}{_ON_THE_WAY}"
    folder.mkdir(0o700)
    try:
        handle = os.open(folder / _MARK, os.O_RDWR | os.O_CREAT | os.O_EXCL, 0o600)
    except OSError:
        folder.rmdir()  # without a mark nobody would remove it
        raise
    _HELD.add(handle)
    try:
        _lock(handle, folder)
        os.write(
            handle, _PASSING + _signature()
        )  # when it is locked: before that nobody takes it for one that was left
        yield folder
    finally:
        if handle in _HELD:  # else this is a fork
            if fcntl is None:
                _let_go(handle)
            with suppress(OSError):
                _remove_passing(folder, entries)
            _let_go(handle)


def _remove_left(folder: Path, entries: Collection[str]) -> None:
    """Remove a folder of `passing_folder` if nobody is at work there, and it is certain that it is one.

    All is done by the folder that was opened: whoever may write beside it could put a link to another in its place.
    """
    opened = os.open(folder, os.O_RDONLY | os.O_DIRECTORY | os.O_NOFOLLOW)
    try:
        if os.fstat(opened).st_uid != os.geteuid():
            return
        handle = os.open(_MARK, os.O_RDWR | os.O_NOFOLLOW | os.O_NONBLOCK, dir_fd=opened)
        try:
            mark = os.fstat(handle)
            said = os.read(handle, _MOST).splitlines(keepends=True)
            ours = stat.S_ISREG(mark.st_mode) and mark.st_nlink == 1 and mark.st_uid == os.geteuid()
            here = len(said) == 2 and said[1].endswith(_signature().partition(b" on ")[2])
            if ours and here and said[0] == _PASSING:
                fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)  # an error where file systems have no locks
                _remove_passing(folder, entries, opened)
        finally:
            os.close(handle)
    finally:
        os.close(opened)


def _remove_passing(folder: Path, entries: Collection[str], opened: int | None = None) -> None:
    """Remove what was made, then the mark: what is left of a removal that was cut has its mark still."""
    within = Path() if opened is not None else folder
    for entry in entries:
        shutil.rmtree(within / entry, ignore_errors=True, dir_fd=opened)
    if os.listdir(folder if opened is None else opened) == [_MARK]:
        os.unlink(within / _MARK, dir_fd=opened)
        folder.rmdir()


def _let_go(handle: int) -> None:
    if handle not in _HELD:
        return  # it was done before, or in this process, a fork of the one that builds
    _HELD.remove(handle)
    if fcntl is not None:
        with suppress(OSError):
            fcntl.flock(handle, fcntl.LOCK_UN)  # a process that is being forked may have it open too
    os.close(handle)


def _forked() -> None:
    """Close what a process has inherited, so that a lock ends with the process that took it."""
    while _HELD:
        os.close(_HELD.pop())


if hasattr(os, "register_at_fork"):  # not on Windows
    os.register_at_fork(after_in_child=_forked)


def remove(path: Path) -> None:
    """Remove a folder, if it is there, with all that is in it; a late task finds none under its name to write into."""
    away = path.with_name(f"{_REMOVED}{secrets.token_hex(6)}")
    try:
        path.rename(away)
    except FileNotFoundError:
        return
    shutil.rmtree(away, ignore_errors=True)


def _marked(folder: Path, named: bool) -> int:
    """The mark of a folder, locked, as a file descriptor."""
    while True:
        made = _make(folder, named)
        mark = folder / _MARK
        _check(folder, mark, named)
        try:
            handle = os.open(mark, os.O_RDWR | os.O_CREAT | getattr(os, "O_NOFOLLOW", 0), 0o666)
        except FileNotFoundError:  # the build that had it has just removed the folder
            continue
        try:
            _lock(handle, folder)
            with suppress(FileNotFoundError):
                if os.path.samestat(os.fstat(handle), os.lstat(mark)):
                    _sign(handle, made)
                    return handle
        except BaseException:
            os.close(handle)
            raise
        os.close(handle)


def _make(folder: Path, named: bool) -> bool:
    """Whether the folder was not there."""
    if named:
        folder.parent.mkdir(parents=True, exist_ok=True)
    try:
        folder.mkdir()
    except FileExistsError:
        return False
    return True


def _check(folder: Path, mark: Path, named: bool) -> None:
    try:
        used = not folder.is_dir() or (not os.path.lexists(mark) and any(folder.iterdir()))
        others = not named and hasattr(os, "geteuid") and folder.stat().st_uid != os.geteuid()
    except FileNotFoundError:
        return
    if used and not os.path.lexists(mark):
        raise InputError(f"expected {folder} to be empty or of a build that was cut, got something else, which stays")
    if others:
        raise InputError(f"expected {folder} to be a folder of this user, got one of another; scratch= names another")


def _lock(handle: int, folder: Path) -> None:
    if fcntl is None:
        return
    try:
        fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError:
        raise InputError(
            f"expected {folder} to be free for this build, another one is at work there{_signed(handle)}; "
            "scratch= names another folder"
        ) from None
    except OSError as error:
        if error.errno not in _NO_LOCKS:
            raise


def _sign(handle: int, made: bool) -> None:
    """Write into a mark whose folder it is, if that is not there yet, and who is at work."""
    whose = _first_line(handle) or (_OURS if made else _THEIRS)
    os.lseek(handle, 0, os.SEEK_SET)
    os.ftruncate(handle, 0)
    os.write(handle, whose + _signature())


def _signature() -> bytes:
    return f"process {os.getpid()} on {platform.node()}\n".encode("ascii", "replace")


def _first_line(handle: int) -> bytes:
    os.lseek(handle, 0, os.SEEK_SET)
    return b"".join(os.read(handle, _MOST).splitlines(keepends=True)[:1])


def _signed(handle: int) -> str:
    """Who is at work, as the mark says."""
    os.lseek(handle, 0, os.SEEK_SET)
    lines = os.read(handle, _MOST).decode("ascii", "replace").splitlines()
    return f" ({lines[1]})" if len(lines) > 1 and lines[1].isprintable() else ""


def _clean(folder: Path, entries: Collection[str]) -> None:
    for entry in entries:
        remove(folder / entry)
    for path in folder.glob(f"{_REMOVED}*"):
        shutil.rmtree(path, ignore_errors=True)


def _end(folder: Path, handle: int, entries: Collection[str]) -> None:
    if handle not in _HELD:
        return  # this is a fork of the process that builds
    _clean(folder, entries)
    if any(folder.glob(f"{_REMOVED}*")):
        return  # what could not be removed stays marked
    ours = _first_line(handle) == _OURS
    if fcntl is None:
        _let_go(handle)  # Windows removes no file that is open
    with suppress(FileNotFoundError):
        (folder / _MARK).unlink()
    if ours:
        with suppress(OSError):
            folder.rmdir()  # it stays if somebody has put anything there
