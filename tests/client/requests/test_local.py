"""Files of a format that the server does not read are encoded here and sent as a container, and others by request."""

from __future__ import annotations

import asyncio
import inspect
import warnings
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest

import lodestream as ls
from lodestream.encoding.reading import read_into
from lodestream.errors import FormatError, FormatWarning, OptionError, RemoteError
from lodestream_client import Client
from lodestream_client.requests import local
from lodestream_client.requests.api import Description
from lodestream_client.requests.bodies import Source
from lodestream_server import running_server
from tests.core.remesh import scenes
from tests.patience import PATIENCE
from tests.server.routes.test_switched_off import off, vmec

from ..asked import asked
from ..conftest import Run

HEIGHTS = np.round(np.random.default_rng(4).normal(size=(9, 7)), 3)
NOTE = "the server does not read files of format"


@pytest.fixture(scope="module")
def plain(tmp_path_factory: pytest.TempPathFactory) -> Iterator[str]:
    """A server with its default formats."""
    with running_server(tmp_path_factory.mktemp("plain") / "data", workers=1) as url:
        yield url


@pytest.fixture
def text(tmp_path: Path) -> Path:
    path = tmp_path / "hill.txt"
    np.savetxt(path, HEIGHTS, fmt="%.3f")
    return path


def values_of(url: str) -> ls.Surface:
    with Client(url).connect(url) as stream:
        *_, view = stream
    return view.surface()


def test_the_server_says_what_it_reads(plain: str, server: str) -> None:
    import httpx

    default = httpx.get(f"{plain}/v1/formats", timeout=PATIENCE).json()["formats"]
    assert {"npy", "netcdf", "lode"} <= set(default)
    assert not {"text", "vmec", "usgs-dem"} & set(default)
    assert "text" in httpx.get(f"{server}/v1/formats", timeout=PATIENCE).json()["formats"]


@pytest.mark.parametrize("asynchronous", [False, True], ids=["sync", "async"])
@pytest.mark.parametrize("kind", ["path", "file", "bytes"])
def test_a_file_of_a_format_that_is_switched_off(plain: str, text: Path, kind: str, asynchronous: bool) -> None:
    stages: list[str] = []

    def progress(stage: str, fraction: float) -> None:
        stages.append(stage)

    def upload(source: Source) -> Description:
        filename = None if kind == "path" else "hill.txt"
        if asynchronous:
            return asyncio.run(asked(plain, lambda it: it.upload(source, filename=filename, progress=progress)))
        return Client(plain).upload(source, filename=filename, progress=progress)

    words = rf"{NOTE} text: .*hill\.txt is encoded here and sent as a container"
    with text.open("rb") as file:
        sources: dict[str, Source] = {"path": text, "file": file, "bytes": text.read_bytes()}
        with pytest.warns(FormatWarning, match=words):
            surface = upload(sources[kind])
    assert surface.state == "ready"
    assert surface.details["metadata"]["name"] == "hill"
    np.testing.assert_array_equal(values_of(surface.url).points, HEIGHTS)
    assert stages[0] == "encoding"
    assert "sending" in stages


def test_a_server_that_reads_it_gets_the_file(server: str, text: Path) -> None:
    stages: list[str] = []
    surface = Client(server).upload(text, progress=lambda stage, fraction: stages.append(stage))
    assert "encoding" not in stages
    np.testing.assert_array_equal(values_of(surface.url).points, HEIGHTS)


def test_by_request(server: str, text: Path) -> None:
    stages: list[str] = []
    surface = Client(server).upload(
        text, local=True, name="here", progress=lambda stage, fraction: stages.append(stage)
    )
    assert "encoding" in stages
    assert surface.details["metadata"]["name"] == "here"
    np.testing.assert_array_equal(values_of(surface.url).points, HEIGHTS)


def test_all_options_are_kept(plain: str, text: Path) -> None:
    with pytest.warns(FormatWarning) as caught:
        surface = Client(plain).upload(
            text, precision=0.1, closed="rows", nodata=float(HEIGHTS[0, 0]), options={"layout": "heights"}
        )
    assert any("masks 1 of 63 points" in str(warning.message) for warning in caught)
    values = values_of(surface.url)
    assert values.closed == (True, False)
    assert values.mask is not None
    assert np.argwhere(~values.mask).tolist() == [[0, 0]]
    assert np.abs(values.points - HEIGHTS)[values.mask].max() <= 0.1
    assert surface.details["exact"] is False
    with pytest.raises(OptionError, match="expected an option of format text"):
        Client(plain).upload(text, options={"band": "1"})
    with pytest.raises(OptionError, match="room is not an option of any format"):
        Client(plain).upload(text, options={"room": "1"})


def test_no_parameter_of_a_reader_is_an_option_of_a_format() -> None:
    parameters = [it for reader in (ls.read, read_into) for it in inspect.signature(reader).parameters.values()]
    for name in {it.name for it in parameters if it.kind is not it.VAR_KEYWORD} - {"more"}:
        with pytest.raises(OptionError, match=f"{name} is not an option of any format"):
            local.checked_options({name: "1"})


def test_several_files_are_one_surface(plain: str, tmp_path: Path) -> None:
    rows, columns = np.mgrid[0:5, 0:6] / 3
    for name, values in {"x": columns + rows, "y": rows, "z": rows * columns}.items():
        np.savetxt(tmp_path / f"{name}.dat", values)
    with pytest.warns(FormatWarning, match=NOTE):
        surface = Client(plain).upload(*(tmp_path / f"{name}.dat" for name in "xyz"))
    assert values_of(surface.url).points.shape == (5, 6, 3)


def test_what_is_known_only_to_the_reader(plain: str, tmp_path: Path) -> None:
    path = tmp_path / "w7x.nc"
    path.write_bytes(vmec())
    with pytest.warns(FormatWarning, match=rf"{NOTE} vmec"):
        surface = Client(plain).upload(path, options={"resolution": "8x16"})
    assert surface.details["shape"] == [8, 16]
    with warnings.catch_warnings():
        warnings.simplefilter("error", FormatWarning)
        assert Client(plain).upload(path, options={"variable": "rmnc"}).state == "ready"  # a NetCDF like any other


def test_what_cannot_be_read_is_refused(plain: str, text: Path, tmp_path: Path) -> None:
    text.write_text("1 2 3\n4 5\n")
    with pytest.raises(FormatError, match=r"hill\.txt: expected 3 numbers in each line, .* got 2 in line 2"):
        Client(plain).upload(text)
    (tmp_path / "a.tif").write_bytes(b"nothing")
    with pytest.raises(FormatError, match=r"a\.tif: this is .*, not a file of a format that is read"):
        Client(plain).upload(tmp_path / "a.tif")
    (tmp_path / "a.nc").write_bytes(b"CDF\x01 and no more")
    with pytest.raises(RemoteError, match=r"a\.nc: expected"):
        Client(plain).upload(tmp_path / "a.nc")


def test_containers_go_as_they_are(plain: str, container_file: Path) -> None:
    surface = Client(plain).upload(container_file, local=True)
    assert Client(surface.url).fetch_range(surface.url, 0, surface.details["bytes"]) == container_file.read_bytes()


def test_push(run: Run, plain: str, text: Path) -> None:
    code, stdout, stderr = run("push", text, plain)
    assert code == 0, stderr
    assert f"{NOTE} text: {text} is encoded here and sent as a container" in stderr
    np.testing.assert_array_equal(values_of(stdout.strip()).points, HEIGHTS)
    np.save(text.with_suffix(".npy"), HEIGHTS)
    code, stdout, stderr = run("push", text.with_suffix(".npy"), plain, "--local")
    assert (code, NOTE in stderr) == (0, False), stderr
    np.testing.assert_array_equal(values_of(stdout.strip()).points, HEIGHTS)
    code, stdout, stderr = run("push", "--each", text, text.with_suffix(".npy"), plain)
    assert (code, stderr.count(NOTE), len(stdout.splitlines())) == (0, 1, 2), stderr


@pytest.mark.parametrize("given", [["speed", "kind"], ("speed", "kind"), "speed,kind"])
@pytest.mark.parametrize("local", [False, True])
def test_attributes_of_an_upload_are_a_list_or_a_text(plain: str, tmp_path: Path, given: object, local: bool) -> None:
    xarray = pytest.importorskip("xarray")
    values = np.add.outer(np.arange(9.0), np.arange(7.0))
    names = ("z", "speed", "kind", "rest")
    data = {name: (("y", "x"), values + number) for number, name in enumerate(names)}
    xarray.Dataset(data).to_netcdf(tmp_path / "a.nc", engine="h5netcdf")
    options = {"variable": "z", "attributes": given}
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", FormatWarning)  # of the rest
        remote = Client(plain).upload(tmp_path / "a.nc", options=options, local=local)  # type: ignore[arg-type]
    surface = values_of(remote.url)
    assert list(surface.attributes) == ["speed", "kind"]
    np.testing.assert_array_equal(surface.attributes["kind"], values + 2)


def test_attributes_of_a_query_may_be_said_one_by_one() -> None:
    from lodestream_server.builds.options import SurfaceOptions

    query = [("attributes", "speed,kind"), ("variable", "z"), ("attributes", "rest")]
    assert SurfaceOptions.parse(query).chosen == {"variable": "z", "attributes": "speed,kind,rest"}


def test_a_confined_build_converts_units_to_those_of_the_crs(plain: str, tmp_path: Path) -> None:
    xarray, pyproj = pytest.importorskip("xarray"), pytest.importorskip("pyproj")
    place = {name: (name, 2.0 * np.arange(count), {"units": "km"}) for name, count in (("y", 9), ("x", 7))}
    crs = ((), 0, {"crs_wkt": pyproj.CRS.from_epsg(32633).to_wkt()})
    values = np.add.outer(np.arange(9.0), np.arange(7.0))
    data = xarray.Dataset({"z": (("y", "x"), values, {"grid_mapping": "crs"}), "crs": crs}, place)
    data.to_netcdf(tmp_path / "a.nc", engine="h5netcdf")
    surface = values_of(Client(plain).upload(tmp_path / "a.nc").url)
    assert surface.metadata["geotransform"] == [-1000.0, 2000.0, 0.0, -1000.0, 0.0, 2000.0]
    assert any("x and y are converted from 'km'" in note for note in surface.metadata["notes"])


@pytest.mark.parametrize("there", [False, True], ids=["switched off there", "switched on there"])
def test_a_mesh_is_resampled_where_that_is_switched_on(plain: str, server: str, tmp_path: Path, there: bool) -> None:
    pytest.importorskip("igl")
    path = tmp_path / "ball.off"
    path.write_bytes(off(*scenes.sphere()))
    stages: list[str] = []
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        surface = Client(server if there else plain).upload(
            path,
            options={"remesh": "yes", "blocks": "12", "remesh_error": "1e-2"},
            progress=lambda stage, _: stages.append(stage),
        )
    assert surface.details["state"] == "ready"
    assert surface.details["metadata"]["remesh"]["blocks"] > 1
    words = "the server does not resample meshes"
    assert [str(it.message).startswith(words) for it in caught if it.category is FormatWarning] == [True] * (not there)
    assert ("remeshing" in stages) is not there
