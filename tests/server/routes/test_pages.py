"""The pages that a browser is shown: whole, without a script, and with nothing from another host."""

from __future__ import annotations

import asyncio
import base64
import hashlib
import re
from html.parser import HTMLParser
from pathlib import Path

import httpx
import pytest

from lodestream import page
from lodestream_server import Settings, create_app
from lodestream_server.routes.documentation import render
from lodestream_server.routes.html_page import html_page

PAGES = ["/", "/docs"]


class Reader(HTMLParser):
    """What a page loads, leads to and shows."""

    def __init__(self, page: str) -> None:
        super().__init__()
        self.tags = set[str]()
        self.attributes: list[tuple[str, str | None]] = []
        self.text = ""
        self.feed(page)

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.tags.add(tag)
        self.attributes += attrs

    def handle_data(self, data: str) -> None:
        self.text += data


@pytest.fixture(scope="module")
def pages() -> dict[str, httpx.Response]:
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(page, "assets", dict)  # as where the page of the browser is not built
        return asked(*PAGES, "/openapi.json")


def asked(*paths: str, headers: dict[str, str] | None = None) -> dict[str, httpx.Response]:
    """The answers of a server to these paths."""
    app = create_app(Settings(data=Path("nowhere")))

    async def ask() -> dict[str, httpx.Response]:
        async with httpx.AsyncClient(transport=httpx.ASGITransport(app), base_url="http://localhost") as http:
            return {path: await http.get(path, headers=headers) for path in paths}

    return asyncio.run(ask())


def test_a_page_that_is_not_built_says_how(pages: dict[str, httpx.Response]) -> None:
    assert page.HOW_TO_BUILD in Reader(pages["/"].text).text


def test_the_page_is_told_that_it_is_the_page_of_a_server() -> None:
    (answer,) = asked("/view.json").values()
    assert (answer.status_code, answer.json()) == (200, {})


def test_the_page_of_the_browser_is_served_with_a_policy(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "assets").mkdir()
    (tmp_path / page.INDEX).write_text("<!doctype html><title>page</title>")
    (tmp_path / "assets" / "main-1.js").write_text("export {}")
    (tmp_path / "assets" / "kernels-1.wasm").write_bytes(b"\0asm")
    built = page.assets(tmp_path)
    monkeypatch.setattr(page, "assets", lambda: built)
    paths = "/", "/assets/main-1.js", "/assets/kernels-1.wasm", "/assets/nothing.js", "/assets/..%2findex.html"
    home, script, kernels, *others = asked(*paths).values()
    for answer, media_type in (
        (home, "text/html; charset=utf-8"),
        (script, "text/javascript; charset=utf-8"),
        (kernels, "application/wasm"),
    ):
        assert (answer.status_code, answer.headers["content-type"]) == (200, media_type)
        assert {key: answer.headers[key] for key in page.HEADERS} == page.HEADERS
    assert "immutable" in script.headers["cache-control"]
    assert home.headers["cache-control"] == "no-cache"
    assert [answer.status_code for answer in others] == [404, 404]
    assert asked("/view.json")["/view.json"].json() == {}  # it is this server's surfaces that the page shows
    again = asked("/", headers={"if-none-match": home.headers["etag"]})["/"]
    assert (again.status_code, again.content) == (304, b"")
    assert again.headers["content-security-policy"] == page.HEADERS["content-security-policy"]


@pytest.mark.parametrize("path", PAGES)
def test_a_page_loads_nothing_from_another_host(pages: dict[str, httpx.Response], path: str) -> None:
    page = pages[path]
    assert page.headers["content-type"].startswith("text/html")
    # No host is named at all, in no attribute and in no style; nor is anything loaded from this one.
    assert "//" not in page.text
    found = Reader(page.text)
    assert not found.tags & {"script", "link", "img", "iframe", "object", "embed", "base", "form", "video", "audio"}
    assert not any(name.startswith("on") or name in ("src", "srcset", "style") for name, _ in found.attributes)
    targets = {value for name, value in found.attributes if name == "href"}
    assert targets == ({"v1/surfaces", "docs"} if path == "/" else {"/openapi.json"})


@pytest.mark.parametrize("path", PAGES)
def test_a_page_has_a_policy_that_lets_its_own_style_alone_in(pages: dict[str, httpx.Response], path: str) -> None:
    page = pages[path]
    policy = dict(part.strip().split(" ", 1) for part in page.headers["content-security-policy"].split(";"))
    assert policy["default-src"] == policy["base-uri"] == policy["frame-ancestors"] == "'none'"
    styles = re.findall(r"<style>(.*?)</style>", page.text, re.DOTALL)
    assert len(styles) == 1
    digest = base64.b64encode(hashlib.sha256(styles[0].encode()).digest()).decode()
    assert policy["style-src"] == f"'sha256-{digest}'"
    assert set(policy) == {"default-src", "style-src", "base-uri", "form-action", "frame-ancestors"}
    assert page.headers["x-content-type-options"] == "nosniff"


def test_the_page_tells_every_operation_with_its_parameters_and_answers(pages: dict[str, httpx.Response]) -> None:
    text = Reader(pages["/docs"].text).text
    document = pages["/openapi.json"].json()
    assert document["paths"]
    for path, operations in document["paths"].items():
        for method, operation in operations.items():
            start = text.index(f"{method.upper()} {path} {operation['summary']}")
            shown = text[start:]
            for parameter in operation.get("parameters", ()):
                assert parameter["name"] in shown, (path, parameter["name"])
            for status, answer in operation["responses"].items():
                assert status in shown
                assert answer["description"] in shown


def test_what_stands_in_the_document_is_text_and_no_html() -> None:
    operation = {
        "tags": ["<i>"],
        "summary": "<script>a</script>",
        "description": "`<b>` & ``c``\n\nd",
        "parameters": [{"name": "<u>", "in": "<s>", "description": "<em>", "schema": {"enum": ["<q>"]}}],
        "responses": {"200": {"description": "<p>", "content": {"<a>": {"schema": {"$ref": "#/<m>"}}}}},
    }
    model = {"description": "<o>", "properties": {"<k>": {"type": "<y>"}}, "examples": [{"x": "<z>"}]}
    document = {
        "info": {"title": "<t>", "version": "1", "description": "<d>"},
        "paths": {"/<x>": {"get": operation}},
        "components": {"schemas": {"<n>": model}},
    }
    page = bytes(html_page("<t>", render(document, '/"><a>')).body).decode()
    for word in (*"itdxmnokyzbusq", "script", "em"):
        assert f"<{word}>" not in page.lower(), word
    assert "<p><code>&lt;b&gt;</code> &amp; <code>c</code></p>\n<p>d</p>" in page
    assert 'href="/&quot;&gt;&lt;a&gt;"' in page
    assert '"x": "&lt;z&gt;"' in page


def test_the_document_says_where_a_proxy_shows_it() -> None:
    app = create_app(Settings(data=Path("nowhere")))

    async def ask() -> tuple[httpx.Response, httpx.Response]:
        transport = httpx.ASGITransport(app, root_path="/maps")
        async with httpx.AsyncClient(transport=transport, base_url="http://localhost") as http:
            return await http.get("/maps/docs"), await http.get("/maps/openapi.json")

    page, document = asyncio.run(ask())
    assert 'href="/maps/openapi.json"' in page.text
    assert document.json()["servers"] == [{"url": "/maps"}]
