"""``python -m tests.server.alone SETTINGS PRELOAD`` is a server that `programs` starts: it imports little of the tests.

It prints its address, then answers each line of its standard input with a line that says what is in it.
"""

from __future__ import annotations

import asyncio
import contextlib
import gc
import json
import sys
import threading
import time
from pathlib import Path
from typing import Any
from unittest.mock import patch

#: How many times what a value takes is counted, where small surfaces are to be large.
_TIMES = 10
#: Seconds that a build waits for somebody who ends it: longer than any test waits.
_PATIENCE = 3600.0


def _within() -> dict[str, Any]:
    gc.collect()
    tasks, sockets, files = 0, 0, []
    # Not by `isinstance`, which asks weak proxies.
    for loop in [item for item in gc.get_objects() if issubclass(type(item), asyncio.AbstractEventLoop)]:
        if loop.is_running():
            tasks += len(asyncio.all_tasks(loop))
    for link in Path("/proc/self/fd").iterdir():
        with contextlib.suppress(OSError):
            target = str(link.readlink())
            sockets += target.startswith("socket:")
            if any(
                f"/{name}/" in target for name in ("containers", "incoming", "partial", "uploads", "work", "records")
            ):
                files.append(target)
    return {"tasks": tasks, "sockets": sockets, "files": files}


def _answer() -> None:
    for _ in sys.stdin:
        print(json.dumps(_within()), flush=True)


def preload() -> None:
    """Import what builds and levels need, but for what reads NetCDF: that takes longest, and few tests need it."""
    from lodestream_server.builds import worker

    with patch.object(worker, "_NETCDF", ()):
        worker.preload()


def preload_large() -> None:
    """The same; then builds count what a value takes ten times: small surfaces do not fit into memory in one piece."""
    from lodestream.encoding import folder_build, memory
    from lodestream_server.builds import worker

    preload()
    memory._WHOLE_WITH_HOLES *= _TIMES
    vars(folder_build)["OF_BAND"] *= _TIMES
    folder_build._FEWEST //= _TIMES
    worker._PART *= _TIMES


def preload_waiting() -> None:
    """The same; then builds by pieces wait once they have measured one: whoever ends them does so in the middle."""
    from lodestream.encoding import tasks
    from lodestream.encoding.build import Build

    preload_large()
    measure = tasks.measure

    def measure_first(build: Build, number: int, turn: int) -> None:
        if number:
            time.sleep(_PATIENCE)
        measure(build, number, turn)

    tasks.measure = measure_first


def preload_continuing() -> None:
    """The same; then builds by pieces fail if they do again what was done when those of `preload_waiting` wait."""
    from lodestream.encoding import tasks
    from lodestream.encoding.build import Build

    preload_large()
    measure = tasks.measure

    def measure_others(build: Build, number: int, turn: int) -> None:
        if not number and not turn:
            raise AssertionError("expected that the first piece is measured")
        measure(build, number, turn)

    tasks.measure = measure_others
    for name in ("first_step", "second_step", "core", "code"):
        vars(tasks)[name] = None


def main() -> None:
    """Serve until told to end."""
    gc.disable()  # what is imported stays: to look through it again and again frees nothing
    from lodestream_server import Settings
    from lodestream_server.builds import worker
    from lodestream_server.operation.logs import configure
    from lodestream_server.running import serve_alone
    from tests.server import alone

    gc.enable()
    settings = Settings(**json.loads(sys.argv[1]))
    configure(settings.log_format, settings.log_level)
    # Its own standard input: a process that it spawns must not read from it.
    threading.Thread(target=_answer, daemon=True).start()
    with patch.object(worker, "preload", getattr(alone, sys.argv[2])):  # by the name that another process finds it by
        serve_alone(settings, lambda address: print(address, flush=True))


if __name__ == "__main__":
    main()
