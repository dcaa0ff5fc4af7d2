"""LZF against a decoder in plain Python, and what it refuses."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from lodestream import kernels
from lodestream.errors import FormatError
from lodestream.formats.pcd import lzf
from lodestream.formats.pcd.lzf import decompress


@pytest.mark.parametrize(
    ("content", "made"),
    [
        (b"\x02abc", b"abc"),
        (b"\x00a\x20\x00", b"aaaa"),
        (b"\x01ab\xe0\x05\x01", b"ab" * 8),
        (b"\x02abc\x40\x02\x00x", b"abcabcax"),
    ],
)
def test_lzf(content: bytes, made: bytes) -> None:
    assert decompress(content, len(made)).tobytes() == made
    for size in (len(made) - 1, len(made) + 1):
        with pytest.raises(FormatError, match="LZF data that make"):
            decompress(content, size)
    for room in range(len(made)):
        target, state = np.full(len(made), 77, np.uint8), np.zeros(2, np.int64)
        assert kernels.lzf(np.frombuffer(content, np.uint8), target[:room], 1000, state) == 0
        assert (target[room:] == 77).all()
    for cut in range(1, len(content)):
        with pytest.raises(FormatError, match="LZF data that make"):
            decompress(content[:cut], len(made))


def plain_lzf(content: bytes) -> bytes | None:
    """What LZF data make, byte by byte; None where they are damaged."""
    made, place = bytearray(), 0
    try:
        while place < len(content):
            control, place = content[place], place + 1
            if control < 32:
                if place + control + 1 > len(content):
                    return None
                made += content[place : place + control + 1]
                place += control + 1
                continue
            length = control >> 5
            if length == 7:
                length, place = length + content[place], place + 1
            start, place = len(made) - 256 * (control & 31) - content[place] - 1, place + 1
            if start < 0:
                return None
            for _ in range(length + 2):
                made.append(made[start])
                start += 1
    except IndexError:
        return None
    return bytes(made)


LITERALS = st.binary(min_size=1, max_size=32).map(lambda run: bytes([len(run) - 1]) + run)
REFERENCES = st.builds(
    lambda length, more, distance: (
        bytes([length << 5 | distance >> 8]) + (bytes([more]) if length == 7 else b"") + bytes([distance & 255])
    ),
    st.integers(1, 7),
    st.integers(0, 255),
    st.one_of(st.integers(0, 31), st.integers(0, 31), st.integers(0, 8191)),
)


#: The first kind begin with bytes that can be referred to.
CONTENTS = st.one_of(
    st.lists(st.one_of(LITERALS, REFERENCES), max_size=40).map(
        lambda runs: b"\x1f" + bytes(range(32)) + b"".join(runs)
    ),
    st.binary(max_size=200),
)


@given(data=CONTENTS, cut=st.integers(0, 3), at_once=st.integers(1, 300), more=st.integers(-1, 1))
def test_lzf_makes_what_a_plain_loop_makes_in_any_runs(data: bytes, cut: int, at_once: int, more: int) -> None:
    content = data[: len(data) - cut]
    expected = plain_lzf(content)
    size = max(0, (100 if expected is None else len(expected)) + more)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(lzf, "_AT_ONCE", at_once)
        if expected is not None and len(expected) == size:
            assert decompress(content, size).tobytes() == expected
        else:
            with pytest.raises(FormatError, match="LZF data that make"):
                decompress(content, size)


@given(data=CONTENTS, more=st.integers(-3, 1))
def test_lzf_writes_nowhere_else_and_knows_what_is_damaged(data: bytes, more: int) -> None:
    expected = plain_lzf(data)
    room = 60_000 if expected is None else max(0, len(expected) + more)
    whole, state = np.full(room + 600, 77, np.uint8), np.zeros(2, np.int64)
    target = whole[300 : 300 + room]
    right = kernels.lzf(np.frombuffer(data, np.uint8), target, 1 << 20, state)
    assert right == (expected is not None and len(expected) <= room)
    if expected is not None and right:
        assert state.tolist() == [len(data), len(expected)]
        assert target[: len(expected)].tobytes() == expected
    assert (whole[:300] == 77).all()
    assert (whole[300 + room :] == 77).all()


@pytest.mark.parametrize("content", [b"\x20\x00", b"\x00a\x20\x01", b"\x02abc\x21\x00", b"\x02abc\xe0\x00\x03"])
def test_a_reference_to_before_the_first_byte_is_damage(content: bytes) -> None:
    target, state = np.zeros(900, np.uint8), np.zeros(2, np.int64)
    assert kernels.lzf(np.frombuffer(content, np.uint8), target, 1 << 20, state) == 0


@pytest.mark.parametrize("state", [[-1, 0], [0, -1], [6, 0], [0, 5], [2**62, 2**62], [0], [0, 0, 0]])
def test_an_lzf_state_that_does_not_fit_is_refused(state: list[int]) -> None:
    source, target = np.zeros(5, np.uint8), np.zeros(4, np.uint8)
    with pytest.raises(ValueError, match="do not fit"):
        kernels.lzf(source, target, 1, np.array(state, np.int64))
    with pytest.raises(ValueError, match="do not fit"):
        kernels.lzf(source, target, -1, np.zeros(2, np.int64))
