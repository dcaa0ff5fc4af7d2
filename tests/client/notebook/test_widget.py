"""The kernel's side of a widget, with a comm that keeps what is sent."""

from __future__ import annotations

import asyncio
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import lodestream as ls
from lodestream import page
from lodestream.errors import InputError, NotFoundError, OptionError, StreamError, UnavailableError
from lodestream.opening.byte_sources import FileSource
from tests.core.remesh import scenes

from .conftest import Page

pytestmark = pytest.mark.usefixtures("built", "fake_page")


def widget(*given: Any, **options: Any) -> Any:
    from lodestream_client import Widget

    return Widget(*given, **options)


def read(page: Page, shown: Any, offset: int, length: int) -> bytes:
    page.ask(shown, {"kind": "read", "id": "1:1", "offset": offset, "length": length})
    content, buffers = page.custom[-1]
    assert (content["kind"], content["id"]) == ("part", "1:1")
    return buffers[0]


def whole(page: Page, shown: Any) -> bytes:
    data = read(page, shown, 0, 4096)
    while len(data) < page.custom[-1][0]["size"]:
        data += read(page, shown, len(data), 4096)
    return data


def test_a_surface_is_encoded_and_comes_over_the_comm(terrain: ls.Surface, fake_page: Page) -> None:
    shown = widget(terrain)
    assert np.array_equal(ls.decode(whole(fake_page, shown)).points, terrain.points)
    assert shown.name == "hills"
    assert shown.fields == ["height", "slope", "change", "none", "rain", "wind", "wind[0]", "wind[1]"]
    assert repr(shown) == "<Widget 'hills': connecting, 0 bytes>"


def test_a_container_is_sent_as_it_is(container: bytes, tmp_path: Path, fake_page: Page) -> None:
    path = tmp_path / "hills of mine.lode"
    path.write_bytes(container)
    for source, name in (
        (container, ""),
        (bytearray(container), ""),
        (path, "hills of mine"),
        (str(path), "hills of mine"),
    ):
        shown = widget(source)
        assert whole(fake_page, shown) == container
        assert shown.name == name
        assert shown.bytes_sent == len(container)
    assert widget(path, name="another").name == "another"


def test_other_files_and_arrays_are_encoded(tmp_path: Path, fake_page: Page) -> None:
    heights = np.add.outer(np.arange(40) ** 2, np.arange(30)) * 0.25
    np.save(tmp_path / "heights.npy", heights)
    for source, name in ((heights, ""), (tmp_path / "heights.npy", "heights")):
        shown = widget(source)
        assert np.array_equal(ls.decode(whole(fake_page, shown)).points, heights)
        assert shown.name == name
    close = widget(heights, quality=ls.Quality.of(precision=1.0))
    assert np.abs(ls.decode(whole(fake_page, close)).points - heights).max() <= 1


def test_a_mesh_that_was_resampled_is_shown_with_what_was_measured(fake_page: Page) -> None:
    pytest.importorskip("igl")
    surface = ls.Surface.from_mesh(*scenes.sphere(), remesh=True, blocks=12, remesh_error=1e-2)
    decoded = ls.decode(whole(fake_page, widget(surface, name="ball")))
    for block, original in zip(decoded.blocks, surface.blocks, strict=True):
        np.testing.assert_array_equal(block.points, original.points)
    assert decoded.metadata["remesh"] == surface.metadata["remesh"]


def test_a_served_surface_is_read_by_the_kernel(server: str, terrain: ls.Surface, fake_page: Page) -> None:
    from lodestream_client import Client

    url = Client(server).upload(terrain).url
    shown = widget(url)
    assert np.array_equal(ls.decode(whole(fake_page, shown)).points, terrain.points)

    async def in_a_loop() -> None:
        before = len(fake_page.custom)
        fake_page.ask(shown, {"kind": "read", "id": "1:1", "offset": 0, "length": 64})
        assert len(fake_page.custom) == before  # the kernel goes on meanwhile
        while len(fake_page.custom) == before:
            await asyncio.sleep(0.01)
        assert fake_page.custom[-1][1][0] == read_here[:64]

    read_here = whole(fake_page, shown)
    asyncio.run(in_a_loop())
    shown.close()
    with pytest.raises(NotFoundError):
        widget(url + "x")


def test_closing_ends_what_is_under_way(server: str, terrain: ls.Surface, fake_page: Page) -> None:
    from lodestream_client import Client

    shown = widget(Client(server).upload(terrain).url)

    async def closed_meanwhile() -> None:
        fake_page.ask(shown, {"kind": "read", "id": "1:1", "offset": 0, "length": 64})
        shown.close()
        await asyncio.sleep(0.3)

    asyncio.run(closed_meanwhile())
    assert fake_page.custom == []
    assert fake_page.heard[-1][0] == {"method": "close"}
    shown.close()  # a second time


@pytest.mark.parametrize(
    ("source", "error", "words"),
    [
        (
            3,
            InputError,
            "expected a Surface, an array of points, a container as bytes, the path of a file or a URL, got int",
        ),
        (None, InputError, "got NoneType"),
        (b"PK\3\4 and so on", StreamError, "expected"),
        ("no such file.lode", FileNotFoundError, "no such file"),
    ],
)
def test_what_cannot_be_shown_is_refused(source: Any, error: type[Exception], words: str) -> None:
    with pytest.raises(error, match=words):
        widget(source)


def test_a_container_that_is_cut_short_is_refused(container: bytes) -> None:
    with pytest.raises(StreamError, match="ends with a footer"):
        widget(container[:-100])


def test_a_view_is_refused_with_what_to_give(container: bytes) -> None:
    decoder = ls.Decoder()
    view = decoder.feed(container)[-1]
    with pytest.raises(InputError, match=r"got View; a view has surface\(\)"):
        widget(view)
    assert widget(view.surface()).fields[:1] == ["height"]


@pytest.mark.parametrize(
    ("options", "words"),
    [
        ({"field": "snow"}, "expected a field among height, slope, change, none, rain, wind, .* got 'snow'"),
        ({"colour_map": "jet"}, "expected colour_map among viridis"),
        ({"theme": "blue"}, "expected theme among auto, light, dark, got 'blue'"),
        ({"value_range": (3, 3)}, "two rising numbers"),
        ({"exaggeration": 0}, "expected an exaggeration of 0.1 to 100"),
        ({"height": -3}, "expected a height in pixels"),
        ({"colour": "red"}, "expected options among .* got colour"),
        ({"token": "lode_x"}, "expected a URL, to whose server the token belongs"),
        ({"quality": ls.Quality()}, "which is shown as it is"),
        ({"target": 0.5}, "expected a lodestream.Target or None, got float"),
        ({"target": ls.Target(level=99)}, "expected a level of 0 to"),
        ({"target": ls.Target(seconds=3)}, "expected a target of one limit"),
        ({"target": ls.Target(region=((0, 9), (0, 9)))}, "expected a target of one limit"),
        ({"target": ls.Target(max_bytes=9, until_rms=ls.Tolerance(1))}, "expected a target of one limit"),
    ],
)
def test_wrong_options_are_refused(container: bytes, options: dict[str, Any], words: str) -> None:
    with pytest.raises(OptionError, match=words):
        widget(container, **options)


def test_values_go_both_ways(container: bytes, fake_page: Page) -> None:
    shown = widget(container, field="rain", height=300, value_range=(0, 2))
    state = fake_page.opening
    assert (state["field"], state["height"], state["value_range"]) == ("rain", "300px", (0.0, 2.0))
    fake_page.set(shown, field="wind[1]", value_range=[1, 5], state="receiving", rms=0.5, region=[[0, 9], [3, 8]])
    assert (shown.field, shown.value_range, shown.state, shown.rms) == ("wind[1]", (1.0, 5.0), "receiving", 0.5)
    assert shown.region == [[0, 9], [3, 8]]
    shown.colour_map = "grey"
    assert fake_page.heard[-1][0] == {"method": "update", "state": {"colour_map": "grey"}, "buffer_paths": []}


def test_a_target_is_sent_in_the_unit_of_the_surface(container: bytes, terrain: ls.Surface, fake_page: Page) -> None:
    shown = widget(container, target=ls.Target(until_rms=ls.Tolerance.of("0.1%")))
    extent = float(np.ptp(terrain.points))
    assert fake_page.opening["_target"] == {"rms": pytest.approx(extent / 1000)}
    for target, sent in (
        (ls.Target(until_max=ls.Tolerance(0.5)), {"max": 0.5}),
        (ls.Target(max_bytes=7000), {"bytes": 7000}),
        (ls.Target(level=1), {"level": 1}),
        (None, {}),
    ):
        shown.target = target
        assert fake_page.heard[-1][0]["state"] == {"_target": sent}
        assert shown.target == target
    with pytest.raises(OptionError, match="one limit"):
        shown.target = ls.Target(order="level")
    assert shown.target is None


def test_the_program_goes_over_the_comm_and_not_with_each_widget(container: bytes, fake_page: Page) -> None:
    shown = widget(container)
    state = fake_page.opening
    assert (state["_esm"], state["_program"]) == ("export default {}", "view-0a.js")
    fake_page.ask(shown, {"kind": "program", "id": "2:1"})
    assert fake_page.custom == [({"kind": "program", "id": "2:1"}, [b"element"])]


def test_several_places_and_widgets_are_answered_each_by_itself(container: bytes, fake_page: Page) -> None:
    one, other = widget(container), widget(container)
    for number, shown in enumerate((one, other, one)):
        fake_page.ask(shown, {"kind": "read", "id": f"{number}", "offset": number, "length": 5})
    assert [(content["id"], buffers) for content, buffers in fake_page.custom] == [
        (str(number), [container[number : number + 5]]) for number in range(3)
    ]
    assert (one.bytes_sent, other.bytes_sent) == (10, 5)
    one.close()
    assert read(fake_page, other, 0, 9) == container[:9]


def test_stop_and_resume_are_told_to_the_page(container: bytes, fake_page: Page) -> None:
    shown = widget(container)
    shown.stop()
    shown.resume()
    assert [content for content, _ in fake_page.custom] == [
        {"kind": "command", "command": "stop"},
        {"kind": "command", "command": "resume"},
    ]


def test_without_the_page_it_says_how_to_build_it(
    container: bytes, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    monkeypatch.setattr(page, "widget_modules", lambda: None)
    with pytest.raises(UnavailableError, match="make page builds it"):
        widget(container)
    with pytest.raises(FileNotFoundError):
        widget(tmp_path / "none.lode")


def test_what_is_refused_is_closed_again(
    container: bytes, monkeypatch: pytest.MonkeyPatch, server: str, terrain: ls.Surface
) -> None:
    from lodestream_client import Client
    from lodestream_client.remote_source import RemoteSource

    closed: list[RemoteSource] = []
    close = RemoteSource.close

    def noted(self: RemoteSource) -> None:
        closed.append(self)
        close(self)

    monkeypatch.setattr(RemoteSource, "close", noted)
    url = Client(server).upload(terrain).url
    with pytest.raises(OptionError):
        widget(url, field="snow")
    assert len(closed) == 1


def test_a_file_is_not_kept_in_memory(container: bytes, tmp_path: Path) -> None:
    path = tmp_path / "a.lode"
    path.write_bytes(container)
    assert isinstance(widget(path)._shown.source, FileSource)
