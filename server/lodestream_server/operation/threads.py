"""Work in threads: what a bucket is asked has threads of its own; what changes files is carried out to its end."""

from __future__ import annotations

import asyncio
from collections.abc import Callable
from contextlib import AbstractContextManager, ExitStack
from contextvars import copy_context
from functools import partial
from typing import ParamSpec, TypeVar

from lodestream.stores.threads import Threads

__all__ = ["carried_out", "entered", "in_store", "in_thread"]

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


async def in_thread(is_here: bool, call: Callable[P, T], *args: P.args, **options: P.kwargs) -> T:
    """Call what reads a file of this machine in a thread of `asyncio`, and what reads the store by `in_store`."""
    return await (asyncio.to_thread(call, *args, **options) if is_here else in_store(call, *args, **options))


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


async def entered(context: AbstractContextManager[T], held: ExitStack, *, is_here: bool = False) -> T:
    """Enter a context in a thread, see `in_thread`; leave it to a stack, and return what it gives.

    Whoever is cancelled does not wait for the thread, whose store may not answer: then that leaves it once it is in.
    """
    stack, is_given_up = ExitStack(), False

    def enter() -> T:
        given = stack.enter_context(context)
        if is_given_up:
            stack.close()
        return given

    try:
        given = await in_thread(is_here, enter)
    except BaseException:
        # In this order, so that one of the two leaves what the thread enters at this moment.
        is_given_up = True
        stack.close()
        raise
    held.push(stack.pop_all())
    return given
