"""The page of a server: list, search, upload, delete, and tokens."""

from __future__ import annotations

import base64
from itertools import count
from pathlib import Path

import httpx
import numpy as np
import pytest
from playwright.sync_api import Route, expect

import lodestream as ls
from lodestream_client import Client

from .browser import Heard, Tab
from .conftest import Tabs
from .shown import Shelf, surface

HEIGHTS = surface("terrain").points
_NUMBERS = count()


@pytest.fixture
def file(tmp_path: Path) -> Path:
    """A surface of its own for each test: what is on the server already is not built again.

    No name is a part of another one.
    """
    number = next(_NUMBERS)
    path = tmp_path / f"hills-{number:03}.npy"
    np.save(path, (HEIGHTS[:60, :80] + np.float32(number)).astype(np.float32))
    return path


def test_a_file_is_uploaded_built_and_seen(tabs: Tabs, shelf: Shelf, file: Path) -> None:
    tab = tabs(shelf.server)
    tab.page.get_by_label("Files to upload").set_input_files(file)
    tab.page.get_by_role("link", name=file.stem, exact=True).click()
    tab.everything()
    values = tab.point(0.5, 0.55)
    heights = np.load(file)
    assert float(values["height"]) == pytest.approx(float(heights[int(values["row"]), int(values["column"])]), rel=1e-7)
    expect(tab.page.locator("header .facts")).to_contain_text("60 \N{MULTIPLICATION SIGN} 80 points")


def test_a_name_opens_what_it_leads_to(tabs: Tabs, shelf: Shelf, tmp_path: Path) -> None:
    for number in range(2):
        np.save(tmp_path / "hills.npy", (HEIGHTS[: 30 + number, :40] + np.float32(number)).astype(np.float32))
        Client(shelf.server).upload(tmp_path / "hills.npy", name="dem", replace=True)
        tab = tabs(f"{shelf.server}/#n=dem")
        tab.everything()
        expect(tab.page.locator("header .facts")).to_contain_text(f"{30 + number} \N{MULTIPLICATION SIGN} 40 points")
        expect(tab.page.get_by_role("heading", name="dem")).to_be_visible()
        assert "#n=dem" in tab.page.url, "its address stays"


def test_the_element_follows_a_name(tabs: Tabs, shelf: Shelf, tmp_path: Path) -> None:
    np.save(tmp_path / "hills.npy", HEIGHTS[:30, :40].astype(np.float32))
    Client(shelf.server).upload(tmp_path / "hills.npy", name="hills", replace=True)
    tab = tabs(shelf.server)
    tab.page.get_by_role("heading", name="Surfaces").wait_for()
    tab.page.evaluate(
        """(src) => {
          const view = document.createElement("lodestream-view");
          view.src = src;
          document.querySelector("main").replaceChildren(view);
        }""",
        f"{shelf.server}/v1/names/hills",
    )
    tab.everything()


def test_a_name_that_leads_nowhere_is_told(tabs: Tabs, shelf: Shelf, heard: Heard) -> None:
    heard.allow("status of 404")
    tab = tabs(f"{shelf.server}/#n=nowhere")
    expect(tab.page.get_by_role("alert")).to_contain_text("No name 'nowhere' on this server")


def listed(tab: Tab) -> None:
    """Wait until the list has come."""
    expect(tab.page.locator("p.message")).not_to_have_text("Loading")


def drop(tab: Tab, name: str, data: bytes, place: str = ".drop") -> None:
    """Let go of a file above the page's place for files, or another element, once the page takes files."""
    tab.page.locator(".drop").wait_for(state="attached")
    tab.page.evaluate(
        """([name, text, place]) => {
          const bytes = Uint8Array.from(atob(text), (letter) => letter.charCodeAt(0));
          const dataTransfer = new DataTransfer();
          dataTransfer.items.add(new File([bytes], name));
          for (const kind of ["dragenter", "dragover", "drop"])
            document.querySelector(place).dispatchEvent(
              new DragEvent(kind, { dataTransfer, bubbles: true, cancelable: true }));
        }""",
        [name, base64.b64encode(data).decode(), place],
    )


@pytest.mark.parametrize("place", [".drop", "body"])
def test_files_are_dropped_found_and_deleted(tabs: Tabs, shelf: Shelf, file: Path, place: str) -> None:
    tab = tabs(shelf.server)
    page = tab.page
    drop(tab, file.name, file.read_bytes(), place)
    link = page.get_by_role("link", name=file.stem, exact=True)
    link.wait_for()
    expect(page.get_by_role("list", name="Uploads").get_by_role("listitem")).to_have_count(0)
    page.get_by_label("Search surfaces").fill("nowhere")
    expect(page.get_by_text("No surface has that in its name.")).to_be_visible()
    page.get_by_label("Search surfaces").fill(file.stem.upper())
    expect(page.locator("tbody tr")).to_have_count(1)
    page.get_by_role("button", name=f"Delete {file.stem}", exact=True).click()
    page.get_by_role("dialog").get_by_role("button", name="Cancel").click()
    expect(link).to_be_visible()
    page.get_by_role("button", name=f"Delete {file.stem}", exact=True).click()
    page.get_by_role("dialog").get_by_role("button", name="Delete").click()
    expect(link).to_have_count(0)
    page.reload()
    listed(tab)
    expect(link).to_have_count(0)


def test_a_surface_that_is_deleted_while_it_is_looked_at_again_stays_away(tabs: Tabs, shelf: Shelf, file: Path) -> None:
    uploaded = Client(shelf.server).upload(file)
    before = httpx.get(f"{uploaded.url}?thumbnails=true", trust_env=False).json()
    building = {"surfaces": [{**before, "state": "building"}], "next": None}
    tab = tabs(shelf.server)
    listed(tab)
    held: list[Route] = []
    tab.page.route("**/v1/surfaces?*", lambda route: route.fulfill(json=building))
    tab.page.route(f"{uploaded.url}?*", lambda route: held.append(route))
    tab.page.reload()
    row = tab.page.locator("tbody tr", has_text=file.stem)
    tab.until(lambda: held)
    row.get_by_role("button", name="Delete").click()
    tab.page.get_by_role("dialog").get_by_role("button", name="Delete").click()
    expect(row).to_have_count(0)
    (route,) = held
    with tab.page.expect_response(route.request.url) as answer:
        route.fulfill(json=before)
    answer.value.finished()
    tab.page.evaluate("url => fetch(url).then((answer) => answer.text())", f"{shelf.server}/v1/surfaces?limit=1")
    expect(row).to_have_count(0)


def test_thumbnails_come_with_the_list(tabs: Tabs, shelf: Shelf, heard: Heard, file: Path) -> None:
    shelf.description("torus")
    tab = tabs(shelf.server)
    # Of a surface that was there, and of one that is uploaded now.
    tab.page.get_by_label("Files to upload").set_input_files(file)
    for name in ("torus", file.stem):
        picture = tab.page.locator("tbody tr", has=tab.page.get_by_role("link", name=name, exact=True)).locator("img")
        expect(picture.first).to_be_visible()
        assert picture.first.evaluate("(image) => image.decode().then(() => image.naturalWidth)") == 96
    asked = [url for url in heard.requests if "/v1/" in url]
    assert sum("limit=" in url for url in asked) == 1
    assert not any("png" in url for url in asked), "a picture is no request"
    before = len(heard.requests)
    link = tab.page.get_by_role("link", name="torus", exact=True)
    tab.page.locator("tbody tr .entry", has=link).click(position={"x": 20, "y": 20})
    tab.everything()
    assert len(heard.requests) > before, "whoever presses the picture opens the surface"


def test_a_file_that_is_no_surface_is_told(tabs: Tabs, shelf: Shelf, heard: Heard) -> None:
    heard.allow(r"status of 4\d\d")
    tab = tabs(shelf.server)
    drop(tab, "letter.txt", b"Dear reader, this is no surface.")
    reason = tab.page.locator(".uploads .reason")
    reason.wait_for()
    assert len(reason.inner_text()) > 10
    tab.page.get_by_role("button", name="Dismiss").click()
    expect(reason).to_have_count(0)


def test_an_address_of_nothing_is_told(tabs: Tabs, shelf: Shelf, heard: Heard) -> None:
    heard.allow("status of 404")
    tab = tabs(f"{shelf.server}/#s=11111111111111111111")
    expect(tab.page.get_by_role("alert")).to_be_visible()
    tab.page.get_by_role("link", name="Lodestream").click()
    expect(tab.page.get_by_role("heading", name="Surfaces")).to_be_visible()


def test_a_refusal_that_comes_late_takes_nobody_from_the_list(tabs: Tabs, shelf: Shelf, heard: Heard) -> None:
    heard.allow("status of 404")
    tab = tabs(shelf.server)
    listed(tab)
    held: list[Route] = []
    tab.page.route("**/v1/surfaces/1*", lambda route: held.append(route))
    tab.page.goto(f"{shelf.server}/#s=11111111111111111111")
    tab.until(lambda: held)
    tab.page.goto(f"{shelf.server}/#")
    listed(tab)
    with tab.page.expect_response(held[0].request.url) as answer:
        held[0].continue_()
    answer.value.finished()
    tab.page.evaluate("url => fetch(url).then((answer) => answer.text())", f"{shelf.server}/v1/surfaces?limit=1")
    expect(tab.page.get_by_role("alert")).to_have_count(0)
    expect(tab.page.get_by_role("heading", name="Surfaces")).to_be_visible()


def test_the_slider_goes_through_the_surfaces_of_a_series(tabs: Tabs, shelf: Shelf) -> None:
    """By the keyboard, which stays on it; and not where there is no other surface of the series."""

    def step(index: int, name: str) -> str:
        place = {"name": name, "along": "time", "index": index, "value": 6 * index, "unit": "h"}
        metadata = {"name": f"{name} at {6 * index} h", "series": place}
        return Client(shelf.server).upload(ls.Surface(HEIGHTS[:40, :30] + np.float32(index), metadata=metadata)).url

    urls = [step(index, "slid") for index in (2, 0, 1)]
    tab = tabs(f"{shelf.server}/#s={urls[1].rsplit('/', 1)[1]}")
    slider, heading = tab.page.get_by_role("slider", name="time", exact=True), tab.page.get_by_role("heading", level=1)
    expect(tab.page.locator(".series output")).to_have_text("at 0 h (1 of 3)")
    slider.focus()
    for index, id_ in ((1, urls[2]), (2, urls[0])):
        tab.page.keyboard.press("ArrowRight")
        expect(heading).to_have_text(f"slid at {6 * index} h")
        expect(tab.page.locator(".series output")).to_have_text(f"at {6 * index} h ({index + 1} of 3)")
        expect(slider).to_be_focused()
        assert f"#s={id_.rpartition('/')[2]}" in tab.page.url  # colours and the like may follow
    alone = tabs(f"{shelf.server}/#s={step(0, 'alone').rsplit('/', 1)[1]}")
    alone.everything()
    expect(alone.page.locator(".series")).to_have_count(0)


def test_a_token_is_asked_for_and_kept_to_oneself(tabs: Tabs, closed: tuple[str, str], heard: Heard) -> None:
    heard.allow("status of 40[13]")
    server, token = closed
    Client(server, token=token).upload(surface("torus"))
    tab = tabs(server)
    dialog = tab.page.get_by_role("dialog")
    dialog.get_by_label("Token").fill("lode_wrong")
    dialog.get_by_role("button", name="Continue").click()
    # The server says that this is none; the dialog is there again, and empty.
    expect(dialog.get_by_label("Token")).to_have_value("")
    expect(dialog).not_to_contain_text("This server gives its surfaces")
    expect(dialog.get_by_role("heading")).to_have_text("The server does not know this token")
    dialog.get_by_label("Token").fill(token)
    dialog.get_by_label("Token").press("Enter")
    tab.page.get_by_role("link", name="torus", exact=True).click()
    tab.everything()
    assert heard.tokens == {"Bearer lode_wrong", f"Bearer {token}"}
    assert not [url for url in [*heard.requests, tab.page.url] if token in url or "lode_wrong" in url]
    kept = tab.page.evaluate("[localStorage.length, sessionStorage.length, document.cookie]")
    assert kept == [0, 0, ""]


def test_a_token_that_is_not_for_this_is_told_as_such(
    tabs: Tabs, closed: tuple[str, str], reader: str, file: Path, heard: Heard
) -> None:
    heard.allow("status of 40[13]")
    server, token = closed
    tab = tabs(server)
    dialog = tab.page.get_by_role("dialog")
    dialog.get_by_label("Token").fill(reader)
    dialog.get_by_label("Token").press("Enter")
    expect(tab.page.get_by_role("heading", name="Surfaces")).to_be_visible()
    tab.page.get_by_label("Files to upload").set_input_files(file)
    expect(dialog.get_by_role("heading")).to_have_text("This token does not allow that")
    dialog.get_by_label("Token").fill(token)
    dialog.get_by_label("Token").press("Enter")
    tab.page.get_by_role("link", name=file.stem, exact=True).wait_for()


def test_what_a_token_does_not_allow_is_no_longer_offered(
    tabs: Tabs, closed: tuple[str, str], reader: str, file: Path, heard: Heard
) -> None:
    heard.allow("status of 40[13]")
    server, token = closed
    Client(server, token=token).upload(surface("torus"))
    tab = tabs(server)
    dialog = tab.page.get_by_role("dialog")
    dialog.get_by_label("Token").fill(reader)
    dialog.get_by_label("Token").press("Enter")
    remove = tab.page.get_by_role("button", name="Delete torus", exact=True)
    expect(remove).to_be_visible()
    tab.page.get_by_label("Files to upload").set_input_files(file)
    dialog.get_by_role("button", name="Cancel").click()
    expect(remove).to_have_count(0)
    expect(tab.page.locator(".drop")).to_be_hidden()
    expect(tab.page.get_by_role("link", name="torus", exact=True)).to_be_visible()
    # What is taken is among the uploads at once, and stays there if it is refused.
    drop(tab, "other.npy", b"x" * 100, "body")
    expect(tab.page.locator(".uploads li .name")).to_have_text([file.name])
    assert not [url for url in heard.requests if "other.npy" in url]


def test_without_a_token_nothing_is_shown(tabs: Tabs, closed: tuple[str, str], heard: Heard) -> None:
    heard.allow("status of 401")
    tab = tabs(closed[0])
    tab.page.get_by_role("dialog").get_by_role("button", name="Cancel").click()
    expect(tab.page.locator(".message.error")).to_be_visible()
    expect(tab.page.locator("tbody tr")).to_have_count(0)
