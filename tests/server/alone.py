"""``python -m tests.server.alone SETTINGS`` is a server that `programs` starts: it imports nothing that tests need.

It prints its address, then answers each line of its standard input with a line that says what is in it.
"""

from __future__ import annotations

import asyncio
import contextlib
import gc
import json
import sys
import threading
from pathlib import Path
from typing import Any
from unittest.mock import patch


def _within() -> dict[str, Any]:
    gc.collect()
    tasks, sockets, files = 0, 0, []
    for loop in [item for item in gc.get_objects() if isinstance(item, asyncio.AbstractEventLoop)]:
        if loop.is_running():
            tasks += len(asyncio.all_tasks(loop))
    for link in Path("/proc/self/fd").iterdir():
        with contextlib.suppress(OSError):
            target = str(link.readlink())
            sockets += target.startswith("socket:")
            if any(f"/{name}/" in target for name in ("containers", "incoming", "uploads", "work", "records")):
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
    with patch.object(worker, "preload", alone.preload):  # by the name that another process finds it by
        serve_alone(settings, lambda address: print(address, flush=True))


if __name__ == "__main__":
    main()
