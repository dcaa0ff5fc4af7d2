"""The first message in an address: there and back, and whatever may stand there instead."""

from __future__ import annotations

import re

import pytest
from hypothesis import given
from hypothesis import strategies as st

from lodestream.protocol.handshake import MAX_OPENING, from_address, to_address
from lodestream.protocol.messages import MessageError, Open
from lodestream.protocol.wire import serialize
from lodestream.transfer.download import Download
from lodestream.transfer.receiver_state import ReceiverState

LONGEST = MAX_OPENING * 3 // 4


@given(st.binary(max_size=LONGEST))
def test_a_message_is_the_same_there_and_back(message: bytes) -> None:
    query = to_address(message)
    assert query is not None
    name, _, text = query.partition("=")
    assert name == "open"
    assert re.fullmatch("[A-Za-z0-9_-]*", text), "nothing that an address would change"
    assert from_address(text) == message
    assert from_address(text + "=" * (-len(text) % 4)) == message


def test_a_message_that_is_too_long_goes_as_a_message() -> None:
    assert to_address(bytes(LONGEST)) is not None
    assert to_address(bytes(LONGEST + 1)) is None
    assert to_address(serialize(Open(held=tuple((8 * n, 4) for n in range(1000)), container="ab" * 32))) is None


@pytest.mark.parametrize(
    ("text", "code"),
    [
        ("A", "bad-message"),
        ("AAAAA", "bad-message"),
        ("AA AA", "bad-message"),
        ("AA=A", "bad-message"),
        ("grün", "bad-message"),
        ("\0", "bad-message"),
        ("A" * (MAX_OPENING + 1), "message-too-large"),
    ],
)
def test_what_is_no_message_is_refused(text: str, code: str) -> None:
    with pytest.raises(MessageError) as caught:
        from_address(text)
    assert caught.value.code == code


def test_a_download_says_open_once() -> None:
    download = Download()
    download.opened(0.0)
    assert download.data_to_send() == []
    download = Download(reception=ReceiverState())
    assert download.data_to_send() == [download.opening]
