"""Which transport is tried next, and after how long."""

from __future__ import annotations

import pytest
from websockets.datastructures import Headers
from websockets.exceptions import InvalidHandshake, InvalidStatus
from websockets.http11 import Response

import lodestream as ls
from lodestream.errors import LodestreamError, RemoteError
from lodestream_client.errors import SilenceError, UnreachableError
from lodestream_client.stream.reconnecting import Transport, Transports

ONE, FILE = "http://one/v1/surfaces/ab", "http://three/ab.lode"
LOST = UnreachableError("no connection")


def caused(error: LodestreamError, cause: Exception) -> LodestreamError:
    error.__cause__ = cause
    return error


def refused(status: int, body: bytes) -> LodestreamError:
    response = Response(status, "No", Headers(), body)
    return caused(RemoteError(f"http-{status}", "no"), InvalidStatus(response))


@pytest.fixture(autouse=True)
def without_chance(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("random.uniform", lambda least, most: most / 2)


def transport(made: Transports) -> str:
    return made.transport


def met(url: str, deadline: float = 60.0) -> Transports:
    made = Transports(url, "auto", deadline)
    made.met = True
    made.start(0.0)
    return made


def test_waits_grow_until_something_comes() -> None:
    made = met(ONE)
    assert [made.failed(LOST, 0.0, progressed=False) for _ in range(3)] == [0.2, 0.4, 0.8]
    assert made.failed(LOST, 5.0, progressed=True) == 0.2
    assert made.failed(LOST, 5.0, progressed=False) == 0.4


def test_a_transport_that_leads_nowhere_is_left_for_the_other() -> None:
    made = met(ONE)
    made.failed(LOST, 0.0, progressed=True)
    assert transport(made) == "ws"
    made.failed(SilenceError("nothing"), 0.0, progressed=False)
    assert transport(made) == "http"
    made.failed(LOST, 0.0, progressed=False)
    assert transport(made) == "ws"


def test_only_the_transports_that_are_allowed() -> None:
    only: tuple[Transport, ...] = ("ws", "http")
    for kind in only:
        made = Transports(ONE, kind, 60.0)
        made.met = True
        for _ in range(3):
            assert transport(made) == kind
            made.failed(LOST, 0.0, progressed=False)
    made = Transports(FILE, "auto", 60.0)
    assert transport(made) == "http"


def test_the_deadline_counts_from_the_loss() -> None:
    made = met(ONE, deadline=10.0)
    assert made.failed(LOST, 9.0, progressed=False) > 0
    with pytest.raises(UnreachableError):
        made.failed(LOST, 9.9, progressed=False)
    # Whoever thought for an hour over a view has lost nothing by it.
    assert made.failed(LOST, 3600.0, progressed=True) > 0
    assert made.failed(LOST, 3609.0, progressed=False) > 0
    with pytest.raises(UnreachableError):
        made.failed(LOST, 3609.9, progressed=False)


@pytest.mark.parametrize("body", [b"", b"<html>", b"[]"])
def test_a_proxy_that_refuses_sockets_is_gone_around_at_once(body: bytes) -> None:
    made = Transports(ONE, "auto", 60.0)
    assert made.failed(refused(501, body), 0.0, progressed=False) == 0
    assert transport(made) == "http"
    with pytest.raises(RemoteError, match=r"gone wrong \(and by WebSocket: no\)"):
        made.failed(RemoteError("odd", "gone wrong"), 0.0, progressed=False)


def test_what_both_transports_say_is_said_once() -> None:
    made = Transports(ONE, "auto", 0.0)
    refusal = refused(501, b"")
    assert made.failed(refusal, 0.0, progressed=False) == 0
    with pytest.raises(RemoteError) as raised:
        made.failed(RemoteError("odd", str(refusal)), 0.0, progressed=False)
    assert str(raised.value) == str(refusal)


def test_what_the_server_itself_says_is_final() -> None:
    made = Transports(ONE, "auto", 60.0)
    with pytest.raises(RemoteError):
        made.failed(refused(403, b'{"code": "bad-token"}'), 0.0, progressed=False)
    made = met(ONE)
    with pytest.raises(ls.NotFoundError):
        made.failed(ls.NotFoundError("gone"), 0.0, progressed=False)


def test_a_handshake_that_breaks_tells_nothing_once_another_did_not() -> None:
    broken = caused(ls.RemoteError("x", "broke"), caused_by_end())
    made = met(ONE)
    made.failed(caused(UnreachableError("broke"), caused_by_end()), 0.0, progressed=True)
    assert transport(made) == "ws"
    made = Transports(ONE, "auto", 60.0)
    assert made.failed(broken, 0.0, progressed=False) == 0
    assert transport(made) == "http"


def caused_by_end() -> Exception:
    error = InvalidHandshake("no answer")
    error.__cause__ = EOFError()
    return error


def test_before_anybody_answered_there_are_three_attempts() -> None:
    made = Transports(ONE, "ws", 60.0)
    made.start(0.0)
    made.failed(LOST, 0.0, progressed=False)
    made.failed(LOST, 0.0, progressed=False)
    with pytest.raises(UnreachableError):
        made.failed(LOST, 0.0, progressed=False)


def test_what_no_other_attempt_mends_is_final() -> None:
    for error in (ls.NotFoundError("not here"), ls.OptionError("no such level")):
        with pytest.raises(type(error)):
            Transports(ONE, "ws", 60.0).failed(error, 0.0, progressed=False)


@pytest.mark.parametrize("code", ["restarting", "idle", "busy", "too-many", "internal", "http-502", "http-503"])
def test_what_may_pass(code: str) -> None:
    assert met(ONE).failed(RemoteError(code, "later"), 0.0, progressed=False) > 0


@pytest.mark.parametrize("code", ["other-container", "bad-held", "damaged", "failed", "not-ready", "http-403"])
def test_what_does_not_pass(code: str) -> None:
    with pytest.raises(RemoteError):
        met(ONE).failed(RemoteError(code, "never"), 0.0, progressed=False)
