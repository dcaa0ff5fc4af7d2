"""What processes that are kept do in tests: they count, hang, die, lie, and try what they may not."""

from __future__ import annotations

import os
import signal
import socket
import sys
import time
from collections.abc import Callable
from typing import Any, NoReturn

__all__ = ["answers", "service"]


def answers(*_: Any) -> Any:
    """Stand for the function that answers; any JSON is an answer."""


def service(start: int = 0) -> Callable[..., Any]:
    """Return what does as it is told, and counts the questions."""
    count = start

    def answer(what: str, descriptor: int) -> Any:
        nonlocal count
        count += 1
        return _DEEDS[what](count, descriptor)

    return answer


def _socket() -> int:
    """The process's end of its connection: of what is open, the first that is a socket."""
    for number in map(int, os.listdir("/proc/self/fd")):
        try:
            if os.readlink(f"/proc/self/fd/{number}").startswith("socket:"):
                return number
        except OSError:
            continue
    raise AssertionError("it has one")


def _say(text: bytes) -> NoReturn:
    os.write(_socket(), text)
    time.sleep(3600)
    raise AssertionError("it was killed")


def _wait(count: int, descriptor: int) -> int:
    while os.pread(descriptor, 100, 0) != b"go":
        time.sleep(0.01)
    return count


def _hoard(count: int, _: int) -> int:
    return len(bytearray(4 << 30))


def _open(count: int, _: int) -> str:
    try:
        with open("/etc/passwd") as file:
            return file.read()
    except OSError as error:
        return type(error).__name__


def _connect(count: int, _: int) -> str:
    try:
        socket.socket()
    except OSError as error:
        return type(error).__name__
    return "connected"


def _held(count: int, descriptor: int) -> list[str]:
    """What is open, but for the file of the question, and the list itself."""
    kinds = []
    for number in map(int, os.listdir("/proc/self/fd")):
        try:
            link = os.readlink(f"/proc/self/fd/{number}")
        except OSError:
            continue
        if number != descriptor and link != os.devnull:
            kinds.append(link.partition(":")[0])
    return kinds


_DEEDS: dict[str, Callable[[int, int], Any]] = {
    "count": lambda count, _: [os.getpid(), count],
    "read": lambda _, descriptor: os.pread(descriptor, 100, 0).decode(),
    "sleep": lambda *_: time.sleep(3600),
    "wait": _wait,
    "die": lambda *_: os.kill(os.getpid(), signal.SIGKILL),
    "die once": lambda count, _: count if count > 1 else os._exit(3),
    "raise": lambda *_: 1 / 0,
    "exit": lambda *_: sys.exit(0),
    "hoard": _hoard,
    "hoard beside others": lambda count, _: count if count == 1 else _hoard(count, _),
    "much": lambda *_: "x" * (1 << 20),
    "open": _open,
    "connect": _connect,
    "held": _held,
    "say a length": lambda *_: _say((1 << 31).to_bytes(4, "little")),
    "say half": lambda *_: _say((100).to_bytes(4, "little") + b"{"),
    "say no JSON": lambda *_: _say((4).to_bytes(4, "little") + b"oops"),
    "say two": lambda *_: _say((4).to_bytes(4, "little") + b"nullnull"),
}
