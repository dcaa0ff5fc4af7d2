"""Names on a published page: the command, streams, xarray and pictures read what they lead to, over Range."""

from __future__ import annotations

import asyncio
import json
import pickle
import time
from collections.abc import Iterator
from contextlib import suppress
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from typing import Any, ClassVar

import numpy as np
import pytest

import lodestream as ls
from lodestream.errors import NotFoundError, OptionError, RemoteProtocolError
from lodestream_client import AsyncClient, Client
from lodestream_client.errors import SilenceError
from lodestream_client.program import main
from lodestream_client.requests.addresses import published_name
from tests.client.files import Ranged, ranged, running

from ..asked import asked

HILLS = np.add.outer(np.sin(np.arange(60) / 9), np.cos(np.arange(80) / 7)).astype(np.float32)


pytestmark = pytest.mark.usefixtures("pages")


def write(tmp_path: Path, factor: float = 1.0) -> str:
    path = tmp_path / "hills & dales.npy"
    np.save(path, HILLS * np.float32(factor))
    return str(path)


@pytest.fixture
def host(tmp_path: Path, pages: object) -> Iterator[Ranged]:
    """A host of files with two published surfaces, one with a name that an address has to escape."""
    np.save(tmp_path / "plain.npy", HILLS[:9, :9])
    store = tmp_path / "store"
    with ranged(store) as server:
        assert main(["publish", write(tmp_path), str(tmp_path / "plain.npy"), str(store)]) == 0
        server.requests.clear()
        yield server


NAME = "hills%20%26%20dales"


@pytest.mark.parametrize("begin", ["/", "/index.html", "/index.html?a=b"])
def test_pull_receives_what_a_name_leads_to(tmp_path: Path, host: Ranged, begin: str) -> None:
    out = tmp_path / "out.npy"
    assert main(["pull", f"{host.url}{begin}#{NAME}&v=1,2,3", str(out)]) == 0
    assert np.array_equal(np.load(out), HILLS)


def test_pull_goes_on_with_what_it_has(tmp_path: Path, host: Ranged, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("LODESTREAM_CACHE", str(tmp_path / "cache"))
    out = tmp_path / "out.npy"
    for limit in (["--max-bytes", "3000"], []):
        assert main(["pull", "--resume", f"{host.url}/#{NAME}", str(out), *limit]) == 0
    assert np.array_equal(np.load(out), HILLS)


def test_a_stream_ends_on_the_container_that_it_began(tmp_path: Path, host: Ranged) -> None:
    url = f"{host.url}/#{NAME}"
    with Client(url).connect(url) as stream:
        first = next(iter(stream))
        assert not first.complete
        assert main(["publish", write(tmp_path, 2.0), str(tmp_path / "store")]) == 0
        *_, last = stream
    assert last.complete
    assert np.array_equal(last.surface().points, HILLS)
    with Client(url).connect(url) as stream:
        *_, last = stream
    assert np.array_equal(last.surface().points, HILLS * np.float32(2))


def test_the_asyncio_client_reads_names_too(host: Ranged) -> None:
    async def received() -> Any:
        async with AsyncClient(f"{host.url}/#plain") as client, client.connect(f"{host.url}/#plain") as stream:
            views = [view async for view in stream]
        return views[-1].surface().points

    assert np.array_equal(asyncio.run(received()), HILLS[:9, :9])
    located = asyncio.run(asked(f"{host.url}/#plain", lambda it: it.locate(f"{host.url}/#plain")))
    assert located == Client(f"{host.url}/#plain").locate(f"{host.url}/#plain")


def test_info_and_pictures(tmp_path: Path, host: Ranged, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["info", f"{host.url}/#plain", "--json"]) == 0
    assert json.loads(capsys.readouterr().out)["shape"] == [9, 9]
    with ls.open(f"{host.url}/#plain") as opened:
        assert opened.source.place == Client(f"{host.url}/#plain").locate(f"{host.url}/#plain")
        assert np.array_equal(opened.window((2, 5), (3, 9)).points, HILLS[2:5, 3:9])


def test_xarray_opens_a_name_and_stays_with_its_container(tmp_path: Path, host: Ranged) -> None:
    xarray = pytest.importorskip("xarray")
    dataset = xarray.open_dataset(f"{host.url}/#{NAME}")
    (name,) = dataset.data_vars
    assert main(["publish", write(tmp_path, 2.0), str(tmp_path / "store")]) == 0
    again = pickle.loads(pickle.dumps(dataset))
    assert np.array_equal(dataset[name][10:20, 30:40], HILLS[10:20, 30:40])
    assert np.array_equal(again[name], HILLS)


def test_a_whole_read_takes_few_requests(tmp_path: Path, host: Ranged) -> None:
    with Client(f"{host.url}/#{NAME}").connect(f"{host.url}/#{NAME}") as stream:
        list(stream)
    assert len(host.requests) <= 3, "the list, the beginning, and the rest"


def test_what_is_published_is_listed(tmp_path: Path, host: Ranged, capsys: pytest.CaptureFixture[str]) -> None:
    for place in (str(tmp_path / "store"), f"{host.url}/", f"{host.url}/index.html"):
        assert main(["published", place]) == 0
        lines = capsys.readouterr().out.splitlines()
        assert [line.split("  ")[0].strip() for line in lines] == ["hills & dales", "plain"]
        assert main(["published", place, "--json"]) == 0
        assert len(json.loads(capsys.readouterr().out)["surfaces"]) == 2


def test_a_name_that_is_not_there(host: Ranged) -> None:
    with pytest.raises(NotFoundError, match="got 'dales'; there are: 'hills & dales', 'plain'"):
        Client(f"{host.url}/#dales").locate(f"{host.url}/#dales")
    with (
        pytest.raises(NotFoundError, match="dales"),
        Client(f"{host.url}/#dales").connect(f"{host.url}/#dales") as stream,
    ):
        list(stream)


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ('{"surfaces": [{"name": "plain", "src": "http://other.example/a.lode"}]}', "expected a container on"),
        ('{"surfaces": [{"name": "plain", "src": "index.html#plain"}]}', "expected a container on"),
        ('{"surfaces": [{"name": "plain", "src": 3}]}', "the surfaces of a published page"),
        ('{"surfaces": {}}', "the surfaces of a published page"),
        ("{}", "the surfaces of a published page"),
        ("no", "is this a Lodestream server"),
    ],
)
def test_a_list_that_cannot_be_followed(tmp_path: Path, host: Ranged, text: str, words: str) -> None:
    (tmp_path / "store" / "view.json").write_text(text)
    with pytest.raises(RemoteProtocolError, match=words):
        Client(f"{host.url}/#plain").locate(f"{host.url}/#plain")
    with (
        pytest.raises(RemoteProtocolError, match=words),
        Client(f"{host.url}/#plain").connect(f"{host.url}/#plain") as stream,
    ):
        list(stream)


@pytest.mark.parametrize("url", ["http://host/", "http://host/a/", "http://host/a/index.html", "http://host/#v=1"])
def test_a_page_without_a_name_is_told(url: str) -> None:
    with pytest.raises(OptionError, match="expected a name after"):
        Client(url).connect(url)


@pytest.mark.parametrize(
    ("fragment", "address"), [("s=5f1c", "v1/surfaces/5f1c"), ("n=dem&v=1", "v1/names/dem")], ids=["surface", "name"]
)
def test_the_page_of_a_server_tells_the_address_of_what_it_shows(fragment: str, address: str) -> None:
    url = f"http://host/maps/#{fragment}"
    for open_it in (Client(url).connect, ls.open):
        with pytest.raises(OptionError, match=f"the surface's is http://host/maps/{address}$"):
            open_it(url)


def test_a_page_that_is_no_published_one(tmp_path: Path, host: Ranged) -> None:
    with pytest.raises(NotFoundError):
        Client(f"{host.url}/elsewhere/#plain").locate(f"{host.url}/elsewhere/#plain")


class _Dripping(BaseHTTPRequestHandler):
    """A host whose list comes byte by byte, or leads to another host; what it was told is kept."""

    told: ClassVar[list[tuple[str, str | None]]] = []
    leads: ClassVar[str | None] = None

    def do_GET(self) -> None:
        self.told.append((str(self.server.server_port), self.headers.get("Authorization")))  # type: ignore[attr-defined]
        if self.leads is not None:
            self.send_response(302)
            self.send_header("Location", self.leads)
            self.send_header("Content-Length", "0")
            self.end_headers()
            return
        self.send_response(200)
        self.send_header("Content-Length", "100000")
        self.end_headers()
        with suppress(OSError):
            while True:
                self.wfile.write(b" ")
                time.sleep(0.05)

    def log_message(self, *_: Any) -> None:
        pass


def test_a_list_that_drips_ends_with_the_time_of_the_target() -> None:
    _Dripping.leads = None
    server = ThreadingHTTPServer(("127.0.0.1", 0), _Dripping)
    server.daemon_threads = True
    with running(server):
        url = f"http://127.0.0.1:{server.server_port}/#plain"
        with Client(url).connect(url, target=ls.Target(seconds=0.5)) as stream:
            assert list(stream) == []
        assert stream.ended == "stopped" or stream.ended == "seconds"
        with pytest.raises(SilenceError), Client(url).connect(url, silence=2.0, deadline=0) as stream:
            list(stream)


def test_a_token_is_for_the_host_of_the_page_alone(host: Ranged) -> None:
    _Dripping.told.clear()
    _Dripping.leads = f"{host.url}/view.json"
    with running(server := ThreadingHTTPServer(("127.0.0.1", 0), _Dripping)):
        page_url = f"http://127.0.0.1:{server.server_port}/#plain"
        heard: list[str | None] = []
        seen = host.RequestHandlerClass._serve  # type: ignore[attr-defined]

        def listening(handler: Any, body: bool) -> None:
            heard.append(handler.headers.get("Authorization"))
            seen(handler, body)

        with pytest.MonkeyPatch.context() as patch:
            patch.setattr(host.RequestHandlerClass, "_serve", listening)
            Client(page_url, token="secret").locate(page_url)
    assert [token for _, token in _Dripping.told] == ["Bearer secret"]
    assert heard == [None]


@pytest.mark.parametrize(
    ("url", "opened"),
    [
        ("http://host/#plain", True),
        ("http://host/a/index.html#plain", True),
        ("http://host/data.nc#mode=bytes", False),
        ("http://host/data.nc#plain", False),
        ("http://host/#v=1", False),
        ("http://host/", False),
    ],
)
def test_xarray_guesses_pages_by_their_end(url: str, opened: bool) -> None:
    pytest.importorskip("xarray")
    from lodestream_client.xarray_engine import LodeBackend

    assert LodeBackend().guess_can_open(url) == opened


@pytest.mark.parametrize(
    ("url", "expected"),
    [
        ("http://host/#s=0123&v=1", None),
        ("http://host/a%20b/#c", ("http://host/a%20b/view.json", "c")),
        ("http://host/\u00c4/#n", ("http://host/%C3%84/view.json", "n")),
        ("http://host/#a%3Db", ("http://host/view.json", "a=b")),
    ],
)
def test_the_name_in_an_address(url: str, expected: tuple[str, str] | None) -> None:
    assert published_name(url) == expected


def test_levels_are_files_that_gdal_opens(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    rasterio = pytest.importorskip("rasterio")
    surface = ls.Surface(HILLS, metadata={"geotransform": [500_000.0, 30.0, 0.0, 4_200_000.0, 0.0, -30.0]})
    (tmp_path / "hills.lode").write_bytes(ls.encode(surface))
    store = tmp_path / "store"
    with ranged(store) as server:
        given = ["publish", str(tmp_path / "hills.lode"), str(store), "--levels", "--public-url", f"{server.url}/"]
        assert main([*given, "--json"]) == 0
        report = json.loads(capsys.readouterr().out)
        assert report["page"] == f"{server.url}/index.html"
        (entry,) = report["surfaces"]
        finest = entry["levels"][-1]
        gdal = rasterio.Env(GDAL_DISABLE_READDIR_ON_OPEN="EMPTY_DIR", NO_PROXY="127.0.0.1")
        with gdal, rasterio.open(f"/vsicurl/{server.url}/{finest['src']}") as dataset:
            assert np.array_equal(dataset.read(1), HILLS)
            assert dataset.transform.c == 500_000.0
        for level in entry["levels"]:
            assert (store / level["src"]).stat().st_size == level["bytes"]
