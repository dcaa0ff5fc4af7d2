"""Pictures of the page, light, dark and narrow, into build/web-pictures: to be looked at, and kept by CI."""

from __future__ import annotations

from pathlib import Path

import pytest
from playwright.sync_api import expect

from .browser import Heard
from .conftest import Tabs
from .shown import Shelf

FOLDER = Path(__file__).parents[2] / "build" / "web-pictures"


@pytest.mark.parametrize("scheme", ["light", "dark"])
@pytest.mark.parametrize("size", [(1000, 640), (360, 640)], ids=["wide", "narrow"])
def test_nothing_hangs_over(tabs: Tabs, shelf: Shelf, heard: Heard, scheme: str, size: tuple[int, int]) -> None:
    for name in ("terrain", "torus", "holes"):
        shelf.description(name)
    FOLDER.mkdir(parents=True, exist_ok=True)
    shape = "wide" if size[0] > 500 else "narrow"
    tab = tabs(shelf.server, color_scheme=scheme, size=size)
    tab.page.get_by_role("link", name="terrain", exact=True).wait_for()
    tab.page.screenshot(path=FOLDER / f"list-{shape}-{scheme}.png")
    fits = "document.scrollingElement.scrollWidth <= innerWidth"
    assert tab.page.evaluate(fits)
    for name in ("terrain", "torus"):
        tab.page.goto(shelf.address(name))
        expect(tab.page.locator("header h1")).to_have_text(name)  # the one before stays until the server has answered
        tab.everything("m" if name == "terrain" else "")
        tab.point(0.5, 0.55)
        tab.picture()
        tab.page.screenshot(path=FOLDER / f"{name}-{shape}-{scheme}.png")
        assert tab.page.evaluate(fits)
        box, window = tab.canvas.bounding_box(), size[0] * size[1]
        assert box is not None
        assert box["width"] * box["height"] > 0.3 * window
        panel = tab.view.locator(".panel")
        assert panel.evaluate("panel => panel.scrollWidth <= panel.clientWidth")
        light = tab.page.locator("body").evaluate("body => getComputedStyle(body).backgroundColor")
        assert (int(light.split("(")[1].split(",")[0]) > 128) == (scheme == "light")
