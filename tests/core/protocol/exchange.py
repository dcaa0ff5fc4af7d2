"""An exchange as recorded in docs/protocol.md; ``python -m tests.core.protocol.exchange`` writes it there anew."""

from __future__ import annotations

import hashlib
import textwrap
from collections.abc import Iterator
from dataclasses import fields
from pathlib import Path

from lodestream.protocol.connection import State
from lodestream.protocol.messages import Bye, Event, Open, Segments
from lodestream.protocol.wire import parse
from lodestream.target import Target
from lodestream.transfer.download import Download
from lodestream.transfer.sender import Sender

from ..surfaces import index_of

DOCS = Path(__file__).parents[3] / "docs" / "protocol.md"
CONTAINER = Path(__file__).parents[2] / "golden" / "two-points.lode"
BEGIN, END = "<!-- recorded -->\n", "<!-- recorded until here -->\n"

_WINDOW = 48
_LOST_AFTER = 2


def record(container: bytes) -> Iterator[tuple[str, bytes]]:
    """Who sends what, message by message: a connection that breaks, and one that goes on."""
    sha256 = hashlib.sha256(container).hexdigest()
    download = Download(Target(), window=_WINDOW)
    yield from _connection(download, Sender(index_of(container), sha256), container, _LOST_AFTER)
    yield "lost", b""
    again = Download(reception=download.reception, window=_WINDOW)
    yield from _connection(again, Sender(index_of(container), sha256), container, None)
    assert again.ended == "complete"
    assert again.reception.data_bytes == again.reception.cached.total


def _connection(download: Download, sender: Sender, container: bytes, most: int | None) -> Iterator[tuple[str, bytes]]:
    """Messages of one connection, which breaks after so many of the server's."""
    while sender.state is not State.CLOSED:
        for message in download.data_to_send():
            sender.receive(message)
            yield "client", message
        answer = sender.next_message()
        if answer is None:
            wanted = sender.wanted()
            if wanted is not None:
                sender.provide(wanted, container[wanted.offset : wanted.end])
            continue
        if most == 0:
            return
        most = None if most is None else most - 1
        yield "server", answer
        download.receive(answer)


def listing() -> str:
    """The recording as it stands in the page."""
    lines = []
    for side, message in record(CONTAINER.read_bytes()):
        if side == "lost":
            lines.append("the connection breaks; a new one:\n")
            continue
        event = parse(message)
        lines.append(f"{side}: {event.type} {_told(event)}".rstrip())
        lines.append(textwrap.fill(message.hex(" "), 101, initial_indent="    ", subsequent_indent="    "))
        lines.append("")
    return "\n".join(lines)


def _told(event: Event) -> str:
    """The fields of a message for people; data are told by their length."""
    if isinstance(event, Bye):
        return ""
    told = []
    for field in fields(event):
        value = getattr(event, field.name)
        if isinstance(event, Segments) and field.name == "data":
            value = f"{len(event.data)} bytes"
        if value is None or (isinstance(event, Open) and field.name == "target"):
            continue
        if field.name == "container":
            value = f"{value[:8]}..."
        told.append(f"{field.name}={list(map(list, value)) if field.name == 'held' else value}")
    return " ".join(told)


def render(page: str) -> str:
    """The page with the recording in its place."""
    before, _, rest = page.partition(BEGIN)
    _, _, after = rest.partition(END)
    return f"{before}{BEGIN}\n```text\n{listing()}```\n\n{END}{after}"


if __name__ == "__main__":
    DOCS.write_text(render(DOCS.read_text()))
