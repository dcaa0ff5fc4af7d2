"""The options of a stream."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import TypeAlias, TypedDict

from lodestream.errors import OptionError
from lodestream.target import Target, check_target, target_keyword
from lodestream.transfer.receiver_state import Sink, Store

from .reconnecting import Transport

__all__ = ["ConnectKeywords", "ConnectOptions", "Received"]

#: Called as ``progress(received, planned)`` with bytes of the surface, whenever some have come; ``planned`` is None
#: until it is known.
Received: TypeAlias = Callable[[int, "int | None"], None]


@dataclass(frozen=True, kw_only=True)
class ConnectOptions:
    """The options of `Client.connect`, where they are described, with their defaults; and the token."""

    target: Target | None = None
    transport: Transport = "auto"
    silence: float = 30.0
    deadline: float = 60.0
    close_timeout: float = 5.0
    limit_rate: float | None = None
    window: int | None = None
    store: Store | None = None
    container: str | None = None
    size: int | None = None
    progress: Received | None = None
    sink: Sink | None = None
    max_vertices: int | None = None
    token: str | None = None

    def __post_init__(self) -> None:
        if self.target is not None:
            check_target(self.target)

    @classmethod
    def of(cls, keywords: ConnectKeywords, token: str | None) -> ConnectOptions:
        """Return the options that a caller has given, and the token.

        Raises
        ------
        OptionError
            If there is no such option, or the target is none; what is a limit of a target is told.
        """
        for name, value in keywords.items():
            if name in ConnectKeywords.__annotations__:
                continue
            keyword = target_keyword(name)
            if keyword is not None:
                shown = value if isinstance(value, int | float) else repr(value)[:80]
                raise OptionError(f"expected target=lodestream.Target({keyword}={shown}), got {name}=")
            raise OptionError(f"expected {', '.join(ConnectKeywords.__annotations__)}, got {name[:80]!a}")
        return cls(token=token, **keywords)


class ConnectKeywords(TypedDict, total=False):
    """The options of `Client.connect` as keywords, for type checkers."""

    target: Target | None
    transport: Transport
    silence: float
    deadline: float
    close_timeout: float
    limit_rate: float | None
    window: int | None
    store: Store | None
    container: str | None
    size: int | None
    progress: Received | None
    sink: Sink | None
    max_vertices: int | None
