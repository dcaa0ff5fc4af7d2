"""Work in threads that is carried out to its end, whatever becomes of the task that waits for it."""

from __future__ import annotations

import asyncio
from collections.abc import Callable
from typing import TypeVar

__all__ = ["carried_out"]

T = TypeVar("T")


async def carried_out(change: Callable[[], T]) -> T:
    """Change files in a thread, to the end even if the task is cancelled, and return what the function returns.

    Otherwise a thread that has not begun would never run, and one that has would go on beside what comes next.
    """
    changing = asyncio.ensure_future(asyncio.to_thread(change))
    try:
        return await asyncio.shield(changing)
    except asyncio.CancelledError:
        await asyncio.gather(changing, return_exceptions=True)
        raise
