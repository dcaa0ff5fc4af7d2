"""The record of connections that were cut."""

from __future__ import annotations

import logging

from ..operation.logs import event
from ..operation.metrics import Metrics

__all__ = ["REASONS", "Cuts"]

_log = logging.getLogger(__name__)

#: Why a connection is cut; each is a ``kind`` of ``lodestream_errors_total``.
REASONS = ("bad-request", "frames", "refused-body", "slow-answer")


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
