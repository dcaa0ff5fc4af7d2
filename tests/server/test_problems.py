"""What errors are called: one code for each class, one status for each code."""

from __future__ import annotations

import errno
import json
from types import SimpleNamespace
from typing import Any

import pytest
from fastapi import Request
from starlette.requests import ClientDisconnect

from lodestream import errors, stores
from lodestream.protocol.messages import CODES, MessageError
from lodestream_server import codes, problems
from lodestream_server.codes import MEANINGS
from lodestream_server.operation.metrics import Metrics
from lodestream_server.problems import problem
from tests.server import manual

EXPECTED = [
    (errors.TooLargeError("x"), 413, "too-large"),
    (errors.OptionError("x"), 422, "bad-option"),
    (errors.FormatError("x"), 422, "bad-file"),
    (errors.SwitchedOffError("x"), 422, "bad-file"),
    (errors.InputError("x"), 422, "bad-input"),
    (errors.UnavailableError("x"), 501, "unavailable"),
    (errors.NotFoundError("x"), 404, "not-found"),
    (problems.SlowUploadError("x"), 408, "idle"),
    (problems.SilentError("x"), 408, "idle"),
    (problems.WrongOffsetError(7, 8), 409, "wrong-offset"),
    (problems.LockedError("x"), 423, "locked"),
    (problems.WrongVersionError("x"), 412, "wrong-version"),
    (problems.WrongTypeError("x"), 415, "wrong-type"),
    (problems.NoTokenError("x"), 401, "no-token"),
    (problems.BadTokenError("x"), 401, "bad-token"),
    (problems.SmallScopeError("x"), 403, "small-scope"),
    (problems.NotOwnerError("x"), 403, "not-owner"),
    (problems.ForeignOriginError("x"), 403, "foreign-origin"),
    (problems.NoWebSocketError("x"), 426, "no-websocket"),
    (problems.ReadOnlyError("x"), 403, "read-only"),
    (problems.StandbyError("x"), 503, "busy"),
    (problems.TooManyError("x"), 429, "too-many"),
    (problems.BusyError("x"), 503, "busy"),
    (problems.RestartingError("x"), 503, "restarting"),
    (problems.FullError("x"), 507, "full"),
    (problems.NotReadyError("x"), 409, "not-ready"),
    (problems.BuildFailedError("x"), 409, "failed"),
    (problems.PostponedError("x"), 409, "waiting"),
    (problems.DamagedNameError("x"), 503, "damaged-name"),
    (errors.StreamError("x"), 500, "damaged"),
    (errors.CorruptStreamError("x", 7), 500, "damaged"),
    (errors.UnsupportedVersionError("x"), 426, "unsupported-version"),
    (MessageError("out-of-turn", "x"), 400, "out-of-turn"),
]
HIDDEN = [
    (stores.FullError("/srv/data"), 507, "disk-full"),
    (stores.UnacknowledgedError("/srv/data"), 503, "busy"),
    (stores.StoreError("/srv/data"), 503, "busy"),
    (stores.AbsentError("/srv/data"), 503, "busy"),
    (OSError(errno.ENOSPC, "/srv/data"), 507, "disk-full"),
    (OSError(errno.EDQUOT, "/srv/data"), 507, "disk-full"),
    (OSError(errno.EIO, "/srv/data"), 500, "internal"),
    (problems.ShortageError("/srv/data"), 503, "busy"),
    (OSError(errno.EMFILE, "/srv/data"), 503, "busy"),
    (OSError(errno.ENFILE, "/srv/data"), 503, "busy"),
    (OSError(errno.ENOMEM, "/srv/data"), 503, "busy"),
    (OSError(errno.EAGAIN, "/srv/data"), 503, "busy"),
    (errors.LodestreamError("/srv/data"), 500, "internal"),
    (ZeroDivisionError("/srv/data"), 500, "internal"),
    (ClientDisconnect(), 400, "gone"),
]


@pytest.mark.parametrize(("error", "status", "code"), [*EXPECTED, *HIDDEN], ids=repr)
def test_each_class_has_one_code_and_each_code_one_status(error: Exception, status: int, code: str) -> None:
    app: Any = SimpleNamespace(state=SimpleNamespace(metrics=Metrics()))
    scope = {"type": "http", "method": "GET", "path": "/x", "query_string": b"", "headers": [], "app": app}
    answer = problems.answer(Request(scope), error)
    document = json.loads(bytes(answer.body))
    assert (answer.status_code, document["status"], document["code"]) == (status, status, code)
    assert document["title"] == MEANINGS[code].title
    assert "/srv" not in document["detail"]
    assert str(error) in document["detail"] or (error, status, code) in HIDDEN
    assert f'lodestream_errors_total{{kind="{code}"}} 1.0'.encode() in app.state.metrics.text()


def test_a_detail_says_everything_without_the_title() -> None:
    assert problem(errors.StreamError("wrong sum")) == ("damaged", "The stored container is damaged: wrong sum")
    assert problem(errors.UnavailableError("no GDAL"))[1].startswith("This server lacks a library that this needs: ")
    assert problem(OSError(errno.ENOSPC, "/srv/data"))[1].startswith("The disk is full, and nothing was stored; ")
    assert problem(ZeroDivisionError()) == ("internal", "The server failed; the server's log says more")


def test_every_class_of_the_server_is_tried_here() -> None:
    kinds = {kind for kind in vars(problems).values() if isinstance(kind, type) and issubclass(kind, Exception)}
    ours = {kind for kind in kinds if kind.__module__ == problems.__name__}
    assert ours <= {type(error) for error, _, _ in [*EXPECTED, *HIDDEN]}
    assert set(problems._KINDS) - {Exception} <= {type(error) for error, _, _ in [*EXPECTED, *HIDDEN]}


def test_every_code_is_somebodys_and_close_codes_follow_from_statuses() -> None:
    used = {kind.code for kind in problems._KINDS.values()} | set(problems._OF_THE_FRAMEWORK.values())
    used.add("bad-request")  # of the connections, which answer without the framework
    assert used | set(CODES) == set(MEANINGS)
    assert {code for code, meaning in CODES.items() if meaning.close < 4000} == set(codes._STATUSES)
    for code, meaning in CODES.items():
        assert meaning.close in (4000 + MEANINGS[code].status, 1009, 1011, 1012)


def test_a_stream_has_the_codes_that_its_protocol_knows() -> None:
    from lodestream_server.routes import streams

    for error, _, code in [*EXPECTED, *HIDDEN]:
        told, detail = streams._problem(error)
        assert told == (code if code in CODES else "internal")
        assert "/srv" not in detail
        assert told != "internal" or detail == problem(ZeroDivisionError())[1]


def test_the_page_of_codes_is_made_from_the_tables() -> None:
    assert manual.ERRORS_PATH.read_text() == manual.render_errors(), "run python -m tests.server.manual"
