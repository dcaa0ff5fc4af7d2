"""A comm that keeps what is sent, in place of a kernel's."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import lodestream as ls
from lodestream import page


@dataclass
class Page:
    """The page's side of a widget's comm.

    Attributes
    ----------
    heard : list of (dict, list of bytes)
        Messages of the widget, in their order.
    """

    heard: list[tuple[dict[str, Any], list[bytes]]] = field(default_factory=list)

    def ask(self, widget: Any, question: Any) -> None:
        """Send a message to a widget, as a kernel gives it on."""
        data = {"method": "custom", "content": question}
        widget.comm.handle_msg({"content": {"data": data}, "buffers": []})

    def set(self, widget: Any, **values: Any) -> None:
        """Change values of a widget."""
        data = {"method": "update", "state": values, "buffer_paths": []}
        widget.comm.handle_msg({"content": {"data": data}, "buffers": []})

    @property
    def opening(self) -> dict[str, Any]:
        """Values of the last widget as it was made; its layout is a widget too."""
        states: list[dict[str, Any]] = [data.get("state", {}) for data, _ in self.heard]
        return [state for state in states if "_esm" in state][-1]

    @property
    def custom(self) -> list[tuple[dict[str, Any], list[bytes]]]:
        """Messages beside values."""
        return [(data["content"], buffers) for data, buffers in self.heard if data.get("method") == "custom"]


@pytest.fixture
def fake_page(monkeypatch: pytest.MonkeyPatch) -> Page:
    comm = pytest.importorskip("comm")
    pytest.importorskip("anywidget")
    from comm.base_comm import BaseComm

    heard = Page()

    class Comm(BaseComm):
        def publish_msg(
            self, msg_type: str, data: Any = None, metadata: Any = None, buffers: Any = None, **keys: Any
        ) -> None:
            kind = {"comm_close": {"method": "close"}}.get(msg_type, data or {})
            heard.heard.append((kind, [bytes(one) for one in buffers or []]))

    monkeypatch.setattr(comm, "create_comm", Comm)
    return heard


@pytest.fixture
def built(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Modules as `make page` leaves them; the text of the element is its name."""
    folder = tmp_path / "static"
    (folder / "assets").mkdir(parents=True)
    (folder / "notebook.js").write_text("export default {}")
    (folder / "assets" / "view-0a.js").write_text("element")
    found = page.widget_modules(folder)
    monkeypatch.setattr(page, "widget_modules", lambda: found)
    return folder


@pytest.fixture(scope="session")
def terrain() -> ls.Surface:
    """Heights of 90 by 120 points with a scalar and a vector beside them."""
    random = np.random.default_rng(3)
    heights = np.add.outer(np.sin(np.arange(90) / 9), np.cos(np.arange(120) / 7)) * 40
    attributes = {"rain": random.normal(size=(90, 120)), "wind": random.normal(size=(90, 120, 2))}
    return ls.Surface(heights, attributes=attributes, metadata={"name": "hills"})


@pytest.fixture(scope="session")
def container(terrain: ls.Surface) -> bytes:
    return ls.encode(terrain)
