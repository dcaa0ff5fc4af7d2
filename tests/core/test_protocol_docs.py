"""`docs/protocol.md` says what the code does."""

from __future__ import annotations

import re
from pathlib import Path

from lodestream import Target
from lodestream.messages import CODES, MAX_CREDIT, MAX_DATA, MAX_MESSAGE, VERSION, Open
from lodestream.protocol import TRANSITIONS
from lodestream.wire import _FIELDS, serialize

DOCS = (Path(__file__).parents[2] / "docs" / "protocol.md").read_text()


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
    for number in (MAX_CREDIT, MAX_DATA, MAX_MESSAGE):
        assert f"{number:,}" in DOCS
    assert f"`version`, which is {VERSION};" in DOCS


def test_the_first_message_byte_by_byte() -> None:
    listing = DOCS.partition("## A first message, byte by byte")[2]
    data = bytes.fromhex("".join(re.findall(r"^    ((?: *[0-9a-f]{2}\b)+)", listing, re.MULTILINE)))
    assert data == serialize(Open(Target(level=2), 1000))
