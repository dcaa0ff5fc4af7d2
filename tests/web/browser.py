"""Chromium for the tests of the page: what it is started with, what is heard of it, and what it shows."""

from __future__ import annotations

import io
import re
import shutil
import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, field
from typing import Any
from urllib.parse import urlsplit

import numpy as np
from numpy.typing import NDArray
from PIL import Image
from playwright.sync_api import Browser, BrowserContext, ConsoleMessage, Locator, Page, expect, sync_playwright

from lodestream import page as built

__all__ = ["ABOVE", "SIZE", "WAIT", "Camera", "Heard", "Tab", "chromium", "missing", "tab"]

#: Of a window whose picture is 480 pixels wide: drawing is done by the processor.
SIZE = (800, 420)

#: Milliseconds for which something is waited for; a machine may have much else to do.
WAIT = 45_000

#: Keys that show a surface from above.
ABOVE = "t"

# Drawing by the processor; and nothing is asked of the internet.
_ARGUMENTS = (
    "--no-sandbox",
    "--enable-unsafe-swiftshader",
    "--disable-background-networking",
    "--disable-component-update",
    "--disable-sync",
    "--no-first-run",
)

# Statuses as they are shown, one after the other.
_STATUSES = """
window.statuses = [];
window.beside = [];
setInterval(() => {
  const root = document.querySelector("lodestream-view")?.shadowRoot;
  const text = root?.querySelector(".status")?.textContent;
  if (text && text !== window.statuses.at(-1)) window.statuses.push(text);
  const errors = [...root?.querySelectorAll(".figures dd") ?? []].map(({ textContent }) => textContent);
  const both = [text, ...errors].join(" | ");
  if (text && both !== window.beside.at(-1)) window.beside.push(both);
}, 20);
"""

_STATE = """view => ({
  info: view.info,
  moments: view.moments.map(({number, level, bytes, rms, max, complete}) =>
    ({number, level, bytes, rms: String(rms), max: String(max), complete})),
  camera: view.camera,
})"""


def missing() -> str:
    """What these tests need and do not find; empty: nothing."""
    if not built.assets():
        return built.HOW_TO_BUILD
    return "" if shutil.which("chromium") else "There is no chromium to show the page with."


@contextmanager
def chromium() -> Iterator[Browser]:
    """A browser with a profile of its own, which ends with the block."""
    with sync_playwright() as playwright:
        browser = playwright.chromium.launch(executable_path=shutil.which("chromium"), args=list(_ARGUMENTS))
        try:
            yield browser
        finally:
            browser.close()


@dataclass(frozen=True)
class Camera:
    """Where a surface is seen from: angles in degrees, distance and target in its own coordinates."""

    azimuth: float
    elevation: float
    distance: float
    target: list[float]

    @property
    def numbers(self) -> list[float]:
        """All of it, in the order of the address."""
        return [self.azimuth, self.elevation, self.distance, *self.target]


@dataclass
class Heard:
    """What a browser reports of its pages.

    Attributes
    ----------
    errors : list of str
        Errors on the console and errors that nothing caught.
    requests : list of str
        Addresses that were asked for, those of WebSockets too.
    tokens : set of str
        Values of Authorization that were sent.
    """

    errors: list[str] = field(default_factory=list)
    requests: list[str] = field(default_factory=list)
    tokens: set[str] = field(default_factory=set)
    _allowed: list[re.Pattern[str]] = field(default_factory=list)

    def allow(self, pattern: str) -> None:
        """Take errors of this kind for what a test brings about: browsers report answers such as 401 as errors."""
        self._allowed.append(re.compile(pattern))

    def listen(self, context: BrowserContext) -> None:
        """Hear of all pages of a context."""

        def console(told: ConsoleMessage) -> None:
            if told.type == "error":
                self.errors.append(f"{told.text} {told.location}")

        context.on("console", console)
        context.on("weberror", lambda told: self.errors.append(str(told.error)))
        context.on("request", lambda request: self._ask(request.url, request.headers))
        context.on("page", lambda page: page.on("websocket", lambda socket: self._ask(socket.url, {})))

    def _ask(self, url: str, headers: Mapping[str, str]) -> None:
        self.requests.append(url)
        if "authorization" in headers:
            self.tokens.add(headers["authorization"])

    def check(self) -> None:
        """No error, and nothing from another host."""
        told = [error for error in self.errors if not any(kind.search(error) for kind in self._allowed)]
        assert told == [], told
        others = {urlsplit(url).hostname for url in self.requests if urlsplit(url).scheme not in ("blob", "data")}
        assert others <= {"127.0.0.1"}, others


class Tab:
    """A page of the browser, and the view in it."""

    def __init__(self, page: Page, heard: Heard) -> None:
        self.page = page
        self.heard = heard
        self.view = page.locator("lodestream-view")
        self.canvas = self.view.locator("canvas")
        self.status = self.view.locator(".status")
        self.notice = self.view.locator(".notice")
        self.values = self.view.locator(".values")
        self.rms, self.max = (self.view.locator(".figures dd").nth(k) for k in range(2))

    def go(self, url: str) -> Tab:
        self.page.goto(url)
        return self

    def shown(self, *statuses: str) -> None:
        """Wait until the status is one of these."""
        expect(self.status).to_have_text(re.compile("|".join(map(re.escape, statuses))), timeout=WAIT)

    def go_on_to_the_end(self) -> None:
        """Uncheck that it stops there."""
        self.until(self._goes_on)

    def _goes_on(self) -> bool:
        # By the keyboard, since a click may miss what moves as rows above it come and go; and again if the page has
        # only now given the view its surface, with which it begins anew.
        box = self.view.get_by_label("Stop when the picture looks done")
        if box.is_checked():
            box.press("Space")
        return not box.is_checked()

    def everything_is_here(self) -> None:
        """Wait until the whole surface is drawn, whether it is exact or not."""
        self.until(lambda: self._goes_on() and self.status.inner_text() in ("Complete: exact", "Complete"), 600)

    def everything(self, unit: str = "") -> None:
        """Wait for an exact surface, and until it is drawn."""
        self.until(lambda: self._goes_on() and self.status.inner_text() == "Complete: exact")
        expect(self.rms).to_have_text(f"0 {unit}".strip(), timeout=WAIT)

    @property
    def statuses(self) -> list[str]:
        """The statuses that were shown so far."""
        return list(self.page.evaluate("window.statuses"))

    @property
    def beside(self) -> list[list[str]]:
        """The statuses that were shown so far, each with RMS and maximum error as they stood beside it."""
        return [text.split(" | ") for text in self.page.evaluate("window.beside")]

    @property
    def moments(self) -> list[dict[str, Any]]:
        """What the element says of what has come, errors as numbers."""
        moments: list[dict[str, Any]] = self._state()["moments"]
        return [{**moment, "rms": float(moment["rms"]), "max": float(moment["max"])} for moment in moments]

    @property
    def camera(self) -> Camera:
        """Where the surface is seen from."""
        return Camera(**self._state()["camera"])

    def _state(self) -> dict[str, Any]:
        return dict(self.view.evaluate(_STATE))

    def until(self, true: Callable[[], object], seconds: float = WAIT / 1000) -> None:
        """Wait for something; events of the browser are heard meanwhile."""
        end = time.monotonic() + seconds
        while not true():
            assert time.monotonic() < end, f"the page shows {self.statuses}, {self.heard.errors}"
            self.page.wait_for_timeout(30)

    def press(self, *keys: str) -> None:
        """Press keys in the picture."""
        for key in keys:
            self.canvas.press(key)

    def choose(self, label: str, value: str) -> None:
        """Choose of a list."""
        self.view.get_by_label(label, exact=True).select_option(label=value)

    def picture(self) -> NDArray[np.int16]:
        """What is drawn, [row, column, red green blue], once it rests: two pictures in a row are the same.

        Its edge, which shows whether it has the focus, is white.
        """
        last = b""
        for _ in range(100):
            now = self.canvas.screenshot()
            if now == last:
                with Image.open(io.BytesIO(now)) as image:
                    picture = np.asarray(image.convert("RGB")).astype(np.int16)
                edge = np.pad(np.zeros(np.subtract(picture.shape[:2], 12), bool), 6, constant_values=True)
                picture[edge] = 255
                return picture
            last = now
            self.page.wait_for_timeout(400)
        raise AssertionError("the picture does not come to rest")

    def point(self, x: float, y: float) -> dict[str, str]:
        """The values at a place of the picture, from 0 to 1 from its left and its top."""
        self._move(x, y)
        self.until(lambda: "row" in " ".join(self._values()))
        return self.read()

    def point_at_nothing(self, x: float, y: float) -> None:
        """A place of the picture where nothing is drawn."""
        self._move(x, y)
        self.until(lambda: not self._values())
        self.page.wait_for_timeout(1000)
        assert self.read() == {}

    def _move(self, x: float, y: float) -> None:
        box = self.canvas.bounding_box()
        assert box is not None
        place = box["x"] + x * box["width"], box["y"] + y * box["height"]
        self.page.mouse.move(place[0] + 1, place[1] + 1)
        self.page.mouse.move(*place)

    def read(self) -> dict[str, str]:
        """The values that stand below the picture, once they rest."""
        last: dict[str, str] | None = None
        while last != (now := self._values()):
            last = now
            self.page.wait_for_timeout(200)
        return now

    def _values(self) -> dict[str, str]:
        found: list[list[str]] = self.values.evaluate(
            "values => [...values.children].map(({children}) => [...children].map(({textContent: t}) => t.trim()))"
        )
        values = {pair[0]: pair[1] for pair in found if len(pair) == 2}
        for name in [name for name in values if name.startswith("block ")]:
            values |= {"block": name.split()[1].rstrip(","), "row": values.pop(name)}
        return values

    def button(self, name: str) -> Locator:
        """A button of the view."""
        return self.view.get_by_role("button", name=name, exact=True)


@contextmanager
def tab(browser: Browser, heard: Heard, size: tuple[int, int] = SIZE, **options: Any) -> Iterator[Tab]:
    """A page with nothing of others: no cookies, no files. New detail is shown at once, unless told not to."""
    chosen = {"viewport": {"width": size[0], "height": size[1]}, "reduced_motion": "reduce", **options}
    context = browser.new_context(**chosen)
    context.set_default_timeout(WAIT)
    context.add_init_script(_STATUSES)
    heard.listen(context)
    try:
        yield Tab(context.new_page(), heard)
    finally:
        context.close()
