"""Builds by the workers of a Dask cluster, one of which dies."""

from __future__ import annotations

import os
import signal
from collections.abc import Iterator
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import lodestream as ls
from lodestream.encoding import folder_build, tasks
from lodestream.encoding.cluster import executor_of
from tests.clusters import local_cluster

from ..surfaces import terrain

distributed = pytest.importorskip("distributed")


@pytest.fixture(scope="module")
def cluster() -> Iterator[Any]:
    """Two workers for all builds here; one that dies is replaced."""
    with local_cluster(2) as workers, distributed.Client(workers, set_as_default=False) as client:
        yield client


def _surface(kind: str) -> ls.Surface:
    heights = np.rint(300 * terrain((700, 200))).astype(np.int16)
    if kind == "holes":
        return ls.Surface(heights, mask=np.hypot(np.arange(-350, 350)[:, None] / 350, np.arange(-100, 100) / 100) < 0.9)
    columns, rows = np.meshgrid(np.arange(200.0), np.arange(700.0))
    points = np.stack([columns + np.sin(rows / 50), rows, heights / 100], axis=-1).astype(np.float32)
    return ls.Surface(blocks=[ls.Block(points[a : a + 141]) for a in range(0, 561, 140)])


def _die_in(name: str, dask_worker: Any) -> None:
    """On a worker: die in the first task of this name, when its files are written and nobody knows it."""
    setattr(tasks, name, partial(_dying, getattr(tasks, name)))


def _dying(task: Any, *arguments: Any) -> None:
    task(*arguments)
    os.kill(os.getpid(), signal.SIGKILL)


@pytest.mark.parametrize(("task", "kind"), [("second_step", "holes"), ("measure", "blocks")])
@pytest.mark.long
def test_a_worker_that_dies_costs_its_task(
    cluster: Any, task: str, kind: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    surface = _surface(kind)
    monkeypatch.setattr(folder_build, "_FEWEST", 1)  # so that pieces are small
    before = cluster.run(os.getpid)
    chosen = next(iter(before))
    cluster.run(_die_in, task, workers=[chosen])
    with cluster.get_executor(pure=False, retries=3) as executor:
        ls.encode(surface, out=tmp_path / "a.lode", executor=executor, memory=1 << 20)
    assert before[chosen] not in cluster.run(os.getpid).values(), "it died"
    assert (tmp_path / "a.lode").read_bytes() == ls.encode(surface)
    assert [path.name for path in tmp_path.iterdir()] == ["a.lode"]


def test_a_small_surface_is_built_by_more_workers_than_it_has_pieces(cluster: Any) -> None:
    surface = ls.Surface(np.rint(300 * terrain((90, 80))).astype(np.int16))
    with cluster.get_executor(pure=False) as executor:
        assert ls.encode(surface, executor=executor) == ls.encode(surface)


def _kill_self() -> None:
    os.kill(os.getpid(), signal.SIGKILL)


def _hand_out_death(address: str) -> None:
    with executor_of(address) as executor:
        assert executor is not None
        executor.submit(_kill_self).result()


@pytest.mark.long
def test_a_cluster_whose_workers_all_die_says_so(cluster: Any) -> None:
    with pytest.raises(ls.UnavailableError, match="expected a Dask cluster that lasts, lost it at"):
        _hand_out_death(cluster.scheduler.address)
