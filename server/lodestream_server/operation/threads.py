"""Work in threads: what a bucket is asked has threads of its own; what changes files is carried out to its end."""

from __future__ import annotations

import asyncio
from collections.abc import Callable, Coroutine
from contextlib import AbstractContextManager, ExitStack
from contextvars import copy_context
from functools import partial
from typing import Any, ParamSpec, TypeVar

from lodestream.stores.threads import Threads

__all__ = ["carried_out", "entered", "in_store"]

P = ParamSpec("P")
T = TypeVar("T")

#: While a bucket does not answer, all of them may wait for it; those of `asyncio` serve the index and the disk.
_STORE = Threads(32)


async def in_store(call: Callable[P, T], *args: P.args, **options: P.kwargs) -> T:
    """Call what reads or changes the store, in a thread that the end of the program does not wait for.

    Whatever waits for such a call, as for the lock of all changes, is called so too.
    """
    work: Callable[[], T] = partial(copy_context().run, call, *args, **options)
    return await asyncio.wrap_future(_STORE.submit(work))


async def carried_out(change: Callable[[], T]) -> T:
    """Change files in a thread, to the end even if the task is cancelled, and return what the function returns.

    Otherwise a thread that has not begun would never run, and one that has would go on beside what comes next.
    """
    return await _to_its_end(asyncio.to_thread(change))


async def _to_its_end(work: Coroutine[Any, Any, T]) -> T:
    changing = asyncio.ensure_future(work)
    try:
        return await asyncio.shield(changing)
    except asyncio.CancelledError:
        await asyncio.gather(changing, return_exceptions=True)
        raise


async def entered(context: AbstractContextManager[T], held: ExitStack) -> T:
    """Enter a context of the store in a thread, leave it to a stack, return what it gives; if cancelled, leave it."""
    with ExitStack() as stack:
        given = await _to_its_end(in_store(stack.enter_context, context))
        held.push(stack.pop_all())
        return given
