"""A surface comes into focus: its error falls to what the server promised, it stops, and it goes on after a loss."""

from __future__ import annotations

import base64
import re
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any
from urllib.parse import parse_qs, urlsplit

import httpx
import msgpack
import numpy as np
import pytest
from playwright.sync_api import Route, expect

from tests.links import Fault, Link, linked

from .browser import ABOVE, Tab
from .conftest import Tabs
from .shown import Shelf, surface

TERRAIN = surface("terrain")
HEIGHTS = TERRAIN.points[..., 0] if TERRAIN.points.ndim == 3 else TERRAIN.points

#: Bytes of the terrain, which has 120,770, after which a link holds it; other answers of the server are shorter.
HELD = 20_000


class Frames:
    """The messages of all WebSockets of a page."""

    def __init__(self, tab: Tab) -> None:
        self.credit = self.data = self.open = 0
        self.stops: list[tuple[int, int]] = []
        tab.page.on("websocket", self._listen)

    def _listen(self, socket: Any) -> None:
        # What a connection was given before counts no more, nor what has come of it.
        first = parse_qs(urlsplit(socket.url).query)["open"][0]
        self.credit = msgpack.unpackb(base64.urlsafe_b64decode(first + "=="))["credit"]
        self.data = 0
        self.open += 1
        socket.on("framesent", self._sent)
        socket.on("framereceived", self._received)
        socket.on("close", self._closed)

    def _sent(self, frame: bytes) -> None:
        message = msgpack.unpackb(frame)
        if message["type"] == "open":
            self.credit = self.data + message["credit"]
        elif message["type"] == "credit":
            self.credit += message["bytes"]
        elif message["type"] == "stop":
            self.stops.append((self.credit, self.data))

    def _received(self, frame: bytes) -> None:
        message = msgpack.unpackb(frame)
        if message["type"] == "segments":
            self.data += len(message["data"])

    def _closed(self, _: Any) -> None:
        self.open -= 1


class Weather:
    """What is wrong with connections of a link from now on: the page itself comes over good ones."""

    link: Link

    def __init__(self) -> None:
        self.connections = 0
        self._faults: list[Fault] = []

    def __call__(self, _: int) -> Fault:
        self.connections += 1
        if len(self._faults) > 1:
            return self._faults.pop(0)
        return self._faults[0] if self._faults else Fault()

    def now(self, *faults: Fault) -> None:
        """One for each connection in turn; the last holds for all after it."""
        self.connections = 0
        self._faults = list(faults)


def receiving(tab: Tab, since: int = 0) -> bool:
    """Whether it has been shown what has come while more was to come, see `Tab.beside`."""
    return any(status == "Receiving" and rms.endswith(" m") and rms != "0 m" for status, rms, _ in tab.beside[since:])


@contextmanager
def over_a_link(
    tabs: Tabs, shelf: Shelf, *faults: Fault, watch: Callable[[Tab], None] = lambda _: None
) -> Iterator[tuple[Tab, Weather]]:
    """The terrain, over connections with these faults."""
    shelf.description("terrain")
    weather = Weather()
    with linked(shelf.server, weather) as weather.link:
        tab = tabs(weather.link.url)
        listed = tab.page.get_by_role("link", name="terrain", exact=True)
        listed.wait_for()
        watch(tab)
        weather.now(*faults)
        tab.page.goto(shelf.address("terrain", server=weather.link.url))
        yield tab, weather


def test_the_error_on_the_screen_falls_to_what_the_server_promised(tabs: Tabs, shelf: Shelf) -> None:
    tab = tabs(shelf.address("terrain"))
    prices = httpx.get(shelf.description("terrain").url, trust_env=False).json()["layers"]
    seen = []
    tab.go_on_to_the_end()

    def exact() -> bool:
        seen.append((tab.rms.inner_text(), tab.max.inner_text()))
        return seen[-1] == ("0 m", "0 m")

    tab.until(exact)
    tab.shown("Complete: exact")
    promised = {price["bytes"]: (price["rms"], price["max"]) for price in prices}
    moments = tab.moments
    told = {moment["bytes"]: (moment["rms"], moment["max"]) for moment in moments}
    assert {size: told[size] for size in promised} == promised
    assert len(moments) > 8
    assert moments[-1]["complete"]
    for figures in zip(*seen, strict=True):
        known = [float(figure.removesuffix(" m")) for figure in figures if figure[0].isdigit()]
        assert known == sorted(known, reverse=True)
    for x, y in ((0.5, 0.5), (0.35, 0.55), (0.65, 0.6)):
        values = tab.point(x, y)
        assert values["error at most"] == "0: exact"
        value = HEIGHTS[int(values["row"]), int(values["column"])]
        assert float(values["height"].removesuffix(" m")) == pytest.approx(float(value), rel=1e-7)


def test_a_description_that_comes_late_is_shown(tabs: Tabs, shelf: Shelf) -> None:
    tab = tabs(shelf.server)
    held: list[Route] = []
    described = shelf.description("terrain").url
    tab.page.get_by_role("heading", name="Surfaces").wait_for()
    tab.page.route(described, lambda route: held.append(route))
    tab.page.evaluate(
        """(src) => {
          const view = document.createElement("lodestream-view");
          view.src = src;
          document.querySelector("main").replaceChildren(view);
        }""",
        described,
    )
    tab.everything()
    (route,) = held
    tab.choose("Colour map", "cividis")
    tab.press("ArrowLeft")
    route.continue_()
    expect(tab.rms).to_have_text("0 m")
    assert tab.view.get_by_label("Colour map").input_value() == "cividis"


def test_a_slow_link_can_be_seen_once_everything_has_come(tabs: Tabs, shelf: Shelf) -> None:
    tab = tabs(shelf.address("terrain"))
    tab.everything("m")
    before = len(tab.beside)
    tab.choose("Link", "56 kbit/s")
    tab.until(lambda: receiving(tab, before))
    tab.until(lambda: "b=7000" in tab.page.url)
    again = tabs(tab.page.url)
    again.until(lambda: receiving(again))
    assert again.view.get_by_label("Link", exact=True).input_value() == "7000"
    again.choose("Link", "As it comes")
    again.shown("Complete: exact", "The picture looks done (estimate)")
    again.until(lambda: "b=" not in again.page.url)


def test_going_back_claims_nothing_that_is_not_drawn(tabs: Tabs, shelf: Shelf) -> None:
    tab = tabs(shelf.address("terrain"))
    tab.everything("m")
    slider = tab.view.locator("#moment")
    seen = tab.page.evaluate(
        """() => {
          const root = document.querySelector("lodestream-view").shadowRoot;
          const slider = root.querySelector("#moment");
          const seen = [];
          const look = () => {
            seen.push([
              root.querySelector(".status").textContent,
              root.querySelector(".figures dd").textContent,
              root.querySelector("output[for=moment]").textContent,
              slider.getAttribute("aria-valuetext"),
            ]);
          };
          slider.value = "0";
          slider.dispatchEvent(new Event("input"));
          return new Promise((resolve) => {
            let more = 30; // frames after it is drawn
            const next = () => {
              look();
              if (seen.at(-1)[0] === "Earlier moment") more -= 1;
              if (more > 0) requestAnimationFrame(next);
              else resolve(seen);
            };
            requestAnimationFrame(() => requestAnimationFrame(next));
          });
        }"""
    )
    assert seen[-1][0] == "Earlier moment"
    assert seen[-1][1] != "0 m"
    assert slider.input_value() == "0"
    for status, rms, label, spoken in seen:
        assert spoken.startswith(label + " after ")
        assert (status == "Earlier moment") == (rms != "0 m"), (status, rms)
        assert status in ("Drawing the moment chosen", "Earlier moment")


def test_status_and_errors_are_of_one_moment_while_detail_is_blended_in(tabs: Tabs, shelf: Shelf) -> None:
    tab = tabs(shelf.address("terrain"), reduced_motion="no-preference")
    tab.everything("m")
    assert tab.beside[-1] == ["Complete: exact", "0 m", "0 m"]
    for status, rms, largest in tab.beside:
        # Without a unit while the description is late.
        assert (status == "Complete: exact") == ({rms, largest} <= {"0", "0 m"}), tab.beside


def test_a_target_may_be_the_error_of_an_attribute(tabs: Tabs, shelf: Shelf) -> None:
    tab = tabs(shelf.address("attribute"))
    tab.shown("The picture looks done (estimate)", "Complete: exact")
    tab.go_on_to_the_end()
    row = tab.view.get_by_label("Error of", exact=True)
    assert not row.is_visible()
    tab.choose("Target", "RMS error")
    tab.choose("Error of", "temperature")
    tab.view.get_by_label("Target value").fill("100")
    tab.view.get_by_label("Target value").press("Enter")
    tab.shown("Target met", "Complete: exact")
    tab.choose("Target", "Kilobytes")
    assert not row.is_visible()


def test_a_target_is_met_and_the_values_are_within_its_error(tabs: Tabs, shelf: Shelf) -> None:
    frames: list[Frames] = []
    slow = Fault(rate=5_000.0, hold_down=HELD)
    with over_a_link(tabs, shelf, slow, watch=lambda tab: frames.append(Frames(tab))) as (tab, weather):
        tab.go_on_to_the_end()
        tab.until(lambda: tab.moments)
        tab.choose("Target", "RMS error")
        tab.view.get_by_label("Target value").fill("0.005")
        tab.view.get_by_label("Target value").press("Enter")
        (messages,) = frames
        tab.until(lambda: messages.stops)
        weather.link.release()
        # The error that was proposed may have been met before.
        tab.until(lambda: tab.moments[-1]["rms"] <= 0.005 and tab.status.inner_text() == "Target met")
        reached = tab.moments[-1]
        assert reached["rms"] > 0.0005
        tab.until(lambda: tab.rms.inner_text()[0].isdigit() and float(tab.rms.inner_text().split()[0]) <= 0.005)
        errors = []
        for x in np.linspace(0.3, 0.7, 5):
            values = tab.point(float(x), 0.55)
            value = HEIGHTS[int(values["row"]), int(values["column"])]
            errors.append(abs(float(values["height"].removesuffix(" m")) - float(value)))
        # The panel gives as many digits as the error leaves.
        assert max(errors) <= reached["max"] * 1.1
        assert any(errors)


def test_the_slider_goes_back_to_earlier_moments(tabs: Tabs, shelf: Shelf) -> None:
    tab = tabs(shelf.address("terrain"))
    tab.everything("m")
    tab.press(ABOVE)  # a camera that somebody has placed does not follow the bounds of earlier moments
    last = tab.picture()
    first = tab.moments[0]
    for _ in range(len(tab.moments)):
        tab.press("[")
    tab.until(lambda: tab.rms.inner_text() != "0 m")
    tab.until(lambda: float(tab.rms.inner_text().split()[0]) == pytest.approx(first["rms"], rel=0.01))
    assert np.abs(tab.picture() - last).mean() > 2
    # What is said belongs to what is drawn.
    assert tab.status.inner_text() == "Earlier moment"
    tab.press("End")
    tab.shown("Complete: exact")
    expect(tab.rms).to_have_text("0 m")
    assert np.abs(tab.picture() - last).mean() < 0.1


def test_after_stop_no_more_comes_than_the_credit(tabs: Tabs, shelf: Shelf) -> None:
    frames: list[Frames] = []
    slow = Fault(delay=0.05, rate=5_000.0, hold_down=HELD)
    with over_a_link(tabs, shelf, slow, watch=lambda tab: frames.append(Frames(tab))) as (tab, weather):
        tab.go_on_to_the_end()
        (messages,) = frames
        tab.until(lambda: messages.data > 10_000)
        tab.button("Stop").click()
        tab.until(lambda: messages.stops)
        weather.link.release()
        tab.shown("Stopped")
        tab.until(lambda: messages.open == 0)
        weather.now(Fault())
        credit, before = messages.stops[-1]  # before the box was unchecked the picture may have looked done
        ended = messages.data
        assert 0 < credit - before <= 262_144
        assert ended - before <= credit - before
        size = int(shelf.description("terrain").details["bytes"])
        assert ended < size
        held = tab.moments[-1]["bytes"]
        tab.button("Continue").click()
        tab.shown("Complete: exact")
        # What was there is not sent again.
        assert held + messages.data <= size + 10_000
        assert messages.data < size


def test_stop_and_on_by_one_key(tabs: Tabs, shelf: Shelf) -> None:
    frames: list[Frames] = []
    held = Fault(rate=5_000.0, hold_down=HELD)
    with over_a_link(tabs, shelf, held, watch=lambda tab: frames.append(Frames(tab))) as (tab, weather):
        tab.go_on_to_the_end()
        tab.until(lambda: tab.moments)
        tab.press("s")
        (messages,) = frames
        tab.until(lambda: messages.stops)
        weather.link.release()
        tab.shown("Stopped")
        stopped = tab.moments[-1]
        assert not stopped["complete"]
        tab.press("s")
        tab.shown("Complete: exact")
        assert tab.moments[-1]["bytes"] > stopped["bytes"]


def test_a_stop_before_anything_is_drawn_holds(tabs: Tabs, shelf: Shelf) -> None:
    tab = tabs(shelf.server)
    tab.page.get_by_role("heading", name="Surfaces").wait_for()
    tab.page.evaluate(
        """(src) => {
          const view = document.createElement("lodestream-view");
          view.src = src;
          document.querySelector("main").replaceChildren(view);
          view.shadowRoot.querySelector("button.primary").click();
        }""",
        shelf.description("terrain").url,
    )
    tab.shown("Stopped")
    assert tab.moments == []
    tab.button("Continue").press("Enter")
    tab.everything("m")


def test_a_lost_link_is_told_and_the_surface_goes_on(tabs: Tabs, shelf: Shelf, heard: Any) -> None:
    heard.allow("WebSocket connection to .* failed")
    size = int(shelf.description("terrain").details["bytes"])
    held = Fault(hold_down=2 * HELD)
    with over_a_link(tabs, shelf, Fault(cut_down=20_000, reset=True, rate=10_000.0), held) as (tab, weather):
        before = weather.link.down
        tab.go_on_to_the_end()
        tab.until(lambda: tab.moments and tab.moments[-1]["bytes"] > 20_000)
        # Connections of HTTP that were kept break too: by them the rest could come before anybody sees that it is lost.
        weather.now(Fault(cut_down=300, reset=True))
        weather.link.cut()
        tab.shown("Link lost: resuming")
        tab.until(lambda: weather.connections >= 3)
        weather.now(Fault())
        tab.everything("m")
        assert tab.statuses[-1] == "Complete: exact"
        numbers = [moment["number"] for moment in tab.moments]
        assert numbers == list(range(len(numbers)))
        # Once more at most than what a client has: one window of each broken connection.
        assert weather.link.down - before < 1.6 * size + 900_000


def test_a_link_without_a_word_is_told(tabs: Tabs, shelf: Shelf) -> None:
    with over_a_link(tabs, shelf, Fault(cut_down=30_000, vanish=True)) as (tab, _):
        tab.go_on_to_the_end()
        tab.until(lambda: tab.rms.inner_text().endswith(" m"))
        tab.until(lambda: any(status.startswith("Waiting: no data for") for status in tab.statuses))
        assert tab.moments


# At once, since what was in flight may be drawn after the stop, and it may go on by itself.
_GET_THE_REST = """view => {
  const [status, button, box] = [".status", "button.primary", "#below"].map((of) => view.shadowRoot.querySelector(of));
  const look = () => {
    if (button.textContent !== "Get the rest" || !status.textContent.startsWith("The picture looks done")) return;
    watcher.disconnect();
    const { number, complete } = view.moments.at(-1);
    const said = status.textContent;
    button.click();
    window.paused = { number, complete, said, checked: box.checked };
  };
  const watcher = new MutationObserver(look);
  watcher.observe(view.shadowRoot, { childList: true, characterData: true, subtree: true });
  look();
}"""


def test_it_stops_when_the_picture_looks_done_and_gets_the_rest_when_that_is_wanted(tabs: Tabs, shelf: Shelf) -> None:
    with over_a_link(tabs, shelf, Fault(rate=2_000.0, hold_down=HELD)) as (tab, weather):
        tab.view.evaluate(_GET_THE_REST)
        weather.link.release()
        tab.until(lambda: tab.page.evaluate("window.paused"))
        paused = tab.page.evaluate("window.paused")
        assert re.fullmatch(r"The picture looks done \(estimate\): \S+ k?B of \S+ k?B", paused["said"])
        assert not paused["complete"]
        assert not paused["checked"]
        tab.until(lambda: tab.moments[-1]["number"] > paused["number"] + 1)
        assert not tab.view.get_by_label("Stop when the picture looks done").is_checked()
        tab.shown("Receiving", "Complete: exact")
