"""Builds by the workers of a Dask cluster: starts and ends the process that hands out the tasks of each build."""

from __future__ import annotations

import asyncio
import logging
import os
import sys
from contextlib import suppress

from pydantic import TypeAdapter

from .answers import ProcessDiedError, result_of
from .cluster_build import ClusterJob, build
from .processes import ONE_THREAD
from .worker import Built, Refused

__all__ = ["build_by_cluster"]

_log = logging.getLogger(__name__)

_LAST_WORDS = 2000


async def build_by_cluster(task: ClusterJob, seconds: float, threads: int) -> Built | Refused:
    """Build a parsed surface with a Dask cluster.

    Cancelling it kills the process that hands out tasks; those that workers are at work on find their folder gone.

    Parameters
    ----------
    task : ClusterJob
    seconds : float
        What it may take, by the clock.
    threads : int
        Of the kernels in the process that hands out tasks.

    Raises
    ------
    ProcessDiedError
        If that process ends before it is done, or gives an invalid answer (`WrongAnswerError`).
    TimeoutError
        If it takes longer.
    MemoryError
        If it, or a worker, runs out of memory.
    UnforeseenError
        If anything else fails in it.
    OSError
        If it cannot be started.
    """
    path = os.pathsep.join(filter(None, sys.path))
    process = await asyncio.create_subprocess_exec(
        sys.executable,
        "-P",  # what lies in the working directory is nobody's program
        "-m",
        "lodestream_server.builds.cluster_build",
        stdin=asyncio.subprocess.PIPE,
        stdout=asyncio.subprocess.PIPE,
        stderr=asyncio.subprocess.PIPE,
        env={**os.environ, **ONE_THREAD, "LODESTREAM_THREADS": str(threads), "PYTHONPATH": path},
        start_new_session=True,
    )
    assert process.stdin is not None  # they are pipes
    assert process.stdout is not None
    assert process.stderr is not None
    try:
        # Its standard input stays open: it ends when this does.
        process.stdin.write(TypeAdapter(ClusterJob).dump_json(task) + b"\n")
        async with asyncio.timeout(seconds):
            answer, errors = await asyncio.gather(process.stdout.read(), _last_words(process.stderr))
            code = await process.wait()
    finally:
        with suppress(ProcessLookupError):
            process.kill()
        await process.wait()
    if code:
        _log.error("a build by a cluster ended early: %s", errors.decode(errors="replace"))
        raise ProcessDiedError(code)
    result: Built | Refused = result_of(build, answer)
    return result


async def _last_words(stream: asyncio.StreamReader) -> bytes:
    """Return the end of a stream: Dask logs much in hours."""
    words = b""
    while piece := await stream.read(1 << 12):
        words = (words + piece)[-_LAST_WORDS:]
    return words
