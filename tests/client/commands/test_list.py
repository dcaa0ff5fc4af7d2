"""What ``lodestream list`` prints of what a server tells."""

from __future__ import annotations

import json
from typing import Any

import pytest

from lodestream.series import Place, place_of

from ..conftest import Run
from ..scripted import document, scripted

READY = {"state": "ready", "shape": [20, 30], "bytes": 700}


def listed(run: Run, surfaces: list[dict[str, Any]], *options: str) -> tuple[str, str]:
    """The URL of the server, and standard output."""
    known = [{"id": f"{number:02}", "url": f"/v1/surfaces/{number:02}", **it} for number, it in enumerate(surfaces)]
    with scripted(lambda asked: document({"surfaces": known})) as server:
        code, stdout, stderr = run("list", server.url, *options)
        assert (code, stderr) == (0, "")
        return server.url, stdout


def test_columns_stand_below_each_other_and_no_line_ends_with_spaces(run: Run) -> None:
    url, stdout = listed(
        run,
        [
            {**READY, "name": "a long name"},
            {"state": "waiting", "name": "山", "upload_bytes": 1_000_000, "reason": "the disk is full"},
            {**READY, "name": "b", "shape": None},
        ],
    )
    assert stdout.splitlines() == [
        f"{url}/v1/surfaces/00  ready    20 x 30  700 B   a long name",
        f"{url}/v1/surfaces/01  waiting  -        1.0 MB  山           the disk is full",
        f"{url}/v1/surfaces/02  ready    blocks   700 B   b",
    ]


def test_owners_have_a_column_where_any_is_told(run: Run) -> None:
    surfaces = [{**READY, "name": "a", "owner": "survey"}, {**READY, "name": "b", "owner": None, "reason": "why"}]
    url, stdout = listed(run, surfaces)
    assert stdout.splitlines() == [
        f"{url}/v1/surfaces/00  ready  20 x 30  700 B  a  survey",
        f"{url}/v1/surfaces/01  ready  20 x 30  700 B  b  -       why",
    ]
    told = json.loads(listed(run, surfaces, "--json")[1])["surfaces"]
    assert [it["owner"] for it in told] == ["survey", None]


def step(index: int, name: str = "air") -> dict[str, Any]:
    return {"name": name, "along": "time", "index": index, "value": 6.0 * index, "unit": "hours since 2001-01-01"}


def test_surfaces_of_a_series_stand_together_by_their_index(run: Run) -> None:
    surfaces = [
        {**READY, "name": "c", "series": step(2)},
        {**READY, "name": "other"},
        {**READY, "name": "a", "series": step(0)},
        {**READY, "name": "sea", "series": step(0, "sea")},
        {**READY, "name": "b", "series": step(1)},
    ]
    _, stdout = listed(run, surfaces)
    assert [line.split("700 B  ")[1] for line in stdout.splitlines()] == [
        "a      air, time 0",
        "b      air, time 1",
        "c      air, time 2",
        "other",
        "sea    sea, time 0",
    ]
    told = json.loads(listed(run, surfaces, "--json")[1])["surfaces"]
    assert [it["series"]["index"] for it in told if "series" in it] == [0, 1, 2, 0]
    assert len(listed(run, surfaces, "--search", "AIR, TIME")[1].splitlines()) == 3
    by_name = listed(run, surfaces, "--sort", "name", "--json")[1]
    assert [it["name"] for it in json.loads(by_name)["surfaces"]] == ["a", "b", "c", "other", "sea"]


@pytest.mark.parametrize(
    "wrong",
    [
        7,
        {},
        {**step(0), "name": ""},
        {**step(0), "name": "n" * 201},
        {**step(0), "index": -1},
        {**step(0), "index": True},
        {**step(0), "index": "0"},
        {**step(0), "value": None},
        {**step(0), "value": float("inf")},
        {**step(0), "value": float("nan")},
        {**step(0), "unit": 3},
        {**step(0), "value": [1]},
    ],
)
def test_what_is_no_place_in_a_series_is_not_shown(wrong: Any) -> None:
    assert place_of({"series": wrong}) is None
    assert place_of({"series": step(3)}) == Place("air", "time", 3, 18.0, "hours since 2001-01-01")


def test_a_state_that_there_is_not_is_refused_with_those_that_are(run: Run) -> None:
    code, stdout, stderr = run("list", "http://127.0.0.1:9", "--state", "nonsense")
    assert (code, stdout) == (2, "")
    words = stderr.replace("'", "")
    assert "argument --state: invalid choice: nonsense (choose from" in words
    assert "queued, building, ready, failed, waiting" in words


@pytest.mark.parametrize("state", ["queued", "building", "ready", "failed", "waiting"])
def test_each_state_can_be_asked_for(run: Run, state: str) -> None:
    states = ["queued", "building", "ready", "failed", "waiting"]
    _, stdout = listed(run, [{"state": it, "name": it} for it in states], "--state", state, "--json")
    assert [it["name"] for it in json.loads(stdout)["surfaces"]] == [state]
