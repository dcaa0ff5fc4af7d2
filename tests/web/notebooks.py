"""A page that shows widgets as a notebook does, with the kernel in the process of the tests.

It is what anywidget asks of a page, and no more: each widget's module is loaded from its text, `render` is called for
each place, values and messages go both ways. No port is opened: the browser is given the page's text.
"""

from __future__ import annotations

import base64
from collections.abc import Callable
from typing import Any

from playwright.sync_api import Locator, Page, expect

from .browser import goes_on, until

__all__ = ["Notebook"]

ADDRESS = "http://127.0.0.1/notebook"

_PAGE = """<!doctype html><html lang="en"><meta charset="utf-8"><title>Notebook</title>
<link rel="icon" href="data:,"><style>body { margin: 8px }</style><body></body></html>"""

_HOST = """
window.models = {};
window.asked = [];
window.held = null;
const bytes = (text) => Uint8Array.from(atob(text), (letter) => letter.charCodeAt(0));
class Model {
  constructor(id, state) { Object.assign(this, { id, state, heard: {}, changed: new Set() }); }
  get(name) { return this.state[name]; }
  set(name, value) {
    if (JSON.stringify(this.state[name]) === JSON.stringify(value)) return;
    this.state[name] = value;
    this.changed.add(name);
    this.trigger(`change:${name}`);
  }
  save_changes() {
    const values = Object.fromEntries([...this.changed].map((name) => [name, this.state[name]]));
    this.changed.clear();
    if (Object.keys(values).length > 0) void window.toKernel(this.id, { method: "update", state: values });
  }
  on(name, callback) { (this.heard[name] ??= new Set()).add(callback); }
  off(name, callback) { this.heard[name]?.delete(callback); }
  trigger(name, ...given) { for (const callback of [...this.heard[name] ?? []]) callback(...given); }
  async send(content) {
    window.asked.push(content);
    while (window.held !== null && content.kind === "read") {
      if (window.held > 0) { window.held -= 1; break; }
      await new Promise((resolve) => setTimeout(resolve, 20));
    }
    for (const answer of await window.toKernel(this.id, { method: "custom", content })) this.deliver(answer);
  }
  deliver({ content, buffers, state }) {
    if (state !== undefined) {
      for (const [name, value] of Object.entries(state)) {
        this.state[name] = value;
        this.trigger(`change:${name}`);
      }
    } else this.trigger("msg:custom", content, buffers.map((text) => new DataView(bytes(text).buffer)));
  }
}
window.show = async (id, state) => {
  const model = (window.models[id] ??= new Model(id, state));
  const url = URL.createObjectURL(new Blob([model.get("_esm")], { type: "text/javascript" }));
  const { default: widget } = await import(url);
  URL.revokeObjectURL(url);
  const el = document.createElement("div");
  document.body.append(el);
  const end = await widget.render({ model, el });
  (window.ends ??= []).push(() => { end(); el.remove(); });
};
"""


class Notebook:
    """Widgets in one page.

    Parameters
    ----------
    page : Page
        Of the browser.
    heard : list
        Where messages of all widgets are kept, see `tests.client.notebook.conftest.Page`.
    """

    def __init__(self, page: Page, heard: list[tuple[dict[str, Any], list[bytes]]]) -> None:
        self.page = page
        self._heard = heard
        self._widgets: dict[str, Any] = {}
        page.route(ADDRESS, lambda route: route.fulfill(body=_PAGE, content_type="text/html"))
        page.expose_function("toKernel", self._take)
        page.add_init_script(_HOST)
        page.goto(ADDRESS)

    def show(self, widget: Any) -> Locator:
        """Show a widget in one more place."""
        self._widgets[widget.model_id] = widget
        number = self.page.locator("lodestream-view").count()
        # Layouts are for programs of notebooks.
        state = {key: value for key, value in widget.get_state().items() if key != "layout"}
        self.page.evaluate("([id, state]) => window.show(id, state)", [widget.model_id, state])
        return self.page.locator("lodestream-view").nth(number)

    def told(self, widget: Any, since: int) -> None:
        """Give the page what a widget has said by itself since then, see `count`."""
        for message in self._since(since):
            self.page.evaluate("([id, message]) => window.models[id].deliver(message)", [widget.model_id, message])

    @property
    def count(self) -> int:
        """Messages so far."""
        return len(self._heard)

    def until(self, true: Callable[[], object]) -> None:
        """Wait for something; the page's messages are taken meanwhile."""
        until(self.page, true)

    def everything(self, view: Locator) -> None:
        """Wait for an exact surface in a place."""
        self.until(lambda: goes_on(view) and view.locator(".status").inner_text() == "Complete: exact")

    def questions(self) -> list[dict[str, Any]]:
        """Which bytes were asked for, once the page and its workers have nothing to do but to wait for answers."""
        asked: list[dict[str, Any]] = []
        quiet = 0
        while quiet < 10:
            for thread in (*self.page.workers, self.page):
                thread.evaluate("() => new Promise((resolve) => setTimeout(resolve))")
            before, asked = asked, self.page.evaluate("window.asked.filter(({ kind }) => kind === 'read')")
            quiet = quiet + 1 if asked == before else 0
        return asked

    def status(self, view: Locator, text: str) -> None:
        """Wait for a status."""
        expect(view.locator(".status")).to_have_text(text)

    def _take(self, model: str, data: dict[str, Any]) -> list[dict[str, Any]]:
        since = self.count
        self._widgets[model].comm.handle_msg({"content": {"data": {"buffer_paths": [], **data}}, "buffers": []})
        return [message for message in self._since(since) if "content" in message]

    def _since(self, since: int) -> list[dict[str, Any]]:
        messages: list[dict[str, Any]] = []
        for data, buffers in self._heard[since:]:
            if data.get("method") == "custom":
                coded = [base64.b64encode(one).decode() for one in buffers]
                messages.append({"content": data["content"], "buffers": coded})
            elif data.get("method") == "update":
                messages.append({"state": data["state"]})
        return messages
