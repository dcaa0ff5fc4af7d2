"""One request of an asynchronous client."""

from __future__ import annotations

from collections.abc import Awaitable, Callable
from typing import TypeVar

from lodestream_client import AsyncClient

__all__ = ["asked"]

T = TypeVar("T")


async def asked(url: str, ask: Callable[[AsyncClient], Awaitable[T]], token: str | None = None) -> T:
    """What a client of the server at a URL is told."""
    async with AsyncClient(url, token=token) as client:
        return await ask(client)
