"""A file with several surfaces: what is offered to choose one, and that an upload with these options is built."""

from __future__ import annotations

import io
import json
from pathlib import Path

import httpx
import numpy as np
import pytest

from lodestream.errors import Choice
from lodestream.stores import Folder
from lodestream_server.builds.choices import told
from lodestream_server.maintenance.check import check
from tests.server.builds.test_builds import running
from tests.server.builds.test_confinement import build_by
from tests.server.connections import hostile
from tests.server.helpers import hills, push


def two(seed: int) -> bytes:
    """An archive of two arrays."""
    file = io.BytesIO()
    np.savez(file, low=hills(6, 9, seed), high=hills(8, 5, seed))
    return file.getvalue()


def test_what_is_offered_is_built(http: httpx.Client) -> None:
    body = two(81)
    failed = push(http, body, filename="two.npz")
    assert failed["state"] == "failed"
    assert failed["choices"] == [
        {"options": {"array": "low"}, "shape": [6, 9]},
        {"options": {"array": "high"}, "shape": [8, 5]},
    ]
    for choice in failed["choices"]:
        built = push(http, body, filename="two.npz", **choice["options"])
        assert (built["state"], built["shape"]) == ("ready", choice["shape"])
        assert "choices" not in built
    listed = http.get("/v1/surfaces?limit=1000").json()["surfaces"]
    assert not any("choices" in it for it in listed)


def test_it_is_still_offered_after_a_start_and_gone_after_a_retry(tmp_path: Path) -> None:
    data = tmp_path / "data"
    with running(data) as http:
        failed = push(http, two(82), filename="two.npz")
    assert check(Folder(data)).findings == []
    with running(data) as http:
        assert http.get(failed["url"]).json() == failed
        retried = http.post(f"{failed['url']}/retry").json()
        assert "choices" not in retried


def test_only_options_that_choose_are_told(http: httpx.Client, monkeypatch: pytest.MonkeyPatch) -> None:
    made = build_by(http, monkeypatch, hostile.forge_choices)
    assert made["state"] == "failed"
    assert 10 < len(made["choices"]) < 100
    assert len(json.dumps(made["choices"])) <= 4096 + 2 * len(made["choices"])
    assert made["choices"][0] == {"options": {"variable": f"{0:0100d}"}, "shape": []}
    assert {tuple(choice["options"]) for choice in made["choices"]} == {("variable",)}
    http.delete(made["url"])


def test_a_shape_is_two_lengths_that_can_be() -> None:
    shapes = [(3, 4), (), (0, 4), (3, 1 << 60), (3, 4, 5)]
    choices = [Choice({"variable": "v"}, shape) for shape in shapes]
    assert [it["shape"] for it in told(choices)] == [[3, 4], [], [], [], [3, 4]]
