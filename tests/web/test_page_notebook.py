"""Widgets in a page, as a notebook shows them: `Widget` itself at one end, the viewer's element at the other."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from playwright.sync_api import Browser, expect

import lodestream as ls
from lodestream.container import read_index
from lodestream_client import Widget
from tests.client.notebook.conftest import Page as Kernel
from tests.client.notebook.conftest import fake_page

from .browser import Heard, tab
from .notebooks import Notebook

__all__ = ["fake_page"]  # a fixture


@pytest.fixture
def notebook(browser: Browser, heard: Heard, fake_page: Kernel) -> Any:
    with tab(browser, heard, size=(900, 1100)) as opened:
        yield Notebook(opened.page, fake_page.heard)


@pytest.fixture(scope="module")
def hills() -> ls.Surface:
    rows, columns = np.mgrid[:300, :400]
    heights = np.round(
        60 * np.sin(rows / 41) * np.cos(columns / 67) + np.random.default_rng(1).normal(size=(300, 400)), 2
    )
    attributes = {"rain": np.cos(rows / 30), "wind": np.stack([np.sin(columns / 50), rows / 300], axis=2)}
    return ls.Surface(heights, attributes=attributes, metadata={"name": "hills", "unit": "m"})


@pytest.fixture(scope="module")
def container(hills: ls.Surface) -> bytes:
    return ls.encode(hills)


def test_a_surface_comes_into_focus_over_the_comm(notebook: Notebook, container: bytes, hills: ls.Surface) -> None:
    widget = Widget(container, stop_when_done=False, height=500)
    view = notebook.show(widget)
    notebook.status(view, "Complete: exact")
    notebook.until(lambda: widget.state == "complete" and widget.rms == 0)
    assert widget.bytes_received <= len(container)
    assert len(container) <= widget.bytes_sent < 1.3 * len(container)  # its end is read for the price list too
    assert widget.level == ls.Decoder().feed(container)[-1].level
    box = view.bounding_box()
    assert box is not None
    assert box["height"] == 500
    canvas = view.locator("canvas")
    assert canvas.get_attribute("aria-label") is not None
    canvas.press("p")
    notebook.until(lambda: widget.selected is not None)
    row, column = widget.selected["row"], widget.selected["column"]
    assert widget.selected["point"][2] == hills.points[row, column]
    assert widget.selected["attributes"]["wind"] == pytest.approx(hills.attributes["wind"][row, column])
    assert widget.selected["max_error"] == 0


def test_several_places_and_widgets_in_one_page(notebook: Notebook, container: bytes) -> None:
    one, other = Widget(container), Widget(np.add.outer(np.arange(70) ** 2, np.arange(50)))
    views = [notebook.show(one), notebook.show(one), notebook.show(other)]
    for view in views:
        notebook.everything(view)
    kinds = [question["kind"] for question in notebook.page.evaluate("window.asked")]
    assert kinds.count("program") == 1
    assert one.bytes_sent >= 2 * len(container)
    notebook.page.evaluate("window.ends[0]()")
    expect(notebook.page.locator("lodestream-view")).to_have_count(2)
    left = notebook.page.locator("lodestream-view").first
    since = notebook.count
    one.field = "rain"
    notebook.told(one, since)
    expect(left.get_by_label("Coloured by", exact=True).locator("option:checked")).to_have_text("rain")


def test_what_python_sets_is_shown_and_what_the_user_changes_comes_back(notebook: Notebook, container: bytes) -> None:
    widget: Any = Widget(
        container, field="wind", colour_map="grey", exaggeration=2, lines=True, value_range=(0.25, 0.5)
    )
    view = notebook.show(widget)
    notebook.everything(view)
    field = view.get_by_label("Coloured by", exact=True)
    expect(field.locator("option:checked")).to_have_text("wind, magnitude")
    expect(view.get_by_label("Colour map")).to_have_value("grey")
    expect(view.get_by_label("Colours begin at")).to_have_value("0.25")
    expect(view.get_by_label("Quad lines")).to_be_checked()
    expect(view.locator("output[for=exaggeration]")).to_have_text("\N{MULTIPLICATION SIGN} 2")
    field.select_option(label="wind[1]")
    notebook.until(lambda: (widget.field, widget.colour_map, widget.value_range) == ("wind[1]", None, None))
    view.get_by_label("Colour map").select_option("cividis")
    view.get_by_label("Quad lines").uncheck()
    view.locator("canvas").press("x")
    notebook.until(lambda: (widget.colour_map, widget.lines, widget.exaggeration) == ("cividis", False, 2.5))
    for name, value in (("field", "slope"), ("colour_map", "red-blue"), ("exaggeration", 4), ("value_range", (1, 3))):
        since = notebook.count
        setattr(widget, name, value)
        notebook.told(widget, since)
    expect(field.locator("option:checked")).to_have_text("Slope")
    expect(view.get_by_label("Colour map")).to_have_value("red-blue")
    expect(view.get_by_label("Colours end at")).to_have_value("3")
    expect(view.locator("output[for=exaggeration]")).to_have_text("\N{MULTIPLICATION SIGN} 4")
    assert (widget.field, widget.colour_map, widget.exaggeration) == ("slope", "red-blue", 4)


def test_a_target_ends_the_transmission_and_another_goes_on(notebook: Notebook, container: bytes) -> None:
    widget = Widget(container, target=ls.Target(max_bytes=20_000), stop_when_done=False)
    view = notebook.show(widget)
    notebook.until(lambda: widget.state == "target")
    assert 0 < widget.bytes_received <= 20_000
    assert widget.bytes_sent < 0.8 * len(container)
    expect(view.get_by_label("Target value")).to_have_value("20")
    since = notebook.count
    widget.target = ls.Target(until_rms=ls.Tolerance(0.05))
    notebook.told(widget, since)
    notebook.until(lambda: widget.state == "target" and widget.rms is not None and widget.rms <= 0.05)
    since = notebook.count
    widget.target = None
    notebook.told(widget, since)
    notebook.status(view, "Complete: exact")


def test_stop_ends_the_questions(notebook: Notebook) -> None:
    heights = np.random.default_rng(2).integers(0, 60_000, (900, 900))
    data = ls.encode(heights)
    end = read_index(lambda offset, length: data[offset : offset + length], len(data)).surface_end
    widget = Widget(data, stop_when_done=False)
    notebook.page.evaluate("window.held = 6")
    view = notebook.show(widget)
    notebook.until(lambda: widget.state == "receiving" and widget.bytes_sent > 200_000)
    under_way = notebook.questions()
    assert sum(question["length"] for question in under_way[6:]) <= 4 * 128 * 1024
    since = notebook.count
    widget.stop()
    notebook.told(widget, since)
    notebook.page.evaluate("window.held = null")
    notebook.status(view, "Stopped")
    notebook.until(lambda: widget.state == "stopped")
    # The price list at the end of the container is none of what was stopped.
    later = [question for question in notebook.questions() if question not in under_way]
    assert [question for question in later if question["offset"] < end] == []
    sent = widget.bytes_sent
    assert sent < 1_000_000 < len(data)
    since = notebook.count
    widget.resume()
    notebook.told(widget, since)
    notebook.status(view, "Complete: exact")
    assert widget.bytes_sent > sent


def test_why_it_fails_is_shown_and_told(notebook: Notebook, container: bytes, tmp_path: Path) -> None:
    path = tmp_path / "a.lode"
    path.write_bytes(container)
    widget = Widget(path)
    path.unlink()
    view = notebook.show(widget)
    expect(view.locator(".notice")).to_contain_text("No such file or directory")
    notebook.until(lambda: widget.state == "failed" and "No such file" in widget.detail)


def test_an_element_that_does_not_come_is_said_so(notebook: Notebook, container: bytes, tmp_path: Path) -> None:
    widget = Widget(container)
    widget._answers._program = tmp_path / "view-gone.js"
    notebook.show(widget)
    expect(notebook.page.get_by_role("alert")).to_contain_text("The surface cannot be shown: ")
    expect(notebook.page.get_by_role("alert")).to_contain_text("view-gone.js")


def test_it_is_light_or_dark_as_the_notebook_is(notebook: Notebook, container: bytes) -> None:
    widget = Widget(container)
    view = notebook.show(widget)

    def paper() -> str:
        return str(view.evaluate("view => getComputedStyle(view).backgroundColor"))

    light, dark = "rgb(251, 252, 252)", "rgb(18, 24, 27)"
    assert paper() == light
    notebook.page.evaluate("document.body.dataset.jpThemeLight = 'false'")
    notebook.until(lambda: paper() == dark)
    notebook.page.evaluate("delete document.body.dataset.jpThemeLight")
    notebook.until(lambda: paper() == light)
    for name in ("vscode-dark", "dark"):
        notebook.page.evaluate("name => document.body.classList.add(name)", name)
        notebook.until(lambda: paper() == dark)
        notebook.page.evaluate("name => document.body.classList.remove(name)", name)
        notebook.until(lambda: paper() == light)
    since = notebook.count
    widget.theme = "dark"
    notebook.told(widget, since)
    notebook.until(lambda: paper() == dark)


def test_keys_of_the_picture_are_none_of_the_notebook(notebook: Notebook, container: bytes) -> None:
    view = notebook.show(Widget(container))
    notebook.everything(view)
    notebook.page.evaluate("document.addEventListener('keydown', (event) => (window.keys ??= []).push(event.key))")
    view.locator("canvas").press("x")
    notebook.page.evaluate("document.activeElement.blur()")
    notebook.page.keyboard.press("y")
    assert notebook.page.evaluate("window.keys") == ["y"]
    assert view.get_attribute("data-lm-suppress-shortcuts") == "true"
