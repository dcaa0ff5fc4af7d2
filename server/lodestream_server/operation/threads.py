"""Work in threads that is carried out to its end, whatever becomes of the task that waits for it."""

from __future__ import annotations

import asyncio
from collections.abc import Callable
from contextlib import AbstractContextManager, ExitStack
from typing import TypeVar

__all__ = ["carried_out", "entered"]

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


async def entered(context: AbstractContextManager[T], held: ExitStack) -> T:
    """Enter a context in a thread, leave it to a stack, and return what it gives; after a cancellation it is left."""
    with ExitStack() as stack:
        given = await carried_out(lambda: stack.enter_context(context))
        held.push(stack.pop_all())
        return given
