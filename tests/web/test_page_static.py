"""Containers without a server: a host of files, ten lines of HTML, `lodestream open`, and damaged files."""

from __future__ import annotations

import json
import os
import re
import shutil
import signal
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import httpx
import numpy as np
import pytest
from playwright.sync_api import expect

import lodestream as ls
from lodestream_client import Client
from lodestream_client.program import main
from tests.client.files import ranged
from tests.patience import PATIENCE
from tests.stores.emulators import BUCKET, Emulator

from .browser import Heard
from .conftest import Tabs
from .shown import Shelf, surface

WEB = Path(__file__).parents[2] / "client" / "web"
HEIGHTS = surface("terrain").points


@pytest.fixture(scope="module")
def container(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("container") / "terrain.lode"
    path.write_bytes(ls.encode(surface("terrain")))
    return path


@pytest.fixture
def host(outside: Path, container: Path) -> Path:
    """The page and a container, as `lodestream publish` writes them."""
    assert main(["publish", str(container), str(outside)]) == 0
    return outside


def test_a_host_of_files_is_enough(tabs: Tabs, host: Path) -> None:
    with ranged(host) as server:
        tab = tabs(f"{server.url}/index.html")
        tab.everything("m")
        values = tab.point(0.5, 0.55)
        height = HEIGHTS[int(values["row"]), int(values["column"])]
        assert float(values["height"].removesuffix(" m")) == pytest.approx(float(height), rel=1e-7)
        assert len(tab.moments) > 8
        assert sum(asked is not None for _, asked in server.requests) > 1


def test_of_several_containers_one_is_chosen(tabs: Tabs, host: Path) -> None:
    torus = host.parent / "a torus & more.lode"
    torus.write_bytes(ls.encode(surface("torus")))
    assert main(["publish", str(torus), str(host)]) == 0
    with ranged(host) as server:
        tab = tabs(f"{server.url}/index.html")
        tab.page.get_by_role("link", name="torus", exact=True).click()  # what the surface is called
        tab.everything()
        expect(tab.page.get_by_role("heading", name="torus")).to_be_visible()
        assert tab.page.url.partition("#")[2].startswith("a%20torus%20%26%20more")
        tab.page.go_back()
        tab.page.get_by_role("link", name="terrain", exact=True).click()
        tab.everything("m")


def test_a_name_leads_to_what_was_published_last(tabs: Tabs, host: Path) -> None:
    other = host.parent / "other.lode"
    other.write_bytes(ls.encode(surface("torus")))
    with ranged(host) as server:
        assert main(["publish", str(other), str(host), "--name", "terrain"]) == 0
        tab = tabs(f"{server.url}/index.html#terrain&l=1")
        tab.everything()
        tab.page.goto(f"{server.url}/index.html#nowhere")
        expect(tab.page.get_by_role("alert")).to_contain_text(
            "nothing is published here under the name nowhere", ignore_case=True
        )


@pytest.mark.parametrize("where", [0.02, 0.3, 0.9])
def test_a_damaged_container_is_told_and_what_came_before_is_shown(tabs: Tabs, host: Path, where: float) -> None:
    (path,) = host.glob("containers/*.lode")
    data = bytearray(path.read_bytes())
    place = int(where * len(data))
    data[place : place + 4] = bytes(byte ^ 0xFF for byte in data[place : place + 4])
    path.write_bytes(data)
    with pytest.raises(ls.LodestreamError):
        ls.decode(bytes(data))
    with ranged(host) as server:
        tab = tabs(f"{server.url}/index.html")
        tab.go_on_to_the_end()
        tab.failed()
        expect(tab.notice).not_to_be_empty()
        assert not any(moment["complete"] for moment in tab.moments)
        if where > 0.5:
            tab.until(lambda: bool(tab.moments))  # they wait for the description, for three seconds at most
            assert all(moment["bytes"] <= place for moment in tab.moments)
            expect(tab.rms).to_have_text(re.compile(" m$"))
            assert tab.point(0.5, 0.55)["row"]


@pytest.mark.parametrize("tags", [False, True], ids=["no tags", "tags"])
def test_a_container_cut_short_is_told_and_begun_anew_when_it_is_whole(tabs: Tabs, host: Path, tags: bool) -> None:
    (path,) = host.glob("containers/*.lode")
    whole = path.read_bytes()
    path.write_bytes(whole[:-5000])
    with ranged(host) as server:
        server.tags = tags
        tab = tabs(f"{server.url}/index.html")
        tab.go_on_to_the_end()
        tab.failed()
        expect(tab.notice).to_contain_text("the file was cut short")
        expect(tab.notice).to_contain_text(str(len(whole) - 5000))
        assert not any(moment["complete"] for moment in tab.moments)
        tab.choose("Colour map", "cividis")
        tab.try_again()
        tab.failed()
        expect(tab.notice).to_contain_text("the file was cut short")
        path.write_bytes(whole)
        tab.try_again()
        tab.shown("Complete: exact")
        expect(tab.notice).to_be_empty()
        expect(tab.rms).to_have_text("0 m")
        assert tab.view.get_by_label("Colour map").input_value() == "cividis"
        assert not tab.view.get_by_label("Stop when the picture looks done").is_checked()


def test_what_is_chosen_before_the_surface_is_known_holds_for_its_first_picture(tabs: Tabs, host: Path) -> None:
    (path,) = host.glob("containers/*.lode")
    whole = path.read_bytes()
    path.write_bytes(whole[:10])
    with ranged(host) as server:
        tab = tabs(f"{server.url}/index.html")
        tab.failed()
        tab.choose("Colour map", "cividis")
        tab.view.get_by_label("Quad lines").check()
        tab.try_again()
        tab.failed()
        path.write_bytes(whole)
        tab.try_again()
        tab.everything("m")
        assert tab.view.get_by_label("Colour map").input_value() == "cividis"
        assert tab.view.get_by_label("Quad lines").is_checked()


def test_ten_lines_of_html_show_a_container(tabs: Tabs, outside: Path, library: Path, container: Path) -> None:
    example = WEB / "examples" / "static.html"
    assert len(example.read_text().splitlines()) <= 10
    for path in (example, *library.glob("*.js"), *(WEB / "node_modules/three/build").glob("three.*.js")):
        shutil.copy(path, outside)
    shutil.copy(container, outside / "surface.lode")
    icon = outside / "favicon.ico"  # which browsers ask every host for
    icon.write_bytes(b"")
    with ranged(outside) as server:
        tab = tabs(f"{server.url}/static.html")
        tab.everything("m")
        values = tab.point(0.5, 0.55)
        height = HEIGHTS[int(values["row"]), int(values["column"])]
        assert float(values["height"].removesuffix(" m")) == pytest.approx(float(height), rel=1e-7)
        tab.press("ArrowLeft")
        tab.until(lambda: "#v=" in tab.page.url)


def test_a_page_of_another_origin_shows_what_a_bucket_has(
    tabs: Tabs, outside: Path, library: Path, container: Path, s3: Emulator, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["publish", str(container), s3.address(), "--name", "hills & dales", "--json"]) == 0
    report = json.loads(capsys.readouterr().out)
    allow(report["page"].partition(f"/{BUCKET}/")[0] + f"/{BUCKET}", report["cors"])
    (surface,) = report["surfaces"]
    example = (WEB / "examples" / "static.html").read_text()
    (outside / "index.html").write_text(example.replace("./surface.lode", surface["page"]))
    (outside / "favicon.ico").write_bytes(b"")
    for path in (*library.glob("*.js"), *(WEB / "node_modules/three/build").glob("three.*.js")):
        shutil.copy(path, outside)
    with ranged(outside) as server:
        tab = tabs(f"{server.url}/index.html")
        tab.everything("m")
        assert all(asked is None for _, asked in server.requests), "the surface came from the bucket"


def allow(bucket: str, command: str) -> None:
    """Set the rule that `publish` prints, as `aws s3api put-bucket-cors` does."""
    (rule,) = json.loads(command.partition("'")[2].rstrip("'"))["CORSRules"]
    names = {"AllowedOrigins": "AllowedOrigin", "AllowedMethods": "AllowedMethod", "AllowedHeaders": "AllowedHeader"}
    names["ExposeHeaders"] = "ExposeHeader"
    inner = "".join(f"<{tag}>{value}</{tag}>" for name, tag in names.items() for value in rule[name])
    inner += f"<MaxAgeSeconds>{rule['MaxAgeSeconds']}</MaxAgeSeconds>"
    body = f"<CORSConfiguration><CORSRule>{inner}</CORSRule></CORSConfiguration>"
    assert httpx.put(f"{bucket}?cors", content=body, trust_env=False).status_code == 200


@contextmanager
def viewing(*arguments: object, **environment: str) -> Iterator[tuple[str, subprocess.Popen[str]]]:
    """`lodestream open`, and the address that it prints."""
    command = [sys.executable, "-m", "lodestream_client", "open", "--no-browser", *map(str, arguments)]
    paths = os.pathsep.join(filter(None, sys.path))
    process = subprocess.Popen(
        command, stdout=subprocess.PIPE, text=True, env={**os.environ, "PYTHONPATH": paths, **environment}
    )
    try:
        assert process.stdout is not None
        with process.stdout:
            yield process.stdout.readline().strip(), process
    finally:
        process.kill()
        process.wait()


@pytest.mark.usefixtures("interrupts")
def test_view_encodes_a_file_and_shows_it(tabs: Tabs, tmp_path: Path) -> None:
    np.save(tmp_path / "hills.npy", HEIGHTS)
    with viewing(tmp_path / "hills.npy", "--name", "my hills") as (url, process):
        assert url.startswith("http://127.0.0.1:")
        tab = tabs(url)
        tab.everything()
        expect(tab.page.get_by_role("heading", name="my hills")).to_be_visible()
        values = tab.point(0.5, 0.55)
        height = HEIGHTS[int(values["row"]), int(values["column"])]
        assert float(values["height"]) == pytest.approx(float(height), rel=1e-7)
        process.send_signal(signal.SIGINT)
        assert process.wait(PATIENCE) == 0


@pytest.mark.usefixtures("interrupts")
def test_view_keeps_a_token_to_itself(tabs: Tabs, closed: tuple[str, str], heard: Heard) -> None:
    server, token = closed
    url = Client(server, token=token).upload(surface("torus")).url
    with viewing(url, LODESTREAM_TOKEN=token) as (address, _):
        tab = tabs(address)
        tab.everything()
        assert all(asked.startswith((address, f"blob:{address[: address.index('/', 8)]}")) for asked in heard.requests)
        assert heard.tokens == set()
        assert token not in tab.page.content()


def test_view_passes_on_a_surface_of_a_server(tabs: Tabs, shelf: Shelf, heard: Heard) -> None:
    with viewing(shelf.description("holes").url) as (address, _):
        tab = tabs(address)
        tab.everything("m")
        assert not [asked for asked in heard.requests if asked.startswith(shelf.server)]
