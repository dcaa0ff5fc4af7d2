from __future__ import annotations

import argparse
from pathlib import Path

import numpy as np
import pytest

from lodestream.errors import OptionError
from lodestream_client.commands import values
from lodestream_client.requests import addresses
from lodestream_client.stream import pacing
from lodestream_client.terminal import output

from ..conftest import Run


@pytest.mark.parametrize(
    ("text", "bytes_per_second"),
    [("64kbit", 8000), ("1mbit", 125_000), ("1Mbit/s", 125_000), ("200kB", 200_000), ("1.5 KiB", 1536), ("8bit", 1)],
)
def test_rates_carry_units(text: str, bytes_per_second: float) -> None:
    assert values.parse_rate(text) == bytes_per_second


@pytest.mark.parametrize("text", ["64", "64k", "kbit", "0kbit", "-1kbit", "1lightyear", "", "1e999kbit"])
def test_other_rates_are_refused(text: str) -> None:
    with pytest.raises(argparse.ArgumentTypeError, match="expected a rate such as"):
        values.parse_rate(text)


@pytest.mark.parametrize(("text", "size"), [("1", 1), ("20000", 20_000), ("20kB", 20_000), ("1MiB", 1 << 20)])
def test_sizes(text: str, size: int) -> None:
    assert values.parse_size(text) == size


@pytest.mark.parametrize("text", ["0", "-5", "many", "10 parsecs", "inf"])
def test_other_sizes_are_refused(text: str) -> None:
    with pytest.raises(argparse.ArgumentTypeError, match="expected"):
        values.parse_size(text)


@pytest.mark.parametrize("url", ["http://host:8000", "http://host:8000/", "HTTP://host:8000/v1/surfaces/"])
def test_a_server_is_its_own_address_or_its_collection(url: str) -> None:
    assert addresses.surfaces_url(url) == "http://host:8000/v1/surfaces"


def test_a_server_may_live_under_a_path() -> None:
    assert addresses.surfaces_url("https://host/terrain") == "https://host/terrain/v1/surfaces"
    assert addresses.stream_url("https://host/terrain/v1/surfaces/ab") == "wss://host/terrain/v1/surfaces/ab/stream"


@pytest.mark.parametrize("url", ["host", "ftp://host", "http://", "http://host:port", "http://[::1"])
def test_what_is_no_address_is_refused(url: str) -> None:
    with pytest.raises(OptionError, match="expected an address"):
        addresses.surfaces_url(url)


@pytest.mark.parametrize("url", ["http://host", "http://host/v1/surfaces", "http://host/v1/surfaces/"])
def test_a_server_is_no_surface(url: str) -> None:
    with pytest.raises(OptionError, match="expected a surface's address"):
        addresses.surface_url(url)


@pytest.mark.parametrize(
    ("url", "here"),
    [("http://127.0.0.1:1", True), ("http://[::1]:1", True), ("http://localhost", True), ("http://example.org", False)],
)
def test_no_proxy_on_this_machine(url: str, here: bool) -> None:
    assert addresses.is_loopback(url) is here


def test_a_link_delays_each_message_by_its_length() -> None:
    link = pacing.Link(1000.0)
    assert link.delay(500, now=10.0) == 0.5
    assert link.delay(500, now=10.0) == 1.0
    assert link.delay(100, now=20.0) == pytest.approx(0.1)


@pytest.mark.parametrize(("rate", "window"), [(100.0, 1024), (8000.0, 2000), (125_000.0, 31_250), (1e9, 8 << 20)])
def test_the_window_follows_the_rate(rate: float, window: int) -> None:
    assert pacing.window_for(rate) == window


@pytest.mark.parametrize(
    ("seconds", "words"),
    [(0.2, "1 s left"), (59.0, "59 s left"), (61.0, "1:01 left"), (3599.0, "59:59 left"), (7500.0, "2:05 h left")],
)
def test_how_long_is_left_is_told_in_words(seconds: float, words: str) -> None:
    assert output.human_time(seconds) == words


def test_the_bar_knows_how_long_is_left(monkeypatch: pytest.MonkeyPatch) -> None:
    now = [0.0]
    bar = output._drawn()
    monkeypatch.setattr(bar, "get_time", lambda: now[0])
    for limit, expected in ((None, "8 s left"), (5.0, "3 s left")):
        now[0] = 0.0
        task = bar.add_task("pulling", total=1000, figures="", limit=limit)
        for second in (1.0, 2.0):
            now[0] = second
            bar.update(task, completed=int(100 * second))
        shown = bar.columns[-1]
        bar.tasks[-1].__dict__["_get_time"] = lambda: now[0]
        assert not isinstance(shown, str)
        assert str(shown(bar.tasks[-1])) == expected


@pytest.mark.parametrize(
    "url", ["http://host/a.lode", "http://host/v1/containers/ab.lode", "https://host/x/a.lode?key=1", "http://host/a"]
)
def test_a_file_on_any_server_can_be_pulled(url: str) -> None:
    assert addresses.source_url(url) == addresses.container_url(url) == url
    assert not addresses.is_surface(url)


def test_a_surface_can_be_pulled_too() -> None:
    url = "http://host/maps/v1/surfaces/ab"
    assert addresses.source_url(f"{url}/?x=1") == url
    assert addresses.is_surface(url)
    assert addresses.container_url(url) == f"{url}/container"
    assert addresses.same_origin(url, "http://host/other")
    assert not addresses.same_origin(url, "https://host/other")


@pytest.mark.parametrize(
    "url", ["http://host", "http://host/", "http://host/v1/surfaces", "host/a.lode", "file:///a.lode"]
)
def test_what_cannot_be_pulled(url: str) -> None:
    with pytest.raises(OptionError, match="expected"):
        addresses.source_url(url)


@pytest.mark.parametrize("command", ["encode", "convert", "push"])
def test_options_of_formats_are_named_as_the_command_line_has_them(
    command: str, run: Run, server: str, tmp_path: Path
) -> None:
    images = pytest.importorskip("PIL.Image")
    path = tmp_path / "a map, encoding=any.png"
    images.fromarray(np.zeros((20, 30, 3), np.uint8)).save(path)
    out = {"encode": tmp_path / "a.lode", "convert": tmp_path / "a.npy", "push": server}[command]
    hint = "give their meaning with -o encoding=terrain-rgb or -o encoding=terrarium"
    code, _, stderr = run(command, path, out)
    assert (code, stderr.count("-o ")) == (1, 2)
    assert hint in stderr
    assert "a map, encoding=any.png: " in stderr
    code, _, stderr = run(command, path, out, "-o", "encoding=shades")
    assert code == 1
    assert "expected -o encoding= one of grey, terrain-rgb, terrarium, got 'shades'" in stderr
