"""Clusters of Dask for tests: on this machine, beside any others of it."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import pytest

__all__ = ["local_cluster"]

#: Seconds until processes of a machine that has much else to do have started, and answer.
_PATIENCE = "180s"

_TIMES = ("distributed.comm.timeouts.connect", "distributed.comm.timeouts.tcp")


@contextmanager
def local_cluster(workers: int) -> Iterator[Any]:
    """A `LocalCluster` of so many processes of one thread each, on free ports; skips the test without Dask."""
    distributed = pytest.importorskip("distributed")
    dask = pytest.importorskip("dask")
    with (
        dask.config.set(dict.fromkeys(_TIMES, _PATIENCE)),
        distributed.LocalCluster(
            n_workers=workers,
            threads_per_worker=1,
            # None would still take port 8787 for its HTTP server, and warn where another scheduler has it.
            dashboard_address="127.0.0.1:0",
            scheduler_kwargs={"dashboard": False},
            silence_logs=50,
        ) as cluster,
    ):
        yield cluster
