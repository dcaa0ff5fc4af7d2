"""`lodestream.open` of URLs: a server and static hosts; publishing/test_reading.py has names on pages."""

from __future__ import annotations

import pickle
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

import lodestream as ls
from lodestream.maps import HeightField, crs_wkt
from lodestream_client import Client
from tests.client import files
from tests.core.surfaces import terrain

HEIGHTS = (terrain((300, 400), 3) * 8).round().astype("i2")


@pytest.fixture(scope="module")
def path(tmp_path_factory: pytest.TempPathFactory) -> Path:
    found = tmp_path_factory.mktemp("open") / "hills.lode"
    found.write_bytes(ls.encode(ls.Surface(HEIGHTS, metadata={"name": "hill"})))
    return found


def test_a_surface_of_a_server(server: str, path: Path) -> None:
    url = Client(server).upload(path, name="my hills").url
    with ls.open(url) as opened:
        assert opened.source.name == "my hills"
        assert opened.info == ls.open(path).info
        assert np.array_equal(opened.window((20, 90), (40, 60)).points, HEIGHTS[20:90, 40:60])
        rough = opened.view(rms=3)
        assert 0 < rough.rms <= 3
        assert [view.rms for view in opened] == [view.rms for view in ls.open(path)]
        copy = pickle.loads(pickle.dumps(opened))
    assert copy.view(level=3).bytes == ls.open(path).view(level=3).bytes
    with pytest.raises(ls.InputError, match="which was closed"):
        opened.view()
    with pytest.raises(ls.NotFoundError):
        ls.open(url[:-3] + "000")


def test_a_file_of_a_host_with_ranges(path: Path) -> None:
    with files.ranged(path.parent) as host, ls.open(f"{host.url}/hills.lode") as opened:
        host.requests.clear()
        view = opened.view(rms=3)
        asked = [told for method, told in host.requests if method == "GET" and told]
        taken = sum(int(last) - int(first) + 1 for first, last in (told[6:].split("-") for told in asked))
        assert len(asked) == 1
        assert taken < view.bytes, "the header was read before"
        assert np.array_equal(opened.view().points, HEIGHTS)
        with pytest.raises(ls.NotFoundError):
            ls.open(f"{host.url}/none.lode")
        (path.parent / "text.lode").write_text("nothing of the kind, but long enough to be asked for in parts")
        with pytest.raises(ls.CorruptStreamError) as other:
            ls.open(f"{host.url}/text.lode")
        assert other.value.__notes__[0] == f"in {host.url}/text.lode"


def test_a_host_that_tells_no_version_is_described_only(path: Path) -> None:
    with files.ranged(path.parent) as host:
        host.tags = False
        url = f"{host.url}/hills.lode"
        assert Client(url).describe_file(url)["shape"] == [300, 400]
        with pytest.raises(ls.LodestreamError, match="expected the length and the version"):
            ls.open(url)


def test_heights_for_maps_at_an_address(path: Path, tmp_path: Path) -> None:
    placed = {"crs": crs_wkt("EPSG:4326"), "geotransform": [7.0, 0.01, 0.0, 46.0, 0.0, -0.01]}
    (tmp_path / "hill.lode").write_bytes(ls.encode(ls.Surface(HEIGHTS, metadata=placed)))
    places = np.array([7.205]), np.array([45.895])
    with files.ranged(tmp_path) as host:
        field = HeightField.open(f"{host.url}/hill.lode")
        assert field.heights(*places)[0, 0] == HEIGHTS[10, 20]
        with pytest.raises(ls.NotFoundError):
            HeightField.open(f"{host.url}/none.lode")
    with pytest.raises(ls.OptionError, match="to whose server the token belongs"):
        HeightField.open(tmp_path / "hill.lode", token="secret")


def test_a_file_that_changes_on_its_host(path: Path, tmp_path: Path) -> None:
    (tmp_path / "a.lode").write_bytes(path.read_bytes())
    with files.ranged(tmp_path) as host, ls.open(f"{host.url}/a.lode") as opened:
        views = iter(opened)
        next(views)
        (tmp_path / "a.lode").write_bytes(ls.encode(HEIGHTS[::-1]))
        with pytest.raises(ls.RemoteError, match="got another"):
            list(views)


def test_the_core_finds_the_client_by_its_entry_point(installed: dict[str, str], path: Path) -> None:
    script = "import sys, lodestream; print(lodestream.open(sys.argv[1]).window((0, 9), (0, 8)).shape)"
    with files.ranged(path.parent) as host:
        command = [sys.executable, "-c", script, f"{host.url}/hills.lode"]
        done = subprocess.run(command, env=installed, capture_output=True, text=True, check=False)
    assert (done.stdout, done.stderr) == ("(9, 8)\n", "")
