"""Containers and levels as files: ranges, caching, formats."""

from __future__ import annotations

import errno
import hashlib
import io
import warnings
from collections.abc import Callable
from contextlib import closing
from http.client import HTTPConnection
from importlib.util import find_spec
from pathlib import Path
from typing import Any
from zipfile import ZipFile

import anyio
import httpx
import numpy as np
import pytest

import lodestream as ls
from lodestream.formats import write_stream
from lodestream_server import running_server
from lodestream_server.builds import levels
from tests.patience import PATIENCE
from tests.server.helpers import eventually, hills, kept, npy, push


@pytest.fixture(scope="module")
def surface(http: httpx.Client) -> dict[str, Any]:
    return push(http, npy(hills(65, 50)))


@pytest.fixture(scope="module")
def address(surface: dict[str, Any]) -> str:
    return f"/v1/containers/{surface['container_sha256']}.lode"


def test_a_container_has_two_addresses(http: httpx.Client, surface: dict[str, Any], address: str) -> None:
    of_surface, itself = http.get(surface["url"] + "/container"), http.get(address)
    assert of_surface.headers["content-location"] == address
    assert of_surface.content == itself.content
    for container, lasting in ((of_surface, "private, no-cache"), (itself, "private, max-age=31536000, immutable")):
        assert container.status_code == 200
        assert container.headers["etag"] == f'"{surface["container_sha256"]}"'
        assert container.headers["accept-ranges"] == "bytes"
        assert container.headers["cache-control"] == lasting
        assert container.headers["content-length"] == str(surface["bytes"])
    part = http.get(surface["url"] + "/container", headers={"range": "bytes=4-9", "if-range": itself.headers["etag"]})
    assert (part.status_code, part.content) == (206, itself.content[4:10])
    again = http.get(surface["url"] + "/container", headers={"if-none-match": itself.headers["etag"]})
    assert (again.status_code, again.content, again.headers["content-location"]) == (304, b"", address)


def test_ranges_are_slices_of_the_file(http: httpx.Client, surface: dict[str, Any], address: str) -> None:
    whole, size = http.get(address).content, surface["bytes"]
    for header, expected in (
        ("bytes=0-0", whole[:1]),
        ("bytes=100-299", whole[100:300]),
        ("bytes=-50", whole[-50:]),
        (f"bytes={size - 5}-", whole[-5:]),
        (f"bytes=10-{size + 1000}", whole[10:]),
    ):
        answer = http.get(address, headers={"range": header})
        assert (answer.status_code, answer.content) == (206, expected)
        start = whole.index(expected)
        assert answer.headers["content-range"] == f"bytes {start}-{start + len(expected) - 1}/{size}"
        assert answer.headers["etag"] == f'"{surface["container_sha256"]}"'
    several = http.get(address, headers={"range": "bytes=0-9,100-109"})
    assert several.status_code == 206
    assert several.headers["content-type"].startswith("multipart/byteranges")
    assert whole[100:110] in several.content
    for header in (f"bytes={size}-", f"bytes=0-1,{size + 5}-{size + 9}", "bytes=-0"):
        outside = http.get(address, headers={"range": header})
        assert (outside.status_code, outside.headers["content-range"]) == (416, f"bytes */{size}")
        assert outside.headers["content-type"] == "application/problem+json"


@pytest.mark.parametrize(
    "header",
    [
        "bytes",
        "bytes=",
        "bytes=a-b",
        "bytes=5-2",
        "lines=1-2",
        "bytes=--1",
        "bytes=0-" + ",0-" * 4_000,
        "bytes=" + "9" * 99,
    ],
)
def test_what_is_no_list_of_ranges_is_ignored(
    http: httpx.Client, surface: dict[str, Any], address: str, header: str
) -> None:
    answer = http.get(address, headers={"range": header})
    assert (answer.status_code, len(answer.content)) == (200, surface["bytes"])


def test_if_range_gives_the_whole_file_when_it_is_another(http: httpx.Client, address: str) -> None:
    etag = http.head(address).headers["etag"]
    same = http.get(address, headers={"range": "bytes=0-9", "if-range": etag})
    other = http.get(address, headers={"range": "bytes=0-9", "if-range": '"other"'})
    assert (same.status_code, other.status_code) == (206, 200)


def test_what_the_client_has_is_not_sent_again(http: httpx.Client, surface: dict[str, Any], address: str) -> None:
    for path in (address, surface["url"] + "/levels/2"):
        etag = http.get(path).headers["etag"]
        for header in (etag, f'"other", W/{etag}', "*"):
            answer = http.get(path, headers={"if-none-match": header})
            assert (answer.status_code, answer.content, answer.headers["etag"]) == (304, b"", etag)
        assert http.get(path, headers={"if-none-match": '"other"'}).status_code == 200


def test_head_tells_size_and_range(http: httpx.Client, surface: dict[str, Any], address: str) -> None:
    head = http.head(address)
    assert head.headers["content-length"] == str(surface["bytes"])
    partial = http.head(address, headers={"range": "bytes=0-9"})
    assert (partial.status_code, partial.headers["content-length"]) == (206, "10")


def test_a_level_is_the_grid_that_decoding_gives(http: httpx.Client, surface: dict[str, Any]) -> None:
    decoder = ls.Decoder()
    decoder.feed(http.get(surface["url"] + "/container", follow_redirects=True).content)
    finest = surface["levels"][-1]["level"]
    for level in (0, 1, finest - 1, finest):
        answer = http.get(f"{surface['url']}/levels/{level}")
        assert answer.status_code == 200
        assert f"-{level}.npy" in answer.headers["content-disposition"]
        points = np.load(io.BytesIO(answer.content))
        assert list(points.shape) == surface["levels"][level]["shape"]
        assert np.array_equal(points, decoder.points_at(level))
    assert np.array_equal(points, hills(65, 50))


def test_levels_have_a_length_and_ranges(http: httpx.Client, surface: dict[str, Any]) -> None:
    path = f"{surface['url']}/levels/{surface['levels'][-1]['level']}"
    whole = http.get(path)
    assert whole.headers["content-length"] == str(len(whole.content)) == str(len(npy(hills(65, 50))))
    head = http.head(path)
    assert (head.status_code, head.content) == (200, b"")
    for name in ("content-length", "content-type", "content-disposition", "etag", "accept-ranges"):
        assert head.headers[name] == whole.headers[name]
    part = http.get(path, headers={"range": "bytes=100-299", "if-range": whole.headers["etag"]})
    assert (part.status_code, part.content) == (206, whole.content[100:300])
    outside = http.get(path, headers={"range": "bytes=99999-"})
    assert (outside.status_code, outside.headers["content-type"]) == (416, "application/problem+json")


def test_levels_of_another_version_are_other_files(
    http: httpx.Client, surface: dict[str, Any], monkeypatch: pytest.MonkeyPatch
) -> None:
    path = f"{surface['url']}/levels/1"
    before = http.get(path).headers["etag"]
    assert http.get(path, headers={"if-none-match": before}).status_code == 304
    changes: tuple[tuple[str, int | Callable[[str], str]], ...] = (
        ("_REVISION", levels._REVISION + 1),
        ("version", lambda library: "99.9"),
    )
    for name, value in changes:
        with monkeypatch.context() as patch:
            patch.setattr(levels, name, value)
            levels.written_by.cache_clear()
            answer = http.get(path, headers={"if-none-match": before, "if-range": before, "range": "bytes=0-9"})
            assert answer.status_code == 200, "not a part of another file"
            assert answer.headers["etag"] != before
        levels.written_by.cache_clear()
    assert http.get(path).headers["etag"] == before


def test_the_files_are_those_of_this_revision() -> None:
    # The formats that no other library has a part in. If this fails because what is written has changed on purpose,
    # raise the revision of level files, and put the new digest here.
    rows, columns = np.mgrid[:9, :7]
    surface = ls.Surface(
        (rows * 3 - columns).astype(np.float32),
        mask=rows + columns > 2,
        attributes={"a": (rows * columns).astype(np.int16)},
        metadata={"name": "hill", "geotransform": [100.0, 2.0, 0.0, 50.0, 0.0, -2.0], "unit": "m"},
    )
    decoder = ls.Decoder()
    digest = hashlib.sha256()
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", ls.FormatWarning)
        decoder.feed(ls.encode(surface))
        for name in ("npy", "esri-ascii", "obj", "ply", "glb", "plot3d"):
            for level in (None, 0, 2):
                file = io.BytesIO()
                write_stream(decoder.surface(level), name, file)
                digest.update(file.getvalue())
    assert (levels._REVISION, digest.hexdigest()[:16]) == (3, "29c5cfce29e7b6a2")


def test_levels_come_as_meshes_too(http: httpx.Client, surface: dict[str, Any], tmp_path: Path) -> None:
    rows, columns = surface["levels"][3]["shape"]
    obj = http.get(surface["url"] + "/levels/3", params={"format": "obj"})
    assert obj.headers["content-type"].startswith("model/obj")
    (tmp_path / "level.obj").write_bytes(obj.content)
    mesh = ls.read(tmp_path / "level.obj")
    assert mesh.shape == (rows, columns)
    # A level is as large as the surface.
    assert mesh.points[..., 0].max() == pytest.approx(49)
    assert mesh.points[..., 1].max() == pytest.approx(64)
    ply = http.get(surface["url"] + "/levels/3", params={"format": "ply"})
    assert f"element vertex {rows * columns}\n".encode() in ply.content


def test_a_level_of_several_files_is_an_archive(http: httpx.Client, surface: dict[str, Any]) -> None:
    answer = http.get(surface["url"] + "/levels/3", params={"format": "vtm"})
    assert answer.headers["content-type"] == "application/zip"
    assert '-3.vtm.zip"' in answer.headers["content-disposition"]
    with ZipFile(io.BytesIO(answer.content)) as archive:
        assert archive.namelist() == ["surface.vtm", "surface/surface_0.vts"]


def test_a_level_is_no_folder(http: httpx.Client, surface: dict[str, Any]) -> None:
    answer = http.get(surface["url"] + "/levels/3", params={"format": "zarr"})
    assert answer.status_code == 422
    assert "expected format to be one of npy, " in answer.json()["detail"]
    assert "got 'zarr'" in answer.json()["detail"]


@pytest.mark.parametrize("name", ["npz", "asc", "nc", "p3d"])
def test_levels_come_in_what_other_programs_read(
    http: httpx.Client, surface: dict[str, Any], tmp_path: Path, name: str
) -> None:
    if name == "nc":
        pytest.importorskip("h5netcdf")
    answer = http.get(surface["url"] + "/levels/3", params={"format": name})
    assert answer.status_code == 200
    assert f'-3.{name}"' in answer.headers["content-disposition"]
    (tmp_path / f"level.{name}").write_bytes(answer.content)
    if name == "asc":
        pytest.importorskip("rasterio")
    expected = np.load(io.BytesIO(http.get(surface["url"] + "/levels/3").content))
    level = ls.read(tmp_path / f"level.{name}")
    heights = level.points if level.points.ndim == 2 else level.points[..., 2]
    # Text goes from north to south, and y grows with the rows here.
    np.testing.assert_array_equal(heights.astype(expected.dtype), expected[::-1] if name == "asc" else expected)


def test_a_server_of_one_thread_makes_every_format(tmp_path: Path) -> None:
    formats = ["npy", "npz", "p3d", "ply", "vts"]
    formats += ["nc"] if find_spec("h5netcdf") else []
    formats += ["tif", "cog", "asc"] if find_spec("rasterio") else []
    with (
        running_server(tmp_path / "data", workers=1, threads=1) as url,
        httpx.Client(base_url=url, trust_env=False, timeout=PATIENCE) as client,
    ):
        address = push(client, npy(hills(33, 20)))["url"]
        answers = {name: client.get(f"{address}/levels/2", params={"format": name}) for name in formats}
    assert {name: answer.status_code for name, answer in answers.items()} == dict.fromkeys(formats, 200)


def test_what_does_not_exist_is_named(http: httpx.Client, surface: dict[str, Any]) -> None:
    finest = surface["levels"][-1]["level"]
    for path, words in (
        ("/levels/99", f"0 to {finest}"),
        ("/levels/-1", f"0 to {finest}"),
        ("/levels/x", "a whole number"),
        ("/levels/1?format=off", "to be one of npy, "),
    ):
        answer = http.get(surface["url"] + path)
        assert (answer.status_code, answer.json()["code"]) == (422, "bad-option")
        assert words in answer.json()["detail"]


def test_a_file_that_was_sent_and_cannot_be_closed_cuts_no_connection(
    http: httpx.Client, surface: dict[str, Any], address: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    close = anyio.AsyncFile.aclose

    async def fail(file: anyio.AsyncFile[bytes]) -> None:
        await close(file)
        raise OSError(errno.EIO, "Input/output error")

    monkeypatch.setattr(anyio.AsyncFile, "aclose", fail)
    for path in (address, f"{surface['url']}/levels/2"):
        whole = http.get(path).content
        with closing(HTTPConnection(http.base_url.host, http.base_url.port or 80, timeout=PATIENCE)) as connection:
            connection.connect()
            first = connection.sock
            for headers in ({}, {"range": "bytes=0-9"}, {"range": "bytes=0-9,20-29"}, {}):
                connection.request("GET", path, headers=headers)
                answer = connection.getresponse()
                assert answer.status in (200, 206)
                got = answer.read()
            assert got == whole
            assert connection.sock is first


def test_nothing_is_left_behind(http: httpx.Client, surface: dict[str, Any], data: Path) -> None:
    http.get(surface["url"] + "/levels/2")
    for name in ("scratch/work", "scratch/incoming"):
        eventually(lambda name=name: not kept(data, name), "nothing to be left")  # type: ignore[misc]
