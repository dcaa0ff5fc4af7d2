"""Builds that a cluster carries out, where something goes wrong: what a parser left, what is cut, what is lacking."""

from __future__ import annotations

import asyncio
import contextlib
import errno
import io
import json
import logging
import os
import resource
import shutil
import sys
from collections.abc import Iterator
from concurrent.futures import CancelledError, Executor, Future
from functools import partial
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import httpx
import numpy as np
import pytest
from pydantic import TypeAdapter

import lodestream as ls
from lodestream.encoding import cluster as clusters
from lodestream.scratch import FolderScratch
from lodestream_server import running_server
from lodestream_server.builds import builder, cluster_build, worker
from lodestream_server.builds.answers import ProcessDiedError, UnforeseenError
from lodestream_server.builds.clusters import build_by_cluster
from tests.clusters import local_cluster
from tests.core.surfaces import terrain
from tests.patience import PATIENCE
from tests.server.builds import slow
from tests.server.helpers import eventually, kept, npy, push
from tests.server.programs import Server, alive, server

pytest.importorskip("distributed")

#: Of a build: half of it is too little for so many points with holes; for so few by `alone.preload_large`.
MEMORY, SIDE, SMALL_SIDE = 256 << 20, 1860, 620
BEYOND: dict[str, Any] = {"workers": 1, "build_memory": MEMORY, "formats": "npy"}


def large(side: int = SIDE) -> bytes:
    """A file that is built by bands within that memory."""
    heights = np.rint(terrain((side, side)) * 40).astype(np.float32)
    heights[3:9, 5:60] = np.nan
    return npy(heights)


@pytest.fixture
def job(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> worker.Job:
    """A small surface that is parsed, for others to build."""
    (tmp_path / "0").write_bytes(npy(terrain((300, 300)).astype(np.float32)))
    (tmp_path / "work").mkdir()
    made = worker.Job((tmp_path / "0",), "a.npy", None, "auto", {}, 1 << 20, tmp_path / "work", shared=True)
    monkeypatch.setattr(worker, "memory_limit", lambda: 2 << 20)
    assert worker.build(made) == worker.Parsed(300 * 300)
    return made


@pytest.fixture
def at_once(monkeypatch: pytest.MonkeyPatch) -> None:
    """Tasks are carried out here, and no scheduler is asked."""
    _replace_executor(monkeypatch, _AtOnce())


def _replace_executor(monkeypatch: pytest.MonkeyPatch, executor: Executor) -> None:
    @contextlib.contextmanager
    def executor_of(address: str) -> Iterator[Executor]:
        yield executor

    monkeypatch.setattr(clusters, "executor_of", executor_of)


class _AtOnce(Executor):
    def submit(self, function: Any, /, *args: Any, **named: Any) -> Future[Any]:
        future = Future[Any]()
        try:
            future.set_result(function(*args, **named))
        except Exception as error:
            future.set_exception(error)
        return future


class _Failing(Executor):
    def __init__(self, error: Exception) -> None:
        self._error = error

    def submit(self, function: Any, /, *args: Any, **named: Any) -> Future[Any]:
        future = Future[Any]()
        future.set_exception(self._error)
        return future


def task_of(job: worker.Job) -> cluster_build.ClusterJob:
    return cluster_build.ClusterJob(job, "tcp://127.0.0.1:1", 1 << 20)


# What a parser has left, which a file may have taken over.


@pytest.mark.parametrize("kind", ["link", "second name"])
@pytest.mark.parametrize("name", ["progress", "progress.new", "container", "scratch/made", "scratch/made.part"])
@pytest.mark.usefixtures("at_once")
def test_nothing_is_written_through_what_a_parser_has_left(
    name: str, kind: str, job: worker.Job, tmp_path: Path
) -> None:
    secret = tmp_path / "secret"
    secret.write_text("as it was")
    (job.folder / name).unlink(missing_ok=True)
    if kind == "link":
        (job.folder / name).symlink_to(secret)
    else:
        os.link(secret, job.folder / name)
    refused = cluster_build.build(task_of(job))
    assert isinstance(refused, worker.Refused)
    assert "expected files and folders of arrays, got something else at" in refused.reason
    assert secret.read_text() == "as it was"


@pytest.mark.parametrize("name", ["scratch", "scratch/read", "scratch/more"])
@pytest.mark.usefixtures("at_once")
def test_no_folder_of_others_is_read_or_emptied(name: str, job: worker.Job, tmp_path: Path) -> None:
    others = tmp_path / "others"
    if (job.folder / name).exists():
        shutil.move(job.folder / name, others)
    (others / "tasks").mkdir(parents=True, exist_ok=True)
    (others / "tasks" / "diary").touch()
    (job.folder / name).symlink_to(others, target_is_directory=True)
    assert isinstance(cluster_build.build(task_of(job)), worker.Refused)
    assert (others / "tasks" / "diary").exists()


@pytest.mark.usefixtures("at_once")
def test_only_the_parsed_arrays_are_kept_of_what_a_parser_has_left(job: worker.Job, tmp_path: Path) -> None:
    expected = ls.encode(ls.read(job.files[0], filename="a.npy"))
    for place in (job.folder, job.scratch, job.scratch / "tasks", job.scratch / "tasks" / "exact"):
        place.mkdir(exist_ok=True)
        for name in ("made", "made.part", "container", "build.json", "build.pickle", "progress.new"):
            (place / name).write_bytes(b"cos\nsystem\n(S'touch owned'\ntR.")
    built = cluster_build.build(task_of(job))
    assert isinstance(built, worker.Built), built
    assert job.container.read_bytes() == expected
    assert {path.name for path in job.folder.iterdir()} == {"scratch", "container", "progress"}


@pytest.mark.usefixtures("at_once")
def test_tasks_lie_where_no_parser_can_write(job: worker.Job, monkeypatch: pytest.MonkeyPatch) -> None:
    seen: list[tuple[Path, ...]] = []
    encode = ls.encode

    def noted(*args: Any, out: Path, **options: Any) -> Any:
        made = encode(*args, out=out, **options)
        seen.append((out.parent, *(path for path in (job.folder, *job.folder.parents) if path == out.parent)))
        return made

    monkeypatch.setattr("lodestream.encode", noted)
    assert isinstance(cluster_build.build(task_of(job)), worker.Built)
    # Neither in a folder that the parser may write to, nor above one, through which it could be another.
    assert seen == [(job.folder.with_name(f"{job.folder.name}.tasks"),)]
    assert not seen[0][0].exists()


@pytest.mark.usefixtures("at_once")
def test_what_is_unreadable_or_missing_or_too_large_is_refused(job: worker.Job, tmp_path: Path) -> None:
    def reason(changed: worker.Job) -> str:
        refused = cluster_build.build(task_of(changed))
        assert isinstance(refused, worker.Refused)
        return refused.reason

    smaller = worker.Job(job.files, None, None, "auto", {}, 1000, job.folder, shared=True)
    assert reason(smaller) == "expected at most 1,000 vertices, got 90,000"
    FolderScratch(job.parsed).clear()
    assert reason(job) == "expected a folder of arrays, got none at read"
    job.parsed.mkdir()
    assert reason(job) == "expected a parsed surface, got none"


def test_a_surface_that_is_only_parsed_is_no_answer_where_there_is_no_cluster(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(worker, "build", slow.parse_only)
    with (
        running_server(tmp_path, workers=1) as url,
        httpx.Client(base_url=url, trust_env=False, timeout=PATIENCE) as http,
    ):
        surface = push(http, npy(np.zeros((9, 9), np.float32)))
    assert surface["state"] == "waiting"
    assert "expected a container, got a surface that is only parsed" in surface["reason"]


# What is lacking.


@pytest.mark.parametrize(
    ("error", "reason"),
    [
        (RuntimeError("3 workers died"), "LODESTREAM_DASK: the cluster gave up: RuntimeError: 3 workers died"),
        (
            CancelledError(),
            "LODESTREAM_DASK: the cluster gave up: CancelledError: the scheduler has ended, or has dropped the tasks",
        ),
        (TimeoutError("no answer"), "LODESTREAM_DASK: the cluster gave up: TimeoutError: no answer"),
        (
            FileNotFoundError(errno.ENOENT, "No such file", "/data/work/x"),
            "LODESTREAM_DASK: its workers do not see the data folder at its path here",
        ),
    ],
)
def test_what_the_cluster_lacks_may_pass(
    error: Exception, reason: str, job: worker.Job, monkeypatch: pytest.MonkeyPatch
) -> None:
    _replace_executor(monkeypatch, _Failing(error))
    assert cluster_build.build(task_of(job)) == worker.Refused(reason, final=False)


def test_a_full_disk_is_no_fault_of_the_upload(job: worker.Job, monkeypatch: pytest.MonkeyPatch) -> None:
    _replace_executor(monkeypatch, _Failing(OSError(errno.ENOSPC, "of a worker")))
    with pytest.raises(OSError, match="of a worker"):
        cluster_build.build(task_of(job))
    monkeypatch.setattr(shutil, "disk_usage", lambda folder: SimpleNamespace(free=1000))
    for call in (partial(cluster_build.build, task_of(job)), partial(worker.build, _alone(job))):
        with pytest.raises(OSError, match=os.strerror(errno.ENOSPC)) as raised:
            call()
        assert raised.value.errno == errno.ENOSPC


def _alone(job: worker.Job) -> worker.Job:
    folder = job.folder.with_name("alone")
    folder.mkdir(exist_ok=True)
    return worker.Job(job.files, None, None, "auto", {}, job.max_vertices, folder)


@pytest.mark.usefixtures("at_once")
def test_a_cluster_builds_with_the_effort_that_is_asked_for(job: worker.Job) -> None:
    heights = terrain((300, 300)).astype(np.float32)
    job.options["effort"] = "small"
    assert isinstance(cluster_build.build(task_of(job)), worker.Built)
    made = job.container.read_bytes()
    assert made == ls.encode(ls.decode(made), effort="small") != ls.encode(ls.decode(made))
    assert np.array_equal(ls.decode(made).points, heights)


def test_an_option_that_does_not_fit_is_not_laid_on_the_cluster(
    job: worker.Job, monkeypatch: pytest.MonkeyPatch
) -> None:
    _replace_executor(monkeypatch, _AtOnce())
    job.options["precision=nothing"] = "1"
    refused = cluster_build.build(task_of(job))
    assert isinstance(refused, worker.Refused)
    assert refused.final
    assert "nothing" in refused.reason
    assert "LODESTREAM_DASK" not in refused.reason


@pytest.mark.parametrize(
    ("result", "state", "reason"),
    [
        (worker.Refused("LODESTREAM_DASK: no workers", final=False), "waiting", "LODESTREAM_DASK: no workers"),
        (TimeoutError(), "waiting", "the build took longer than 3600 s"),
        (MemoryError(), "waiting", "(LODESTREAM_MEMORY): 3 builds began and did not end"),
        (ProcessDiedError(-9), "waiting", "the process ended before it was done (exit code -9, SIGKILL): 3 builds"),
        (UnforeseenError("KeyError", None, "| secret"), "waiting", "the build failed with an internal error: KeyError"),
        (UnforeseenError("OSError", errno.ENOSPC, "| secret"), "queued", "waits for space on the server's disk"),
    ],
)
@pytest.mark.long
def test_how_a_build_by_a_cluster_ends_is_told_and_logged(
    result: Any,
    state: str,
    reason: str,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    caplog: pytest.LogCaptureFixture,
) -> None:
    async def by_cluster(task: cluster_build.ClusterJob, seconds: float, threads: int) -> Any:
        if isinstance(result, Exception):
            raise result
        return result

    monkeypatch.setattr(builder, "build_by_cluster", by_cluster)
    caplog.set_level(logging.INFO, builder.__name__)
    address = "tcp://127.0.0.1:8786"
    with (
        running_server(tmp_path, dask=address, **BEYOND) as url,
        httpx.Client(base_url=url, trust_env=False, timeout=PATIENCE) as http,
    ):
        location = http.post("/v1/surfaces?filename=a.npy", content=large()).raise_for_status().headers["location"]

        def ended() -> dict[str, Any] | None:
            surface: dict[str, Any] = http.get(location).json()
            return surface if surface["state"] == state and surface["reason"] else None

        surface = eventually(ended, f"it to be {state}, and a reason")
        assert reason in surface["reason"]
        assert "secret" not in str(surface)
    logged = [record.getMessage() for record in caplog.records]
    assert f"the build of {surface['id']} goes to the workers of the Dask scheduler {address}" in logged
    assert any(line.startswith(f"the build of {surface['id']} came back from Dask after ") for line in logged)


@pytest.mark.long
def test_a_server_starts_where_no_scheduler_is_and_says_so_of_what_it_cannot_build(tmp_path: Path) -> None:
    with (
        running_server(tmp_path, dask="tcp://127.0.0.1:1", **BEYOND) as url,
        httpx.Client(base_url=url, trust_env=False, timeout=PATIENCE) as http,
    ):
        assert push(http, npy(np.zeros((9, 9), np.float32)))["state"] == "ready"
        surface = push(http, large())
        assert surface["state"] == "waiting"
        assert surface["reason"].startswith(
            "LODESTREAM_DASK: expected the address of a Dask scheduler, got 'tcp://127.0.0.1:1': "
        )
        eventually(lambda: not kept(tmp_path, "scratch/work"), "the build's folder to be removed")


# What is cut.


@pytest.mark.long
def test_a_build_that_is_deleted_or_killed_leaves_nothing_and_a_server_that_was_killed_builds_again(
    tmp_path: Path,
) -> None:
    data = large(SMALL_SIDE)
    with local_cluster(0) as cluster:
        settings: dict[str, Any] = {**BEYOND, "preload": "preload_large", "dask": cluster.scheduler_address}
        clients = cluster.scheduler.clients  # those of the processes that hand out tasks, and one of its own

        def handing_out() -> bool:
            return any(state.wants_what for state in clients.values())

        first = Server(tmp_path / "data", **settings)
        with (
            contextlib.closing(SimpleNamespace(close=first.kill)),
            httpx.Client(base_url=first.url, trust_env=False, timeout=PATIENCE) as http,
        ):
            deleted = http.post("/v1/surfaces?filename=a.npy", content=data).headers["location"]
            eventually(handing_out, "a build at the cluster")
            assert http.get(deleted).json()["state"] == "building"
            http.delete(deleted).raise_for_status()
            assert kept(tmp_path / "data", "scratch/work") == []
            eventually(lambda: not handing_out(), "the scheduler to drop its tasks")
            again = http.post("/v1/surfaces?filename=b.npy", content=data).headers["location"]
            eventually(handing_out, "another build at the cluster")
        eventually(lambda: not handing_out(), "the process that hands out tasks to end with its server")
        assert any((tmp_path / "data" / "uploads").iterdir())
        cluster.scale(2)
        with (
            server(tmp_path / "data", **settings) as second,
            httpx.Client(base_url=second.url, trust_env=False, timeout=PATIENCE) as http,
        ):
            eventually(lambda: http.get(again).json()["state"] == "ready", "the build to be done again")
            container = http.get(f"{again}/container", follow_redirects=True).content
            eventually(lambda: not kept(tmp_path / "data", "scratch/work"), "the build's folder to be removed")
    assert np.array_equal(ls.decode(container).points, np.load(io.BytesIO(data)), equal_nan=True)


def test_a_build_that_takes_too_long_is_ended(job: worker.Job, monkeypatch: pytest.MonkeyPatch) -> None:
    started: list[int] = []
    start = asyncio.create_subprocess_exec

    async def starting(*args: Any, **options: Any) -> asyncio.subprocess.Process:
        process = await start(*args, **options)
        started.append(process.pid)
        return process

    monkeypatch.setattr(asyncio, "create_subprocess_exec", starting)
    with local_cluster(0) as cluster, pytest.raises(TimeoutError):
        asyncio.run(build_by_cluster(cluster_build.ClusterJob(job, cluster.scheduler_address, 1 << 20), 3.0, 1))
    (process,) = started
    assert not alive(process)


def test_the_process_that_hands_out_tasks_has_limited_memory(job: worker.Job, monkeypatch: pytest.MonkeyPatch) -> None:
    limits: list[tuple[int, tuple[int, int]]] = []
    told = io.BytesIO()
    monkeypatch.setattr(resource, "setrlimit", lambda kind, most: limits.append((kind, most)))
    monkeypatch.setattr(cluster_build, "_end_with_parent", lambda: None)
    monkeypatch.setattr(cluster_build, "build", lambda task: worker.Refused(task.address))
    line = TypeAdapter(cluster_build.ClusterJob).dump_json(task_of(job))
    monkeypatch.setattr(sys, "stdin", SimpleNamespace(buffer=io.BytesIO(line + b"\n")))
    monkeypatch.setattr(sys, "stdout", SimpleNamespace(buffer=told))
    cluster_build.main()
    assert json.loads(told.getvalue()) == {"returned": {"reason": "tcp://127.0.0.1:1", "final": True, "choices": []}}
    most = (2 << 20) + cluster_build._BESIDE
    assert limits == [(resource.RLIMIT_DATA, (most, most))]


def test_tasks_that_find_no_worker_for_as_long_as_dask_is_told_end_the_build(job: worker.Job) -> None:
    dask = pytest.importorskip("dask")
    with dask.config.set({"distributed.scheduler.no-workers-timeout": "1s"}), local_cluster(0) as cluster:
        task = cluster_build.ClusterJob(job, cluster.scheduler_address, 1 << 20)
        refused = asyncio.run(build_by_cluster(task, 600.0, 1))
    assert isinstance(refused, worker.Refused)
    assert refused.reason.startswith("LODESTREAM_DASK: the cluster gave up: NoWorkerError: ")
    assert not refused.final
