"""Which formats a server reads: what the setting says, and what happens to files of the others."""

from __future__ import annotations

import io
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from pydantic import ValidationError

import lodestream as ls
from lodestream import formats
from lodestream_server import Settings
from lodestream_server.builds import worker
from lodestream_server.operation.settings import FORMATS
from tests.core.remesh import scenes
from tests.server.builds import slow
from tests.server.builds.test_builds import building, running
from tests.server.helpers import hills, npy, problem, push, settled

DEFAULT: tuple[str, ...] = Settings.model_fields["formats"].default
LEFT_OUT = {"usgs-dem", "bpt", "vmec", "text", "remesh"}


def dem() -> bytes:
    """The head of a USGS DEM, as far as it is looked at when an upload comes."""
    head = bytearray(b" " * 1024)
    head[150:156] = b"     1"
    head[156:162] = b"     1"
    head[528:534] = b"     2"
    return bytes(head)


def text() -> bytes:
    file = io.BytesIO()
    np.savetxt(file, hills(9, 7), fmt="%.3f")
    return file.getvalue()


def vmec() -> bytes:
    scipy_io = pytest.importorskip("scipy.io")
    pytest.importorskip("xarray")
    pytest.importorskip("h5netcdf")
    file = io.BytesIO()
    with scipy_io.netcdf_file(file, "w") as made:
        made.createDimension("radius", 2)
        made.createDimension("mode", 2)
        for name, values in {
            "rmnc": [[0.0, 0.0], [3.0, 1.0]],
            "zmns": [[0.0, 0.0], [0.0, 1.0]],
            "xm": [0.0, 1.0],
            "xn": [0.0, 0.0],
        }.items():
            made.createVariable(name, "d", ("radius", "mode")[2 - np.asarray(values).ndim :])[:] = values
        made.flush()
        return file.getvalue()


def test_the_setting_knows_every_format_that_is_read() -> None:
    read = {name for format_ in formats.formats() if format_.read and not format_.folder for name in format_.names}
    assert set(FORMATS) == read | {"lode", "remesh"}
    assert set(DEFAULT) == set(FORMATS) - LEFT_OUT
    assert Settings().formats == DEFAULT
    assert Settings.model_validate({"formats": "all"}).formats == FORMATS
    assert Settings.model_validate({"formats": " text, npy "}).formats == ("text", "npy")


@pytest.mark.parametrize("value", ["npy,vml", "NPY", "all,npy", ",", ("npy", "vml"), ()])
def test_a_name_that_no_format_has_is_refused(value: str | tuple[str, ...]) -> None:
    with pytest.raises(ValidationError, match="expected all, or some of npy, npz"):
        Settings.model_validate({"formats": value})


@pytest.mark.parametrize(
    ("name", "filename", "body"),
    [("usgs-dem", "hill.dem", dem), ("text", "hill.txt", text)],
)
def test_an_upload_of_a_format_that_is_switched_off_is_refused_at_once(
    tmp_path: Path, name: str, filename: str, body: Callable[[], bytes]
) -> None:
    with running(tmp_path / "data") as http:
        answers = [
            http.post("/v1/surfaces", content=body(), params={"filename": filename}),
            http.post("/v1/surfaces", files=[("file", (filename, body()))]),
        ]
        for answer in answers:
            assert problem(answer) == (422, "bad-file")
            detail = answer.json()["detail"]
            assert detail.startswith(f"{filename}: ")
            assert f"got {name}, which is switched off on this server" in detail
            assert "setting LODESTREAM_FORMATS" in detail
        assert http.get("/v1/surfaces").json()["surfaces"] == []


def test_what_is_switched_on_is_read(tmp_path: Path) -> None:
    with running(tmp_path / "data", formats="text") as http:
        assert push(http, text(), filename="hill.txt")["state"] == "ready"
        answer = http.post("/v1/surfaces", content=npy(hills()))
        assert problem(answer) == (422, "bad-file")
        assert "got npy, which is switched off" in answer.json()["detail"]


def off(points: np.ndarray, faces: np.ndarray) -> bytes:
    """A mesh in OFF."""
    lines = [f"OFF\n{len(points)} {len(faces)} 0", *(" ".join(map(repr, row)) for row in points.tolist())]
    return "\n".join([*lines, *(f"3 {a} {b} {c}" for a, b, c in faces.tolist())]).encode()


def test_meshes_that_are_no_grids_are_resampled_only_where_that_is_switched_on(tmp_path: Path) -> None:
    pytest.importorskip("igl")
    body = off(*scenes.sphere())
    asked = {"filename": "ball.off", "remesh": "yes", "blocks": "12", "remesh_error": "1e-2"}
    with running(tmp_path / "off") as http:
        answer = http.post("/v1/surfaces", content=body, params=asked)
        assert problem(answer) == (422, "bad-file")
        assert "got remesh, which is switched off on this server" in answer.json()["detail"]
    with running(tmp_path / "on", formats="off,remesh") as http:
        surface = push(http, body, **asked)
        assert surface["state"] == "ready"
        assert http.get(f"/v1/surfaces/{surface['id']}").json()["metadata"]["remesh"]["blocks"] > 1


def test_finished_containers_are_a_format_too(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    container = ls.encode(hills(9, 7))
    with running(tmp_path / "off", formats="npy") as http:
        answer = http.post("/v1/surfaces", content=container, params={"filename": "hill.lode"})
        assert problem(answer) == (422, "bad-file")
        assert answer.json()["detail"].startswith("hill.lode: ")
        assert "got lode, which is switched off on this server" in answer.json()["detail"]
    data = tmp_path / "data"
    monkeypatch.setattr(worker, "build", slow.wait)
    with running(data) as http:
        surface = http.post("/v1/surfaces", content=container).json()
        building(http, surface["url"])
    monkeypatch.undo()
    with running(data, formats="npy") as http:
        waiting = settled(http, surface["url"])
        assert (waiting["state"], "got lode, which is switched off" in waiting["reason"]) == ("waiting", True)
    with running(data) as http:
        assert http.post(f"{surface['url']}/retry").status_code == 202
        assert settled(http, surface["url"])["state"] == "ready"


def test_what_is_found_out_only_by_reading_waits(tmp_path: Path) -> None:
    with running(tmp_path / "data") as http:
        surface = push(http, vmec(), filename="w7x.nc")
        assert surface["state"] == "waiting"
        assert "w7x.nc: " in surface["reason"]
        assert "got vmec, which is switched off on this server; its setting LODESTREAM" in surface["reason"]
        # The same file read as a table of numbers is a NetCDF like any other.
        assert push(http, vmec(), filename="w7x.nc", variable="rmnc")["state"] == "ready"
        assert http.post(f"{surface['url']}/retry").status_code == 202
        assert settled(http, surface["url"])["state"] == "waiting"
    with running(tmp_path / "data", formats="vmec") as http:
        assert http.post(f"{surface['url']}/retry").status_code == 202
        assert settled(http, surface["url"])["state"] == "ready"
        other = push(http, vmec(), filename="w7x.nc", variable="zmns")
        assert other["state"] == "waiting"
        assert "got netcdf, which is switched off" in other["reason"]


def test_what_is_to_be_built_after_its_format_was_switched_off_waits(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    data = tmp_path / "data"
    monkeypatch.setattr(worker, "build", slow.wait)
    with running(data, formats="all") as http:
        surface = http.post("/v1/surfaces", content=text(), params={"filename": "hill.txt"}).json()
        building(http, surface["url"])
    monkeypatch.undo()
    with running(data) as http:
        waiting = settled(http, surface["url"])
        assert waiting["state"] == "waiting"
        assert "got text, which is switched off on this server" in waiting["reason"]
        assert problem(http.get(f"{surface['url']}/container")) == (409, "waiting")
    with running(data, formats="all") as http:
        assert http.get(surface["url"]).json()["state"] == "waiting"
        assert http.post(f"{surface['url']}/retry").status_code == 202
        assert settled(http, surface["url"])["state"] == "ready"
    # What is ready stays so: nothing is read any more.
    with running(data) as http:
        assert http.get(surface["url"]).json()["state"] == "ready"
