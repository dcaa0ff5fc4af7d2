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
from lodestream.bands import tasks
from lodestream.bands.cluster import executor_of
from tests.clusters import local_cluster

from ..surfaces import terrain

distributed = pytest.importorskip("distributed")


@pytest.fixture
def cluster(request: pytest.FixtureRequest) -> Iterator[Any]:
    with (
        local_cluster(request.param) as made,
        distributed.Client(made, set_as_default=False) as client,
    ):
        yield client


def _surface(kind: str) -> ls.Surface:
    heights = np.rint(300 * terrain((700, 640))).astype(np.int16)
    if kind == "holes":
        return ls.Surface(heights, mask=np.hypot(*np.mgrid[-350:350, -320:320]) < 330)
    if kind == "closed columns":
        return ls.Surface(heights, (False, True))
    if kind == "blocks":
        columns, rows = np.meshgrid(np.arange(640.0), np.arange(700.0))
        points = np.stack([columns + np.sin(rows / 50), rows, heights / 100], axis=-1).astype(np.float32)
        return ls.Surface(blocks=[ls.Block(points[a : a + 141]) for a in range(0, 561, 140)])
    return ls.Surface(heights)


def _die_in(name: str, dask_worker: Any) -> None:
    """On a worker: die in the first task of this name, when its files are written and nobody knows it."""
    setattr(tasks, name, partial(_dying, getattr(tasks, name)))


def _dying(task: Any, *arguments: Any) -> None:
    task(*arguments)
    os.kill(os.getpid(), signal.SIGKILL)


@pytest.mark.parametrize("cluster", [2, 3], indirect=True)
@pytest.mark.parametrize("kind", ["holes", "closed columns", "blocks"])
def test_a_cluster_builds_the_same_bytes(cluster: Any, kind: str, tmp_path: Path) -> None:
    surface = _surface(kind)
    with cluster.get_executor(pure=False, retries=3) as executor:
        ls.encode(surface, out=tmp_path / "a.lode", executor=executor, memory=1 << 20)
    assert (tmp_path / "a.lode").read_bytes() == ls.encode(surface)
    assert [path.name for path in tmp_path.iterdir()] == ["a.lode"]


@pytest.mark.parametrize("cluster", [2], indirect=True)
@pytest.mark.parametrize(
    ("task", "kind"),
    [
        ("second_step", "heights"),
        ("second_step", "holes"),
        ("coordinates", "closed columns"),
        ("code", "holes"),
        ("measure", "closed columns"),
        ("second_step", "blocks"),
        ("measure", "blocks"),
    ],
)
def test_a_worker_that_dies_costs_its_task(cluster: Any, task: str, kind: str, tmp_path: Path) -> None:
    surface = _surface(kind)
    before = cluster.run(os.getpid)
    chosen = next(iter(before))
    cluster.run(_die_in, task, workers=[chosen])
    with cluster.get_executor(pure=False, retries=3) as executor:
        ls.encode(surface, out=tmp_path / "a.lode", executor=executor, memory=1 << 20)
    assert before[chosen] not in cluster.run(os.getpid).values(), "it died"
    assert (tmp_path / "a.lode").read_bytes() == ls.encode(surface)
    assert [path.name for path in tmp_path.iterdir()] == ["a.lode"]


@pytest.mark.parametrize("cluster", [3], indirect=True)
def test_three_workers_build_a_small_surface(cluster: Any) -> None:
    surface = ls.Surface(np.rint(300 * terrain((90, 80))).astype(np.int16))
    with cluster.get_executor(pure=False) as executor:
        assert ls.encode(surface, executor=executor) == ls.encode(surface)


def _kill_self() -> None:
    os.kill(os.getpid(), signal.SIGKILL)


def _hand_out_death(address: str) -> None:
    with executor_of(address) as executor:
        assert executor is not None
        executor.submit(_kill_self).result()


@pytest.mark.parametrize("cluster", [2], indirect=True)
def test_a_cluster_whose_workers_all_die_says_so(cluster: Any) -> None:
    with pytest.raises(ls.UnavailableError, match="expected a Dask cluster that lasts, lost it at"):
        _hand_out_death(cluster.scheduler.address)
