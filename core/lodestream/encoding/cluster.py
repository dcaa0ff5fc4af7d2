"""The workers of a Dask cluster as an executor of a build's tasks."""

from __future__ import annotations

import queue
import re
import threading
from collections.abc import Iterator
from concurrent.futures import CancelledError, Executor
from contextlib import contextmanager
from importlib.util import find_spec
from typing import Any

from ..errors import OptionError, UnavailableError

__all__ = ["checked_address", "executor_of", "is_loss", "require_dask"]

#: How often a task whose worker died is begun again, and seconds until a scheduler must have answered.
_RETRIES, _PATIENCE = 3, 5
_ADDRESS = re.compile(r"(?:(?:tcp|tls|ucx|ws|wss)://)?(?:[^\s/:\[\]]+|\[[0-9a-fA-F:.]+\]):([0-9]{1,5})")


def checked_address(address: str) -> str:
    """Return the address of a Dask scheduler, such as ``tcp://10.0.0.1:8786``, unchanged if it is valid.

    Dask itself refuses a wrong address only after a long wait.

    Raises
    ------
    OptionError
        If it is something else.
    """
    match = _ADDRESS.fullmatch(address)
    if match is None or not 0 < int(match[1]) < 1 << 16:
        raise OptionError(f"expected the address of a Dask scheduler such as tcp://10.0.0.1:8786, got {address[:80]!r}")
    return address


def require_dask() -> None:
    """Refuse to go on without Dask's clusters, and import nothing yet.

    Raises
    ------
    UnavailableError
        If they are not installed.
    """
    if find_spec("distributed") is None:
        raise UnavailableError("expected Dask, which is not installed: pip install 'lodestream[distributed]'")


@contextmanager
def executor_of(address: str | None) -> Iterator[Executor | None]:
    """Connect to a Dask scheduler, and yield an executor on its workers; None where there is no address.

    Parameters
    ----------
    address : str or None
        Such as ``tcp://10.0.0.1:8786``.

    Raises
    ------
    UnavailableError
        If Dask is not installed, or if in the block the scheduler or too many workers were lost.
    OptionError
        If this is no address, or no scheduler answers there.
    """
    if address is None:
        yield None
        return
    checked_address(address)
    require_dask()
    client = _connected(address)
    try:
        with client, client.get_executor(pure=False, retries=_RETRIES) as executor:
            yield executor
    except Exception as error:
        if is_loss(error):
            reason = str(error) or type(error).__name__
            raise UnavailableError(f"expected a Dask cluster that lasts, lost it at {address!r}: {reason}") from error
        raise


def is_loss(error: BaseException) -> bool:
    """Return whether an error means that the scheduler, or too many of its workers, were lost."""
    return isinstance(error, CancelledError) or type(error).__module__.partition(".")[0] == "distributed"


def _connected(address: str) -> Any:
    """Return a `distributed.Client` of a scheduler; Dask's classes have no types."""
    import distributed

    client_of: Any = distributed.Client
    outcomes: queue.SimpleQueue[Any] = queue.SimpleQueue()

    def connect() -> None:
        try:
            outcomes.put(client_of(address, timeout=_PATIENCE, set_as_default=False))
        except Exception as error:  # whatever another program at that port makes of it, MemoryError among others
            outcomes.put(error)

    # Dask waits for ever for a program at that port that says nothing.
    threading.Thread(target=connect, daemon=True).start()
    try:
        client = outcomes.get(timeout=_PATIENCE + 2)
    except queue.Empty:
        client = TimeoutError(f"no answer after {_PATIENCE + 2} s")
    if isinstance(client, Exception):
        reason = str(client) or type(client).__name__
        raise OptionError(f"expected the address of a Dask scheduler, got {address!r}: {reason}")
    return client
