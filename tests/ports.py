"""Ports of this machine for programs that do not choose one themselves."""

from __future__ import annotations

import socket
import sys
from collections.abc import Iterator
from contextlib import contextmanager

__all__ = ["reserved_port"]


@contextmanager
def reserved_port() -> Iterator[int]:
    """Return a port on 127.0.0.1 on which a program may listen in the block; on Linux nobody else is given it there.

    Linux lets a program listen where another socket is bound that does not listen, if both reuse addresses, as servers
    do. It gives such a port to nobody who asks for any port, nor to a connection.
    """
    with socket.socket() as reserved:
        reserved.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        reserved.bind(("127.0.0.1", 0))
        port = int(reserved.getsockname()[1])
        if sys.platform != "linux":
            reserved.close()
        yield port
