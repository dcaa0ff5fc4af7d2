"""Clients that do not behave, beside honest ones: these get the right bytes, and of the others nothing remains."""

from __future__ import annotations

import asyncio
from pathlib import Path

from tests.server.helpers import eventually, hills, kept, npy, push
from tests.server.programs import server
from tests.torture import crowd
from tests.torture.parts import sent

COUNT = 10


def test_honest_clients_are_served_and_nothing_remains_of_the_others(tmp_path: Path) -> None:
    data = tmp_path / "data"
    with server(data, **crowd.settings(COUNT)) as running, running.client() as http:
        surface = push(http, npy(hills(420, 400)))
        container = (data / "containers" / f"{surface['container_sha256']}.lode").read_bytes()
        http.close()
        outcome = asyncio.run(crowd.visit(running, running.url + surface["url"], sent(container), COUNT, COUNT))
        assert outcome.wrong == ()
        assert outcome.remains == ()
        assert outcome.hostile == len(crowd.BARE) * COUNT
        assert outcome.health.answers
        assert outcome.grown < 128 * 1024
        eventually(lambda: not kept(data, "scratch/incoming"), "the folders of uploads to be removed")
    log = running.log.read_text()
    assert "Traceback" not in log, log[-3000:]
