"""What ``lodestream list`` prints of what a server tells."""

from __future__ import annotations

import json
from typing import Any

import pytest

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


def test_a_state_that_there_is_not_is_refused_with_those_that_are(run: Run) -> None:
    code, stdout, stderr = run("list", "http://127.0.0.1:9", "--state", "nonsense")
    assert (code, stdout) == (2, "")
    words = stderr.replace("'", "")
    assert "argument --state: invalid choice: nonsense (choose from" in words
    assert "queued, building, ready, failed, waiting, missing" in words


@pytest.mark.parametrize("state", ["queued", "building", "ready", "failed", "waiting", "missing"])
def test_each_state_can_be_asked_for(run: Run, state: str) -> None:
    states = ["queued", "building", "ready", "failed", "waiting", "missing"]
    _, stdout = listed(run, [{"state": it, "name": it} for it in states], "--state", state, "--json")
    assert [it["name"] for it in json.loads(stdout)["surfaces"]] == [state]
