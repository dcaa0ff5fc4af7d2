"""A folder in which parts keep what they did: nothing is done twice, and nothing of another program counts."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path

import pytest

from tests.kernels import fuzzing
from tests.torture import __main__ as command
from tests.torture import fuzz
from tests.torture.lanes import Lanes, Wish
from tests.torture.parts import PARTS, Part, Result


def result(part: Part, wanted: int, cases: int, failure: str | None = None) -> Result:
    return Result(part, wanted, cases, ("a fact",), 1.0, failure)


@pytest.mark.parametrize(
    ("first", "again"),
    [
        (lambda wish: result(wish.part, wish.count, wish.count), False),
        (lambda wish: result(wish.part, wish.count, wish.count - 1), True),
        (lambda wish: result(wish.part, wish.count, wish.count, "it failed"), True),
    ],
)
def test_a_part_that_was_done_as_a_whole_is_not_done_again(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, first: Callable[[Wish], Result], again: bool
) -> None:
    begun: list[str] = []
    ended: list[Result] = []
    wish = Wish(PARTS["disk"], 100, None)

    def one(lanes: Lanes, wish: Wish) -> Result:
        (tmp_path / wish.part.name).mkdir(exist_ok=True)
        return lanes._keep(first(wish))

    monkeypatch.setattr(Lanes, "_one", one)
    for _ in range(2):
        Lanes(lambda part: begun.append(part.name), ended.append, tmp_path).run([wish])
    assert begun == ["disk"] * (1 + again)
    assert ended == [first(wish)] * 2
    Lanes(lambda part: begun.append(part.name), ended.append, tmp_path).run([Wish(PARTS["disk"], 200, None)])
    assert begun == ["disk"] * (2 + again)


def test_a_folder_of_another_program_is_refused(tmp_path: Path) -> None:
    assert command._of_this_program(tmp_path / "kept")
    assert command._of_this_program(tmp_path / "kept")
    (tmp_path / "kept" / "program").write_text("another")
    assert not command._of_this_program(tmp_path / "kept")


@pytest.mark.long
def test_a_fuzzer_goes_on_with_what_it_had(tmp_path: Path) -> None:
    first = fuzz.run("messages", 300, folder=tmp_path / "messages")
    assert first.cases == 300
    second = fuzz.run("messages", 500, folder=tmp_path / "messages")
    assert second.cases == 500
    assert second.taken > first.taken
    third = fuzz.run("messages", 500, folder=tmp_path / "messages")
    assert (third.cases, third.taken) == (500, second.taken)


def test_a_kernel_that_had_its_cases_is_not_called_again(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    calls: list[str] = []

    def some(program: Path, kernel: str, *_: object) -> fuzzing.Fuzzed:
        calls.append(kernel)
        return fuzzing.Fuzzed(kernel, 10 if kernel == "lift" else 9, 1, 1, 0.5, None)

    monkeypatch.setattr(fuzzing, "sanitizing_compiler", lambda: "cc")
    monkeypatch.setattr(fuzzing, "fuzzer", lambda _: Path())
    monkeypatch.setattr(fuzzing, "seeds", Path)
    monkeypatch.setattr(fuzzing, "fuzz", some)
    for _ in range(2):
        found = fuzzing.fuzz_all(["lift", "mask"], 1.0, 10, kept=tmp_path)
        assert [(item.kernel, item.cases) for item in found] == [("lift", 10), ("mask", 9)]
    assert sorted(calls) == ["lift", "mask", "mask"]
    assert json.loads((tmp_path / "lift.json").read_text())["cases"] == 10
