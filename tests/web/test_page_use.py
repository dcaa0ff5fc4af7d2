"""Using the page: by keyboard alone, by an address that somebody shared, and by those who cannot see it."""

from __future__ import annotations

import io
import re
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from playwright.sync_api import expect

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
    """Go on with the tabulator until something has the focus: a list is as long as other tests have made it."""
    for _ in range(1000):
        if wanted(focused(tab)):
            return
        tab.page.keyboard.press("Tab")
    raise AssertionError("the tabulator does not lead there")


def in_address(tab: Tab) -> list[float] | None:
    """The camera that the address of a page gives; None: it gives none."""
    found = re.search(r"[#&]v=([^&]*)", tab.page.url)
    return None if found is None else [float(number) for number in found[1].split(",")]


def test_the_keyboard_alone_is_enough(tabs: Tabs, shelf: Shelf) -> None:
    shelf.description("terrain")
    tab = tabs(shelf.server)
    keys = tab.page.keyboard
    tab.page.get_by_role("link", name="terrain", exact=True).wait_for()
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

    # An untouched camera follows the surface; from the first key on only keys move it.
    keys.press("ArrowLeft")
    turned = tab.camera
    keys.press("ArrowUp")
    raised = tab.camera
    assert raised.numbers == pytest.approx([turned.azimuth, turned.elevation + 5, turned.distance, *turned.target])
    keys.press("ArrowRight")
    assert tab.camera.azimuth == pytest.approx(raised.azimuth + 5)
    keys.press("Shift+ArrowRight")
    moved = tab.camera
    assert moved.target[0] > raised.target[0] + 1
    for key in ("+", "+", "PageUp"):
        keys.press(key)
    assert tab.camera.distance == pytest.approx(0.85**3 * moved.distance)
    tab.until(lambda: in_address(tab) == pytest.approx(tab.camera.numbers, abs=0.5))
    keys.press("Home")
    home = tab.camera
    assert (home.azimuth, home.elevation) == pytest.approx((-90, 42))
    assert home.target[:2] == pytest.approx([124.5, 99.5], abs=0.02 * home.distance)
    assert home.distance > raised.distance * 0.9
    tab.until(lambda: in_address(tab) is None)
    tab.until(lambda: tab.rms.inner_text() == "0 m")
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
    tab.until(lambda: tab.camera.elevation == 89.9)
    above = tab.camera
    assert above.azimuth == -90
    assert above.target[:2] == pytest.approx([124.5, 99.5], abs=0.02 * above.distance)


def test_a_shared_address_shows_the_same(tabs: Tabs, shelf: Shelf) -> None:
    first = tabs(shelf.address("terrain"))
    first.everything("m")
    first.choose("Coloured by", "Slope")
    first.picture()  # whose range of colours is in the fields
    first.choose("Colour map", "cividis")
    first.view.get_by_label("Colours begin at").fill("5")
    first.view.get_by_label("Colours end at").fill("60")
    first.view.get_by_label("Colours end at").press("Enter")
    first.press("ArrowLeft", "ArrowLeft", "ArrowUp", "+", "+", "Shift+ArrowLeft", "x", "l")
    picture = first.picture()
    first.until(lambda: all(part in first.page.url for part in ("&c=slope", "&m=cividis", "&r=5,60", "&l=1")))
    seen = first.camera.numbers
    first.until(lambda: in_address(first) == pytest.approx(seen, rel=1e-3, abs=0.3))
    second = tabs(first.page.url)
    second.everything("m")
    assert second.camera.numbers == pytest.approx(seen, rel=1e-3, abs=0.3)
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
@pytest.mark.parametrize("size", [(900, 700), (360, 640)], ids=["wide", "narrow"])
def test_axe_finds_nothing_wrong_where_a_surface_is_chosen(
    tabs: Tabs, shelf: Shelf, scheme: str, size: tuple[int, int]
) -> None:
    shelf.description("terrain")
    tab = tabs(shelf.server, color_scheme=scheme, size=size)
    tab.page.get_by_role("link", name="terrain", exact=True).wait_for()
    choose(tab, f"{scheme}-{size[0]}")
    tab.page.locator("tbody").get_by_role("button", name="More").first.wait_for()
    assert violations(tab) == []
    # Nothing is wider than the window.
    assert tab.page.evaluate("document.documentElement.scrollWidth") == size[0]


def choose(tab: Tab, name: str) -> None:
    """Upload a file of several surfaces, each called by a long name, until one is to be chosen."""
    file = io.BytesIO()
    arrays = {f"{name} {'number ' * 5}{number}": np.full((6, 9 + number), float(number)) for number in range(8)}
    np.savez(file, **dict[str, Any](arrays))
    tab.page.get_by_label("Files to upload").set_input_files(
        {"name": f"{name}.npz", "mimeType": "application/octet-stream", "buffer": file.getvalue()}
    )
    tab.page.get_by_role("button", name="Upload again").wait_for()


def test_a_surface_of_a_file_is_chosen_by_the_keyboard(tabs: Tabs, shelf: Shelf) -> None:
    tab = tabs(shelf.server)
    choose(tab, "keys")
    row = tab.page.locator("tbody tr", has_text="keys.npz")
    expect(row).to_have_count(1)
    words, more = row.locator(".words"), row.get_by_role("button", name="More")
    lines = words.bounding_box()
    tab_to(tab, lambda at: at["text"] == "More")
    tab_to(tab, lambda at: at["tag"] == "SELECT")
    tab.page.keyboard.press("End")
    expect(tab.page.get_by_label("Choose an array")).to_have_value("7")
    more.focus()
    tab.page.keyboard.press("Enter")
    expect(row.get_by_role("button", name="Less")).to_be_focused()
    opened = words.bounding_box()
    assert lines is not None
    assert opened is not None
    assert opened["height"] > 1.4 * lines["height"], "the rest is seen"
    tab.page.get_by_role("button", name="Upload again").focus()
    tab.page.keyboard.press("Enter")
    made = tab.page.locator("tbody tr", has_text="6 \N{MULTIPLICATION SIGN} 16")
    expect(made).to_have_count(1)
    expect(row).to_have_count(0)
    expect(tab.page.get_by_role("list", name="Uploads").get_by_role("listitem")).to_have_count(0)
    expect(made.locator("img.picture")).to_be_visible()


@pytest.mark.parametrize("scheme", ["light", "dark"])
def test_axe_finds_nothing_wrong_with_the_list(
    tabs: Tabs, shelf: Shelf, closed: tuple[str, str], heard: Heard, scheme: str
) -> None:
    heard.allow(r"status of 4\d\d")
    shelf.description("terrain")
    tab = tabs(shelf.server, color_scheme=scheme)
    tab.page.get_by_role("link", name="terrain", exact=True).wait_for()
    tab.page.get_by_label("Files to upload").set_input_files(
        {"name": "letter.txt", "mimeType": "text/plain", "buffer": b"Dear reader, this is no surface, either."}
    )
    tab.page.locator(".uploads .reason").wait_for()
    assert violations(tab) == []
    tab.page.get_by_role("button", name="Delete terrain", exact=True).click()
    tab.page.get_by_role("dialog").wait_for()
    assert violations(tab) == []
    asked = tabs(closed[0], color_scheme=scheme)
    asked.page.get_by_role("dialog").wait_for()
    assert violations(asked) == []
