"""Messages as bytes: what one side writes the other reads, and nothing else is taken for a message."""

from __future__ import annotations

from typing import Any

import msgpack
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from lodestream import Target, Tolerance, UnsupportedVersionError
from lodestream.protocol.messages import (
    BASE_CREDIT,
    CODES,
    MAX_DATA,
    MAX_HELD,
    MAX_MESSAGE,
    VERSION,
    Bye,
    Credit,
    End,
    Error,
    Event,
    Layer,
    MessageError,
    Open,
    Opened,
    Segments,
    Stop,
)
from lodestream.protocol.wire import parse, serialize

DIGEST = "0123456789abcdef" * 4

EVENTS: list[Event] = [
    Open(),
    Open(Target(level=3), 1000, ((0, 96), (200, 1)), DIGEST),
    Open(Target(region=((0, 3), (1, 5))), window_errors=True, decodes=True),
    Open(Target(region=((0, 3), (1, 5)), level=2), window_errors=True),
    Open(token="lode_dG9rZW4"),
    Open(Target(until_rms=Tolerance(1e-3, True), until_max=Tolerance(2.5), max_bytes=20000, order="level"), 0),
    Open(Target(until_rms={"speed": 0.1, "z": 2}, until_max={"speed": 1.5}, attributes=("speed",))),
    Open(Target(attributes=())),
    Credit(1),
    Stop(),
    Bye(),
    Opened(DIGEST, 2**40, 12345, 1e305, (2**39, 500), (13000, 1), True),
    Opened(DIGEST, 100, 90, 1.0, (90, 5), (80, 1), True, BASE_CREDIT + 1),
    Opened(DIGEST, 100, 90, 1.0, (90, 5), (80, 1), False, channels=True),
    Segments(7, bytes(range(256))),
    Segments(0, bytes(MAX_DATA)),
    Layer(0, 2, 96, 0.125, 3.5),
    End("complete"),
    Error("not-found", "No such surface", "expected one of ..., got é"),
]

PLACED = {"type": "header", "container": DIGEST, "size": 9, "planned": 1, "extent": 1.0, "index": [6, 3]}

integers = st.integers(0, 2**53)
places = st.tuples(integers, st.integers(1, 2**53))
numbers = st.floats(allow_nan=False, allow_infinity=False)
tolerances = st.none() | st.builds(Tolerance, st.floats(0, 1e300), st.booleans())
targets = (
    st.builds(Target, level=st.none() | integers)
    | st.builds(
        Target,
        until_rms=tolerances,
        until_max=tolerances,
        max_bytes=st.none() | st.integers(1, 2**53),
        order=st.sampled_from(["quality", "level"]),
    )
    | st.builds(
        Target,
        until_rms=st.dictionaries(st.text(max_size=8), st.floats(0, 1e300), max_size=4),
        until_max=st.dictionaries(st.text(max_size=8), st.floats(0, 1e300), max_size=4),
        max_bytes=st.none() | st.integers(1, 2**53),
    )
)
events = st.one_of(
    st.builds(Open, targets, integers, st.lists(places, max_size=5).map(tuple), st.none() | st.just(DIGEST)),
    st.builds(Credit, st.integers(1, 2**53)),
    st.builds(
        Opened,
        st.just(DIGEST),
        integers,
        integers,
        numbers,
        places,
        places,
        st.booleans(),
        st.none() | st.integers(BASE_CREDIT, 2**53),
    ),
    st.builds(Segments, integers, st.binary(min_size=1, max_size=300)),
    st.builds(Layer, integers, integers, integers, numbers, numbers),
    st.builds(End, st.text(max_size=20)),
    st.builds(Error, st.sampled_from(sorted(CODES)), st.text(max_size=20), st.text(max_size=20)),
)
plain = st.recursive(
    st.none()
    | st.booleans()
    | st.integers(-(2**63), 2**64 - 1)
    | st.floats()
    | st.text(max_size=8)
    | st.binary(max_size=8),
    lambda inner: st.lists(inner, max_size=4) | st.dictionaries(st.text(max_size=8), inner, max_size=4),
    max_leaves=12,
)


def packed(**fields: Any) -> bytes:
    data: bytes = msgpack.packb(fields)
    return data


@pytest.mark.parametrize("event", EVENTS, ids=lambda event: event.type)
def test_what_is_written_is_read(event: Event) -> None:
    assert parse(serialize(event)) == event


@settings(deadline=None)
@given(events)
def test_any_event_is_read_as_it_was_written(event: Event) -> None:
    assert parse(serialize(event)) == event


@pytest.mark.parametrize("event", EVENTS, ids=lambda event: event.type)
def test_unknown_keys_are_ignored(event: Event) -> None:
    fields = msgpack.unpackb(serialize(event))
    fields["from_the_future"] = [{"x": 1}]
    if "target" in fields:
        fields["target"]["roi"] = [0, 1, 0, 1]
    assert parse(packed(**fields)) == event


def test_seconds_do_not_travel() -> None:
    assert parse(serialize(Open(Target(seconds=3.0), 10))) == Open(Target(), 10)


def test_the_shortest_open_asks_for_everything() -> None:
    assert parse(packed(type="open", version=VERSION, credit=5)) == Open(Target(), 5)


def test_nil_is_the_same_as_absent_in_a_target() -> None:
    assert parse(packed(type="open", version=1, credit=5, target={"level": None, "order": None})) == Open(Target(), 5)


def test_whole_numbers_are_taken_where_a_float_is_meant() -> None:
    assert parse(packed(type="layer", number=0, level=0, bytes=1, rms=2, max=3)) == Layer(0, 0, 1, 2.0, 3.0)


@pytest.mark.parametrize(
    ("message", "expected"),
    [
        (b"", "MessagePack"),
        (b"\xc1", "MessagePack"),
        (b"GET / HTTP/1.1\r\n\r\n", "MessagePack"),
        (serialize(Stop()) + b"\x00", "MessagePack"),
        (serialize(Stop())[:-1], "MessagePack"),
        (b"\x81\xa4type\xa2\xff\xfe", "MessagePack"),
        (b"\x91" * 5000 + b"\xc0", "MessagePack"),
        (msgpack.packb([1, 2]), "map"),
        (packed(), "expected a type out of open, credit"),
        (packed(type="hello"), "'hello'"),
        (packed(type=["open"]), "expected a type"),
        (packed(type="credit"), r"expected credit\.bytes"),
        (msgpack.packb({"type": "credit", b"\xff": 1}), r"expected credit\.bytes"),
        (packed(type="credit", bytes=0), "from 1"),
        (packed(type="credit", bytes=-5), "from 1"),
        (packed(type="credit", bytes=True), "got True"),
        (packed(type="credit", bytes=1.0), "got 1.0"),
        (packed(type="credit", bytes=2**60), r"2\^53"),
        (packed(type="credit", bytes="é\n" * 999), r"got '\\xe9"),
        (packed(type="open", version=1), r"expected open\.credit"),
        (packed(type="open", credit=1), r"open\.version"),
        (packed(type="open", version="1", credit=1), r"open\.version"),
        (packed(type="open", version=1, credit=1, held=[[1]]), r"open\.held"),
        (packed(type="open", version=1, credit=1, held=[[0, 0]]), r"open\.held"),
        (packed(type="open", version=1, credit=1, target=[]), r"open\.target"),
        (packed(type="open", version=1, credit=1, target={"level": "2"}), r"target\.level"),
        (packed(type="open", version=1, credit=1, target={"until_rms": 0.1}), r"target\.until_rms"),
        (packed(type="open", version=1, credit=1, target={"until_max": [0.1, 1]}), r"target\.until_max"),
        (packed(type="open", version=1, credit=1, target={"channels": [["a", "rms"]]}), r"target\.channels"),
        (packed(type="open", version=1, credit=1, target={"channels": [["a", "mean", 1]]}), r"target\.channels"),
        (packed(type="open", version=1, credit=1, target={"channels": [[1, "rms", 1]]}), r"target\.channels"),
        (packed(type="open", version=1, credit=1, target={"channels": [["a", "rms", "1"]]}), r"target\.channels"),
        (packed(type="header", container="../../etc/passwd", size=1, planned=1, extent=1.0), r"header\.container"),
        (packed(type="header", container=DIGEST, size=1, planned=1, extent=float("nan")), r"header\.extent"),
        (packed(**PLACED, metadata=[5], prefix=True), r"header\.metadata"),
        (packed(**PLACED, metadata=[5, 0], prefix=True), r"header\.metadata"),
        (packed(**PLACED, metadata=[5, 1], prefix=1), r"header\.prefix"),
        (packed(type="open", version=1, credit=1, container="ab"), r"open\.container"),
        (packed(type="segments", offset=0, data=b""), r"segments\.data"),
        (packed(type="segments", offset=0, data="text"), r"segments\.data"),
        (packed(type="segments", offset=0, data=bytes(MAX_DATA + 1)), r"segments\.data"),
        (packed(type="end", why=b"complete"), r"end\.why"),
    ],
)
def test_what_is_not_a_message_is_refused(message: bytes, expected: str) -> None:
    with pytest.raises(MessageError, match=expected) as refused:
        parse(message)
    assert refused.value.code == "bad-message"
    assert len(str(refused.value)) < 400


@pytest.mark.parametrize(
    "target",
    [
        {"level": 1, "max_bytes": 5},
        {"order": "alphabetical"},
        {"order": "\u202e\x7f" * 2000},
        {"attributes": ["\u202eh\u00f6he" * 20] * 2},
        {"max_bytes": 0},
        {"until_rms": [-1.0, False]},
        {"channels": [["a", "rms", -1.0]]},
        {"channels": [["a", "rms", 1.0], ["a", "rms", 2.0]]},
        {"channels": [["a", "rms", 1.0]], "until_rms": [1.0, False]},
        {"channels": [["a", "rms", 1.0]], "until_max": [1.0, False]},
        {"channels": [["a", "rms", 1.0]], "region": [[0, 1], [0, 1]]},
    ],
)
def test_a_target_that_contradicts_itself_has_a_code_of_its_own(target: dict[str, Any]) -> None:
    with pytest.raises(MessageError) as refused:
        parse(packed(type="open", version=1, credit=1, target=target))
    assert refused.value.code == "bad-target"
    assert str(refused.value).isascii()
    assert len(str(refused.value)) < 1000


def test_the_longest_list_of_what_is_held_fits_into_a_message() -> None:
    held = tuple((2**50 + 2 * n, 2**20) for n in range(MAX_HELD))
    message = serialize(Open(Target(until_rms=Tolerance(1e-300)), 1, held, DIGEST, "x" * 200))
    assert len(message) <= MAX_MESSAGE
    assert parse(message) == Open(Target(until_rms=Tolerance(1e-300)), 1, held, DIGEST, "x" * 200)


def test_a_longer_list_is_refused_by_its_length() -> None:
    held = tuple((2 * n, 1) for n in range(MAX_HELD + 1))
    with pytest.raises(MessageError, match=f"at most {MAX_HELD} ranges, got {MAX_HELD + 1}") as refused:
        parse(serialize(Open(held=held)))
    assert refused.value.code == "bad-held"


def test_a_message_above_the_limit_is_refused_before_it_is_read() -> None:
    with pytest.raises(MessageError, match=str(MAX_MESSAGE)) as refused:
        parse(bytes(MAX_MESSAGE + 1))
    assert refused.value.code == "message-too-large"


def test_the_largest_message_is_below_the_limit() -> None:
    assert len(serialize(Segments(2**53, bytes(MAX_DATA)))) <= MAX_MESSAGE


def test_another_version_is_named_beside_ours() -> None:
    with pytest.raises(UnsupportedVersionError, match=r"version 1.*version 2"):
        parse(packed(type="open", version=2, something="else"))


def outcome(message: bytes) -> Event | str:
    """The event, or the code of the refusal; anything else that is raised fails the test."""
    try:
        return parse(message)
    except MessageError as error:
        return error.code
    except UnsupportedVersionError:
        return "unsupported-version"


@settings(deadline=None)
@given(st.binary(max_size=200))
def test_garbage_is_read_or_refused(message: bytes) -> None:
    got = outcome(message)
    assert got in CODES if isinstance(got, str) else parse(serialize(got)) == got


@settings(deadline=None)
@given(
    st.sampled_from(EVENTS),
    st.dictionaries(st.sampled_from(["type", "version", "credit", "target", "held", "bytes", "size"]), plain),
)
def test_any_value_in_any_field_is_read_or_refused(event: Event, changes: dict[str, Any]) -> None:
    fields = msgpack.unpackb(serialize(event)) | changes
    got = outcome(packed(**fields))
    assert got in CODES if isinstance(got, str) else got.type == fields["type"]


@settings(deadline=None)
@given(st.sampled_from(EVENTS), st.data())
def test_a_message_with_one_byte_changed_is_read_or_refused(event: Event, data: st.DataObject) -> None:
    message = bytearray(serialize(event))
    message[data.draw(st.integers(0, min(len(message), 200) - 1))] = data.draw(st.integers(0, 255))
    got = outcome(bytes(message))
    assert not isinstance(got, str) or got in CODES


def test_of_a_key_that_a_message_has_twice_the_last_value_counts() -> None:
    """As docs/protocol.md says; the client for browsers is tested likewise."""
    for values in ((1, 2), (2, 1), (-1, 7)):
        message = b"\x83" + b"".join(
            msgpack.packb(key) + msgpack.packb(value)
            for key, value in (("bytes", values[0]), ("type", "credit"), ("bytes", values[1]))
        )
        assert parse(message) == Credit(values[1])
    with pytest.raises(MessageError, match=r"credit\.bytes"):
        parse(b"\x83\xa5bytes\x01\xa5bytes\xff\xa4type\xa6credit")
