"""`docs/protocol.md` says what the code does."""

from __future__ import annotations

import re
from itertools import pairwise

from lodestream.protocol.connection import TRANSITIONS
from lodestream.protocol.messages import (
    BASE_CREDIT,
    CODES,
    MAX_CREDIT,
    MAX_DATA,
    MAX_HELD,
    MAX_MESSAGE,
    MIN_WINDOW,
    VERSION,
    Segments,
)
from lodestream.protocol.wire import _FIELDS, parse

from .exchange import CONTAINER, record, render
from .exchange import DOCS as PAGE

DOCS = PAGE.read_text()


def table(*header: str) -> list[list[str]]:
    """The rows of the table with these headings."""
    lines = DOCS.splitlines()
    start = lines.index(f"| {' | '.join(header)} |") + 2
    rows = []
    for line in lines[start:]:
        if not line.startswith("|"):
            break
        rows.append([cell.strip() for cell in line.strip("|").split("|")])
    return rows


def test_messages_and_their_fields() -> None:
    documented = {row[1].strip("`"): set(re.findall(r"`(\w+)`", row[2])) for row in table("from", "type", "fields")}
    assert documented == {kind.type: set(fields) for kind, fields in _FIELDS.items()}


def test_turns() -> None:
    documented = [tuple(row) for row in table("side", "state", "sends", "receives")]
    assert documented == [
        (
            side.value,
            state.value,
            *(", ".join(f"`{kind.type}` → {after.value}" for kind, after in moves.items()) for moves in both),
        )
        for side, states in TRANSITIONS.items()
        for state, both in states.items()
    ]


def test_codes() -> None:
    documented = [tuple(row) for row in table("code", "close code", "title")]
    assert documented == [(f"`{word}`", str(code.close), code.title) for word, code in CODES.items()]


def test_limits() -> None:
    for number in (BASE_CREDIT, MAX_CREDIT, MAX_DATA, MAX_MESSAGE, MAX_HELD, MIN_WINDOW):
        assert f"{number:,}" in DOCS
    assert f"`version`, which is {VERSION};" in DOCS


def test_the_exchange_is_what_both_ends_say() -> None:
    assert render(DOCS) == DOCS, "python -m tests.core.protocol.exchange writes it anew"


def test_the_exchange_has_every_byte_of_the_surface_once() -> None:
    listing = DOCS.partition("<!-- recorded -->")[2]
    messages = [bytes.fromhex(block) for block in re.findall(r"(?m)^((?: {4}[0-9a-f ]+\n)+)", listing)]
    assert messages == [message for _, message in record(CONTAINER.read_bytes()) if message]
    slices = [event for event in map(parse, messages) if isinstance(event, Segments)]
    container = CONTAINER.read_bytes()
    assert all(container[event.offset :].startswith(event.data) for event in slices)
    assert slices[0].offset == 0
    assert all(one.offset + len(one.data) == other.offset for one, other in pairwise(slices))
