"""Surfaces that do not fit into the memory of a build: by bands in its own process, or by the workers of a cluster."""

from __future__ import annotations

import io
import os
import re
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import lodestream as ls
from lodestream.encoding import cluster as clusters
from lodestream.formats import write_stream
from lodestream_client.__main__ import main
from lodestream_server import create_app
from lodestream_server.builds import cluster_build, worker
from lodestream_server.operation.settings import Settings
from tests.clusters import local_cluster
from tests.core.encoding.block_surfaces import block_surface
from tests.core.surfaces import terrain
from tests.server.helpers import push
from tests.server.programs import server

pytest.importorskip("distributed")

#: Of a build: nothing fits into half of it in one piece that has so many points with holes, by `alone.preload_large`.
MEMORY, SIDE = 256 << 20, 620


@pytest.fixture(scope="module")
def cluster() -> Iterator[Any]:
    with local_cluster(2) as made:
        yield made


def _npy(side: int) -> bytes:
    heights = (100 * terrain((side, side))).astype(np.float32).round(1)
    heights[3:9, 5:60] = np.nan
    out = io.BytesIO()
    np.save(out, heights)
    return out.getvalue()


def _blocks() -> ls.Surface:
    return block_surface("plates", (300, 280), 3, "float32", "", np.random.default_rng(5))


def _plot3d() -> bytes:
    out = io.BytesIO()
    write_stream(_blocks(), "plot3d", out)
    return out.getvalue()


def _job(folder: Path, data: bytes, name: str = "heights.npy", **changes: Any) -> worker.Job:
    upload = folder / "0"
    upload.write_bytes(data)
    (folder / "work").mkdir()
    given: dict[str, Any] = {"options": {}, "max_vertices": 1 << 20, "folder": folder / "work"}
    return worker.Job((upload,), name, None, "auto", **(given | changes))


def _without_memory(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(worker, "memory_limit", lambda: 2 << 20)


@pytest.mark.parametrize(
    ("options", "name"),
    [
        ({}, "heights.npy"),
        ({"precision": "0.5"}, "heights.npy"),
        ({"effort": "small"}, "heights.npy"),
        ({}, "blocks.p3d"),
    ],
)
@pytest.mark.long
def test_a_build_by_bands_has_the_same_bytes(
    options: dict[str, str], name: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "whole").mkdir()
    (tmp_path / "bands").mkdir()
    data = _plot3d() if name == "blocks.p3d" else _npy(300)
    kept = tmp_path / "kept"  # which is made when it is needed
    whole, bands = (_job(tmp_path / folder, data, name, options=options, bands=kept) for folder in ("whole", "bands"))
    built = worker.build(whole)
    assert isinstance(built, worker.Built)
    assert not kept.exists()
    _without_memory(monkeypatch)
    assert worker.build(bands) == built
    assert bands.container.read_bytes() == whole.container.read_bytes()
    assert list(kept.iterdir()) == []
    assert worker.read_progress(bands.folder) > 0


def test_an_uploaded_container_is_checked_by_bands(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    data = ls.encode(np.rint(terrain((300, 310)) * 90).astype(np.int16))
    job = _job(tmp_path, data)
    _without_memory(monkeypatch)
    assert isinstance(worker.build(job), worker.Built)
    assert job.container.read_bytes() == data
    torus = _job(_new(tmp_path, "torus"), ls.encode(ls.Surface(terrain((300, 310)), (True, True))))
    assert isinstance(worker.build(torus), worker.Built)
    sides = [ls.Block(part) for part in np.array_split(terrain((300, 310)), 4)]
    blocks = _job(_new(tmp_path, "blocks"), ls.encode(ls.Surface(blocks=sides)))
    assert isinstance(worker.build(blocks), worker.Built)
    rows, columns = np.indices((300, 310))
    ruled = ls.encode(np.stack([columns, rows, terrain((300, 310))], axis=-1))
    refused = worker.build(_job(_new(tmp_path, "ruled"), ruled))
    assert isinstance(refused, worker.Refused)
    assert "heights.npy: expected a surface that takes at most 1 MiB to check" in refused.reason
    assert not refused.final


def _new(folder: Path, name: str) -> Path:
    made = folder / name
    made.mkdir()
    return made


@pytest.mark.long
def test_a_cluster_builds_what_is_large(cluster: Any, tmp_path: Path) -> None:
    data = _npy(SIDE)
    settings = {"build_memory": MEMORY, "dask": cluster.scheduler_address, "formats": "npy"}
    with server(tmp_path / "data", preload="preload_large", **settings) as running, running.client() as http:
        large = push(http, data)
        assert large["state"] == "ready", large
        container = http.get(f"{large['url']}/container", follow_redirects=True).raise_for_status().content
    tasks = list(cluster.scheduler.task_prefixes)
    assert any("measure" in name for name in tasks)
    points = np.load(io.BytesIO(data))
    assert np.array_equal(ls.decode(container).points, points, equal_nan=True)
    assert not any((tmp_path / "data" / "scratch" / "work").iterdir())


@pytest.mark.parametrize("name", ["heights.npy", "blocks.p3d"])
@pytest.mark.long
def test_a_surface_is_parsed_where_it_is_confined_and_built_elsewhere(
    cluster: Any, name: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    data, points = _npy(300), 300 * 300
    if name == "blocks.p3d":
        data, points = _plot3d(), sum(block.shape[0] * block.shape[1] for block in _blocks().blocks)
    job, whole = _job(_new(tmp_path, "a"), data, name, shared=True), _job(_new(tmp_path, "b"), data, name)
    _without_memory(monkeypatch)
    assert worker.build(job) == worker.Parsed(points)
    assert not job.container.exists()
    task = cluster_build.ClusterJob(job, cluster.scheduler_address, 1 << 20)
    assert cluster_build.build(task) == worker.build(whole)
    assert job.container.read_bytes() == whole.container.read_bytes()


def test_a_scheduler_that_does_not_answer_is_waited_for(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    job = _job(tmp_path, _npy(300), shared=True)
    _without_memory(monkeypatch)
    monkeypatch.setattr(clusters, "_PATIENCE", 1)
    assert isinstance(worker.build(job), worker.Parsed)
    refused = cluster_build.build(cluster_build.ClusterJob(job, "tcp://127.0.0.1:1", 1 << 20))
    assert isinstance(refused, worker.Refused)
    assert refused.reason.startswith("LODESTREAM_DASK: expected the address of a Dask scheduler, got 'tcp://127.0.0.1:")
    assert not refused.final


@pytest.mark.parametrize("kind", ["link", "second name", "pipe", "folder"])
def test_what_a_parser_has_left_is_not_followed(kind: str, tmp_path: Path) -> None:
    folder, other = _new(tmp_path, "parsed"), tmp_path / "secret.npy"
    np.save(other, np.zeros((3, 3)))
    cluster_build.check_plain(folder)
    place = folder / "points.npy"
    if kind == "link":
        place.symlink_to(other)
    elif kind == "second name":
        os.link(other, place)
    elif kind == "pipe":
        os.mkfifo(place)
    else:
        (folder / "surface").symlink_to(tmp_path, target_is_directory=True)
    with pytest.raises(ls.InputError, match="expected files and folders of arrays, got something else at "):
        cluster_build.check_plain(folder)
    with pytest.raises(ls.InputError, match="expected a folder of arrays"):
        cluster_build.check_plain(other)


@pytest.mark.parametrize("address", ["nonsense", "http://127.0.0.1:8786", "tcp://127.0.0.1", "tcp://a:b"])
def test_what_is_no_address_of_a_scheduler_is_refused_at_the_start(
    address: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    words = f"expected the address of a Dask scheduler such as tcp://10.0.0.1:8786, got {address!r}"
    with pytest.raises(ValueError, match=re.escape(words)):
        Settings(data=tmp_path, dask=address)
    with pytest.raises(SystemExit) as ended:
        main(["serve", "--dask", address])
    assert ended.value.code == 2
    assert f"argument --dask: {words}" in capsys.readouterr().err
    monkeypatch.setenv("LODESTREAM_DASK", address)
    assert main(["serve", "--data", str(tmp_path / "data")]) == 1
    assert f"lodestream: LODESTREAM_DASK: {words}" in capsys.readouterr().err
    assert not (tmp_path / "data").exists()


def test_no_address_is_no_cluster(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("LODESTREAM_DASK", "")
    assert Settings(data=tmp_path).dask == Settings(data=tmp_path, dask="").dask == ""
    assert Settings(data=tmp_path, dask="[::1]:8786").dask == "[::1]:8786"


def test_a_server_with_a_scheduler_needs_dask(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(clusters, "find_spec", lambda name: None)
    with pytest.raises(
        ls.UnavailableError, match=r"expected Dask, which is not installed: pip install .lodestream\[distri"
    ):
        create_app(Settings(data=tmp_path, dask="tcp://127.0.0.1:8786"))
