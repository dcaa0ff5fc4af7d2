"""Limits for connections that are cut when they exceed them, and the record of those that were."""

from __future__ import annotations

import logging
import time

from ..operation.logs import event
from ..operation.metrics import Metrics

__all__ = ["REASONS", "Allowance", "Cuts"]

_log = logging.getLogger(__name__)

#: Why a connection is cut; each is a ``kind`` of ``lodestream_errors_total``.
REASONS = ("bad-request", "control-data", "fragments", "frames", "refused-body", "slow-answer", "small-chunks")


class Allowance:
    """A token bucket: so many at once, so many more each second, and more that are earned.

    Parameters
    ----------
    most : float
        How many are allowed at once.
    rate : float
        How many more are allowed each second.
    """

    __slots__ = ("_left", "_most", "_rate", "_seen")

    def __init__(self, most: float, rate: float) -> None:
        self._most = most
        self._rate = rate
        self._left = most
        self._seen = time.monotonic()

    def take(self) -> bool:
        """Count one, and return whether it was allowed."""
        now = time.monotonic()
        self._left = min(self._most, self._left + (now - self._seen) * self._rate) - 1
        self._seen = now
        return self._left >= 0

    def earn(self, number: float) -> None:
        """Allow more, up to the initial number."""
        self._left = min(self._most, self._left + number)


class Cuts:
    """Records connections that were cut: counts them in the metrics and logs a line for each.

    Parameters
    ----------
    metrics : Metrics
    """

    def __init__(self, metrics: Metrics) -> None:
        self._metrics = metrics

    def note(self, reason: str, client: tuple[str, int] | None) -> None:
        """Record that a connection was cut.

        Parameters
        ----------
        reason : str
            One of `REASONS`.
        client : (host, port) or None
            Address of the client.
        """
        self._metrics.failed(reason)
        event(_log, f"connection cut: {reason}", logging.WARNING, client=client[0] if client else None)
