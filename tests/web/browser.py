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
from tests.patience import PATIENCE

__all__ = ["ABOVE", "SIZE", "WAIT", "Camera", "Heard", "Tab", "chromium", "goes_on", "missing", "tab", "until"]

#: Of a window whose picture is 480 pixels wide: drawing is done by the processor.
SIZE = (800, 420)

#: Milliseconds for which something is waited for.
WAIT = round(1000 * PATIENCE)
expect.set_options(timeout=WAIT)

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

# Statuses as they are shown, one after the other, and states as the element tells them; where the pointer is.
_STATUSES = """
window.statuses = [];
window.beside = [];
window.states = [];
{
  const note = (list, text) => {
    if (text && text !== list.at(-1)) list.push(text);
  };
  const attach = Element.prototype.attachShadow;
  Element.prototype.attachShadow = function (options) {
    const root = attach.call(this, options);
    const look = () => {
      const text = root.querySelector(".status")?.textContent;
      const errors = [...root.querySelectorAll(".figures dd")].map(({ textContent }) => textContent);
      note(window.statuses, text);
      if (text) note(window.beside, [text, ...errors].join(" | "));
    };
    new MutationObserver(look).observe(root, { childList: true, characterData: true, subtree: true });
    this.addEventListener("lodestream-progress", ({ detail }) => note(window.states, detail.state));
    return root;
  };
}
addEventListener("pointermove", ({ clientX, clientY }) => { window.pointer = [clientX, clientY]; }, true);
"""

# Whether what was asked for is drawn: the worker answers questions in their order.
_RESTS = """async view => {
  const { session, stage } = view;
  const rests = () => !session.busy && !session.eyeDue && session.eyeTimer === undefined && stage.frame === 0;
  if (!rests()) return false;
  await session.pick({ origin: [0, 0, 0], direction: [0, 0, 1] });
  return rests();
}"""

# What stands below the picture; null: it is not what was asked for last.
_VALUES = """view => {
  if (view.probe.busy) return null;
  const values = view.shadowRoot.querySelector(".values");
  return [...values.children].map(({ children }) => [...children].map(({ textContent }) => textContent.trim()));
}"""

# Whether it has failed and does not try again by itself, as it does once if what came until then looked done.
_FAILED = """view => window.states.at(-1) === "failed" && view.session?.looksDone === false"""

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
        expect(self.status).to_have_text(re.compile("|".join(map(re.escape, statuses))))

    def go_on_to_the_end(self) -> None:
        """Uncheck that it stops there."""
        self.until(self._goes_on)

    def _goes_on(self) -> bool:
        return goes_on(self.view)

    def everything_is_here(self) -> None:
        """Wait until the whole surface is drawn, whether it is exact or not."""
        self.until(lambda: self._goes_on() and self.status.inner_text() in ("Complete: exact", "Complete"))

    def everything(self, unit: str = "") -> None:
        """Wait for an exact surface, and until it is drawn."""
        self.until(lambda: self._goes_on() and self.status.inner_text() == "Complete: exact")
        expect(self.rms).to_have_text(f"0 {unit}".strip())

    @property
    def statuses(self) -> list[str]:
        """The statuses that were shown so far."""
        return list(self.page.evaluate("window.statuses"))

    @property
    def beside(self) -> list[list[str]]:
        """The statuses that were shown so far, each with RMS and maximum error as they stood beside it."""
        return [text.split(" | ") for text in self.page.evaluate("window.beside")]

    def failed(self) -> None:
        """Wait until the transmission has failed, and says so."""
        self.until(lambda: self.view.evaluate(_FAILED))
        self.shown("Failed")

    def try_again(self) -> None:
        """Press the button after a failure; states that were told until then are forgotten."""
        self.button("Try again").evaluate("button => { window.states = []; button.click(); }")

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

    def until(self, true: Callable[[], object]) -> None:
        """Wait for something; events of the browser are heard meanwhile."""
        until(self.page, true, lambda: f"the page shows {self.statuses}, {self.heard.errors}")

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
        last, now = b"", b""

        def rests() -> bool:
            nonlocal last, now
            last, now = now, self.canvas.screenshot() if self.view.evaluate(_RESTS) else b""
            return now != b"" and now == last

        self.until(rests)
        with Image.open(io.BytesIO(now)) as image:
            picture = np.asarray(image.convert("RGB")).astype(np.int16)
        edge = np.pad(np.zeros(np.subtract(picture.shape[:2], 12), bool), 6, constant_values=True)
        picture[edge] = 255
        return picture

    def point(self, x: float, y: float) -> dict[str, str]:
        """The values at a place of the picture, from 0 to 1 from its left and its top."""
        self._move(x, y)
        self.until(lambda: "row" in self.read())
        return self.read()

    def point_at_nothing(self, x: float, y: float) -> None:
        """A place of the picture where nothing is drawn."""
        self._move(x, y)
        assert self.read() == {}

    def _move(self, x: float, y: float) -> None:
        box = self.canvas.bounding_box()
        assert box is not None
        place = round(box["x"] + x * box["width"]), round(box["y"] + y * box["height"])
        self.page.mouse.move(place[0] + 1, place[1] + 1)
        self.page.mouse.move(*place)
        self.until(lambda: self.page.evaluate("window.pointer") == [*place])

    def read(self) -> dict[str, str]:
        """The values that stand below the picture, of the place that was asked for last."""
        found: list[list[str]] | None = None

        def answered() -> bool:
            nonlocal found
            found = self.view.evaluate(_VALUES)
            return found is not None

        self.until(answered)
        assert found is not None
        values = {pair[0]: pair[1] for pair in found if len(pair) == 2}
        for name in [name for name in values if name.startswith("block ")]:
            values |= {"block": name.split()[1].rstrip(","), "row": values.pop(name)}
        return values

    def button(self, name: str) -> Locator:
        """A button of the view."""
        return self.view.get_by_role("button", name=name, exact=True)


def until(page: Page, true: Callable[[], object], told: Callable[[], str] = lambda: "it does not come") -> None:
    """Wait for something; events of the browser are heard meanwhile."""
    end = time.monotonic() + PATIENCE
    while not true():
        assert time.monotonic() < end, told()
        page.wait_for_timeout(30)


def goes_on(view: Locator) -> bool:
    """Uncheck that a view stops when its picture looks done; whether it is unchecked.

    By the keyboard, since a click may miss what moves as rows above it come and go; to be called again, since it is
    checked anew if the page has only now given the view its surface.
    """
    box = view.get_by_label("Stop when the picture looks done")
    if box.is_checked():
        box.press("Space")
    return not box.is_checked()


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
