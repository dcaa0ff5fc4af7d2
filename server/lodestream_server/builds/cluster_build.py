"""A process that builds a surface with the workers of a Dask cluster, after a confined process has parsed it.

The process gets a `ClusterJob` as a line of JSON on its standard input and writes its answer, see `answers.answer_of`,
to its standard output. It ends when its standard input does: with the server.

What the confined process has left is not trusted. Before anything is opened or written in its folder, it is looked
through: there may be nothing but folders and plain files of their own, and all but the parsed arrays are removed. The
arrays are read as numbers. Tasks are files that this process writes into a folder of its own (`work.tasks_of`), where
the confined process could never write.
"""

from __future__ import annotations

import os
import stat
import sys
import threading
import warnings
from contextlib import ExitStack
from dataclasses import dataclass
from pathlib import Path

from pydantic import TypeAdapter

from lodestream.errors import FormatWarning, InputError, LodestreamError, OptionError, TooLargeError, UnavailableError
from lodestream.operating_system import lower_limit

from ..store.durable import discard, make_folder, remove
from . import thumbnails
from .answers import answer_of
from .work import tasks_of
from .worker import Built, Job, Refused, may_pass, moved, raise_passing, reporter

__all__ = ["ClusterJob", "build", "check_plain", "keep_parsed"]

# What Dask takes with its threads.
_BESIDE = 512 << 20


@dataclass(frozen=True)
class ClusterJob:
    """What such a process is to do.

    Attributes
    ----------
    job : Job
        The build, whose surface is parsed.
    address : str
        Of the scheduler.
    memory : int
        Bytes for this process, and for each worker, to work in.
    """

    job: Job
    address: str
    memory: int


def main() -> None:
    """Carry out the job that arrives on the standard input."""
    task = TypeAdapter(ClusterJob).validate_json(sys.stdin.buffer.readline())
    threading.Thread(target=_end_with_parent, daemon=True).start()
    # What does not go by bands after all must not take the memory of everybody else.
    lower_limit("DATA", 2 * task.memory + _BESIDE)
    sys.stdout.buffer.write(answer_of(lambda: build(task)))


def build(task: ClusterJob) -> Built | Refused:
    """Build a parsed surface.

    Raises
    ------
    OSError
        If a disk is full, here or for a worker, or the system lacks something else.
    MemoryError
        If memory does not suffice, here or for a worker.
    """
    try:
        return _build(task)
    except LodestreamError as error:
        raise_passing(error)
        return Refused(str(error), final=not may_pass(error))


def _end_with_parent() -> None:
    # Not through sys.stdin, whose lock the interpreter takes when it ends.
    while os.read(0, 1 << 12):
        pass
    os._exit(1)


def _build(task: ClusterJob) -> Built | Refused:
    from lodestream import encode
    from lodestream.encoding.cluster import executor_of
    from lodestream.encoding.stored_surface import load_surface
    from lodestream.scratch import FolderScratch

    from .stored_quality import without_quality

    job = task.job
    keep_parsed(job)
    surface = load_surface(FolderScratch(job.parsed))
    if surface is None:
        raise InputError("expected a parsed surface, got none")
    vertices = sum(block.shape[0] * block.shape[1] for block in surface.blocks)
    if vertices > job.max_vertices:
        raise TooLargeError(f"expected at most {job.max_vertices:,} vertices, got {vertices:,}")
    quality, _ = without_quality(job.options)
    tasks = tasks_of(job.folder)
    make_folder(tasks)
    container = tasks / "made"
    with ExitStack() as stack:
        stack.callback(discard, tasks)
        try:
            executor = stack.enter_context(executor_of(task.address))
        except (OptionError, UnavailableError) as error:
            return Refused(f"LODESTREAM_DASK: {error}", final=False)
        stack.enter_context(warnings.catch_warnings())
        warnings.simplefilter("ignore", FormatWarning)  # it stands in the notes
        try:
            encode(
                surface,
                quality=quality,
                progress=reporter(job.folder),
                out=container,
                memory=task.memory,
                executor=executor,
            )
        except (LodestreamError, MemoryError) as error:
            if isinstance(error.__cause__, FileNotFoundError):
                return Refused("LODESTREAM_DASK: its workers do not see the data folder at its path here", final=False)
            raise
        except Exception as error:
            if getattr(error, "errno", None) is not None:
                raise
            # Of Dask: workers died, the scheduler has gone, a worker lacks this package or has another version.
            words = str(error) or "the scheduler has ended, or has dropped the tasks"
            return Refused(f"LODESTREAM_DASK: the cluster gave up: {type(error).__name__}: {words}", final=False)
        return Built(moved(container, job.container), thumbnail=thumbnails.draw(job.container))


def keep_parsed(job: Job) -> None:
    """Remove all files of a parser but its arrays, so that nothing of it is written to or followed.

    Raises
    ------
    InputError
        If there is anything but folders and plain files.
    OSError
        If something cannot be removed.
    """
    check_plain(job.folder)
    for folder, kept in ((job.folder, job.scratch), (job.scratch, job.parsed)):
        if not kept.is_dir():
            raise InputError(f"expected a folder of arrays, got none at {kept.name}")
        for path in folder.iterdir():
            if path != kept:
                remove(path)


def check_plain(folder: Path) -> None:
    """Refuse a folder with anything but folders and files that have no other name.

    A link could lead to what belongs to somebody else.

    Raises
    ------
    InputError
        If there is anything else.
    """
    if not stat.S_ISDIR(folder.lstat().st_mode):
        raise InputError(f"expected a folder of arrays, got something else at {folder.name}")
    for parent, folders, files in os.walk(folder, onerror=_unreadable):
        for name in (*folders, *files):
            status = (Path(parent) / name).lstat()
            plain = stat.S_ISREG(status.st_mode) and status.st_nlink == 1
            if not plain and not stat.S_ISDIR(status.st_mode):
                raise InputError(f"expected files and folders of arrays, got something else at {name[:80]!a}")


def _unreadable(error: OSError) -> None:
    raise InputError(f"expected folders that can be read: {error.strerror}") from error


if __name__ == "__main__":
    main()
