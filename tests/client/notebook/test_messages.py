"""Questions of a page and their answers, without a comm."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from lodestream.errors import LodestreamError, RemoteError
from lodestream.opening.byte_sources import FileSource, MemorySource
from lodestream_client.notebook.messages import LONGEST, Answers

DATA = bytes(range(256)) * 8192  # 2 MiB


def answers(data: bytes = DATA) -> Answers:
    return Answers(MemorySource(data, "bytes"), Path(__file__))


def ask(offset: Any, length: Any) -> tuple[dict[str, Any], list[bytes]]:
    answer = answers().to({"kind": "read", "id": "a", "offset": offset, "length": length})
    assert answer is not None
    return answer


@given(st.integers(0, 2 * len(DATA)), st.integers(0, 2 * len(DATA)))
def test_a_part_is_what_stands_there_and_no_longer_than_allowed(offset: int, length: int) -> None:
    content, [data] = ask(offset, length)
    assert data == DATA[offset : offset + min(length, LONGEST)]
    assert content == {"kind": "part", "id": "a", "size": len(DATA), "tag": "memory"}


@pytest.mark.parametrize(("offset", "length"), [(-1, 5), (0, -5), ("0", 5), (0, None), (True, 5), (0.5, 5)])
def test_what_is_no_number_of_bytes_is_refused(offset: Any, length: Any) -> None:
    content, data = ask(offset, length)
    assert content["kind"] == "refused"
    assert "to be a number of bytes, got" in content["detail"]
    assert data == []


@pytest.mark.parametrize("question", [None, "read", [], {}, {"kind": "read"}, {"kind": "read", "id": 3}])
def test_what_has_no_id_has_no_answer(question: Any) -> None:
    assert answers().to(question) is None


def test_another_kind_is_refused_by_its_name() -> None:
    answer = answers().to({"kind": "write", "id": "b"})
    assert answer is not None
    assert answer[0] == {
        "kind": "refused",
        "id": "b",
        "detail": "expected a question of kind read or program, got 'write'",
        "code": "",
    }


def test_the_program_is_the_file_itself() -> None:
    answer = answers().to({"kind": "program", "id": "c"})
    assert answer == ({"kind": "program", "id": "c"}, [Path(__file__).read_bytes()])


def test_bytes_of_the_container_are_counted() -> None:
    own = answers()
    for offset in (0, 100, len(DATA) - 10, len(DATA) + 5):
        own.to({"kind": "read", "id": "a", "offset": offset, "length": 64})
    own.to({"kind": "program", "id": "c"})
    assert own.sent == 64 + 64 + 10


def test_a_file_that_has_changed_is_refused_with_its_name(tmp_path: Path) -> None:
    path = tmp_path / "a.lode"
    path.write_bytes(DATA)
    own = Answers(FileSource(path), path)
    path.write_bytes(DATA + b"more")
    answer = own.to({"kind": "read", "id": "a", "offset": 0, "length": 9})
    assert answer is not None
    assert "a.lode as it was when this began, got another" in answer[0]["detail"]
    assert own.sent == 0


@pytest.mark.parametrize(
    ("error", "code"),
    [(LodestreamError("gone"), ""), (RemoteError("other-container", "gone"), "other-container"), (OSError("gone"), "")],
)
def test_why_there_are_no_bytes_is_said(error: Exception, code: str) -> None:
    class Broken(MemorySource):
        def read(self, offset: int, length: int) -> bytes:
            raise error

    answer = Answers(Broken(DATA, ""), Path()).to({"kind": "read", "id": "a", "offset": 0, "length": 9})
    assert answer is not None
    assert (answer[0]["kind"], answer[0]["code"]) == ("refused", code)
    assert "gone" in answer[0]["detail"]


def test_any_other_failure_is_told_to_the_page_and_logged(caplog: pytest.LogCaptureFixture) -> None:
    class Broken(MemorySource):
        def read(self, offset: int, length: int) -> bytes:
            raise ZeroDivisionError("by nought")

    answer = Answers(Broken(DATA, "bytes"), Path(__file__)).to({"kind": "read", "id": "a", "offset": 0, "length": 5})
    assert answer == (
        {
            "kind": "refused",
            "id": "a",
            "detail": "the kernel failed, see its log: ZeroDivisionError: by nought",
            "code": "",
        },
        [],
    )
    assert "a question of the page of a widget failed" in caplog.text
    assert "ZeroDivisionError" in caplog.text
