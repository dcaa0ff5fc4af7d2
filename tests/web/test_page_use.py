"""Using the page: by keyboard alone, by an address that somebody shared, and by those who cannot see it."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from .browser import Heard, Tab
from .conftest import Tabs
from .shown import Shelf

AXE = Path(__file__).parents[2] / "client" / "web" / "node_modules" / "axe-core" / "axe.min.js"


def focused(tab: Tab) -> dict[str, str]:
    """What has the focus, within the view too."""
    found: dict[str, str] = tab.page.evaluate(
        """() => {
          let at = document.activeElement;
          while (at?.shadowRoot?.activeElement) at = at.shadowRoot.activeElement;
          return { tag: at?.tagName ?? "", id: at?.id ?? "", text: at?.textContent ?? "", label: at?.ariaLabel ?? "" };
        }"""
    )
    return found


def tab_to(tab: Tab, wanted: Callable[[dict[str, str]], bool]) -> None:
    """Go on with the tabulator until something has the focus."""
    for _ in range(60):
        if wanted(focused(tab)):
            return
        tab.page.keyboard.press("Tab")
    raise AssertionError("the tabulator does not lead there")


def test_the_keyboard_alone_is_enough(tabs: Tabs, shelf: Shelf) -> None:
    shelf.description("terrain")
    tab = tabs(shelf.server)
    keys = tab.page.keyboard
    tab.page.get_by_role("link", name="terrain").wait_for()
    tab_to(tab, lambda at: at["tag"] == "A" and at["text"] == "terrain")
    keys.press("Enter")
    tab.until(lambda: tab.view.count() and tab.moments)
    tab_to(tab, lambda at: at["id"] == "below")
    keys.press("Space")
    tab.shown("Complete: exact")
    tab.page.keyboard.press("Shift+Tab")
    tab.page.evaluate("document.activeElement.blur()")
    tab_to(tab, lambda at: at["tag"] == "CANVAS")
    assert focused(tab)["label"].startswith("Surface terrain.")

    def moves(*pressed: str) -> np.ndarray[Any, np.dtype[np.float64]]:
        before = np.array(tab.camera)
        for key in pressed:
            keys.press(key)
        moved: np.ndarray[Any, np.dtype[np.float64]] = np.array(tab.camera) - before
        return moved

    def still() -> bool:
        before = tab.camera
        tab.page.wait_for_timeout(700)  # an untouched camera follows the surface within half a second
        return before == tab.camera

    tab.until(lambda: tab.rms.inner_text() == "0 m")
    tab.until(still)
    home = tab.camera
    assert np.linalg.norm(home) == pytest.approx(np.linalg.norm(home + moves("ArrowLeft", "ArrowUp")), rel=1e-6)
    assert np.linalg.norm(moves("ArrowRight")) > 0.1
    assert np.linalg.norm(moves("Shift+ArrowRight")) > 0.01
    before = np.linalg.norm(tab.camera)
    moves("+", "+", "PageUp")
    assert np.linalg.norm(tab.camera) < 0.8 * before
    moves("Home")
    assert tab.camera == pytest.approx(home)
    tab.until(lambda: "row" not in tab.read())
    keys.press("p")
    tab.until(lambda: "row" in tab.read())
    assert tab.values.get_attribute("aria-live") == "polite"
    keys.press("[")
    tab.until(lambda: tab.rms.inner_text() != "0 m")
    keys.press("]")
    tab.until(lambda: tab.rms.inner_text() == "0 m")
    times = tab.view.locator("output[for=exaggeration]")
    said = times.inner_text()
    keys.press("x")
    tab.until(lambda: times.inner_text() != said)
    tab_to(tab, lambda at: at["id"] == "field")
    keys.press("ArrowDown")
    tab.until(lambda: tab.view.locator(".legend-title").inner_text() == "Slope (degrees)")
    tab_to(tab, lambda at: at["text"] == "From above")
    keys.press("Enter")
    tab.until(lambda: abs(tab.camera[0]) < 0.02 and abs(tab.camera[1]) < 0.02)


def test_a_shared_address_shows_the_same(tabs: Tabs, shelf: Shelf) -> None:
    first = tabs(shelf.address("terrain"))
    first.everything("m")
    first.choose("Coloured by", "Slope")
    first.choose("Colour map", "cividis")
    first.view.get_by_label("Colours begin at").fill("5")
    first.view.get_by_label("Colours end at").fill("60")
    first.view.get_by_label("Colours end at").press("Enter")
    first.press("ArrowLeft", "ArrowLeft", "ArrowUp", "+", "+", "Shift+ArrowLeft", "x", "l")
    picture = first.picture()
    first.until(lambda: all(part in first.page.url for part in ("&c=slope", "&m=cividis", "&r=5,60", "&l=1")))
    first.page.wait_for_timeout(1000)  # the address is written less often than the view changes
    second = tabs(first.page.url)
    second.everything("m")
    assert second.camera == pytest.approx(first.camera, abs=0.01)
    assert np.abs(second.picture() - picture).mean() < 1.5
    assert second.view.get_by_label("Colours end at").input_value() == "60"
    assert second.view.get_by_label("Colour map").input_value() == "cividis"
    assert second.view.get_by_label("Quad lines").is_checked()
    other = tabs(shelf.address("terrain"))
    other.everything("m")
    assert np.abs(other.picture() - picture).mean() > 5


def violations(tab: Tab) -> list[str]:
    """What axe finds wrong with a page."""
    tab.page.evaluate(AXE.read_text())
    found = tab.page.evaluate("axe.run(document, { resultTypes: ['violations'] })")["violations"]
    return [f"{rule['id']}: {rule['help']}: {[node['target'] for node in rule['nodes']]}" for rule in found]


@pytest.mark.parametrize("scheme", ["light", "dark"])
@pytest.mark.parametrize("size", [(900, 700), (360, 640)], ids=["wide", "narrow"])
def test_axe_finds_nothing_wrong_with_a_surface(tabs: Tabs, shelf: Shelf, scheme: str, size: tuple[int, int]) -> None:
    tab = tabs(shelf.address("attribute"), color_scheme=scheme, size=size)
    tab.everything("m")
    tab.press("p")
    tab.until(lambda: "row" in tab.read())
    tab.choose("Target", "RMS error")
    assert violations(tab) == []


@pytest.mark.parametrize("scheme", ["light", "dark"])
def test_axe_finds_nothing_wrong_with_the_list(
    tabs: Tabs, shelf: Shelf, closed: tuple[str, str], heard: Heard, scheme: str
) -> None:
    heard.allow(r"status of 4\d\d")
    shelf.description("terrain")
    tab = tabs(shelf.server, color_scheme=scheme)
    tab.page.get_by_role("link", name="terrain").wait_for()
    tab.page.get_by_label("Files to upload").set_input_files(
        {"name": "letter.txt", "mimeType": "text/plain", "buffer": b"Dear reader, this is no surface, either."}
    )
    tab.page.locator(".uploads .reason").wait_for()
    assert violations(tab) == []
    tab.page.get_by_role("button", name="Delete terrain").click()
    tab.page.get_by_role("dialog").wait_for()
    assert violations(tab) == []
    asked = tabs(closed[0], color_scheme=scheme)
    asked.page.get_by_role("dialog").wait_for()
    assert violations(asked) == []
