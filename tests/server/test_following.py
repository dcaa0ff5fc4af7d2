"""What a server of a bucket looks at again and again, whatever becomes of one look."""

from __future__ import annotations

import asyncio
import threading
from collections import Counter
from types import SimpleNamespace
from typing import Any

import pytest

from lodestream.stores import Store, StoreError, open_store
from lodestream_server import following as module
from lodestream_server.following import Following
from lodestream_server.operation.settings import Settings
from lodestream_server.problems import BusyError
from lodestream_server.store.changes import ChangeLog
from tests.patience import PATIENCE
from tests.server.helpers import eventually
from tests.stores.memory import memory

__all__ = ["memory"]


@pytest.fixture
def store(memory: str) -> Store:
    return open_store(memory)


@pytest.mark.parametrize("error", [StoreError("no network"), RuntimeError("no network")], ids=["store", "fault"])
def test_a_look_that_fails_is_repeated_and_the_others_go_on(
    store: Store, error: Exception, caplog: pytest.LogCaptureFixture
) -> None:
    looks = Counter[str]()
    log = ChangeLog(store)

    def look(what: str) -> None:
        looks[what] += 1
        if looks[what] < 3:
            raise error

    def refresh(changed: tuple[str, ...]) -> None:
        look("changes")

    surfaces: Any = SimpleNamespace(
        store=store, lease=object(), writes=False, sync=lambda: look("list"), refresh=refresh
    )
    access: Any = SimpleNamespace(look=lambda: look("tokens"))
    following = Following(Settings(look_seconds=0.01, list_seconds=0.01), surfaces, access)
    following.start()
    try:
        eventually(lambda: looks["list"] >= 4 and looks["tokens"] >= 4, "looks after failures")
        log.add("a")
        log.write()
        listed = looks["list"]
        eventually(lambda: looks["list"] > listed + 3, "the first change to be met")
        log.add("b")
        log.write()
        eventually(lambda: looks["changes"] >= 3, "what has changed to be taken once it can be")
    finally:
        following.close()
    for what in ("the tokens", "the bucket"):
        assert any(what in record.message for record in caplog.records)


def test_where_the_bucket_does_not_answer_too_many_questions_are_not_told_that_there_is_nothing(
    store: Store, monkeypatch: pytest.MonkeyPatch
) -> None:
    over, now = threading.Event(), 100.0
    surfaces: Any = SimpleNamespace(
        store=store, lease=object(), writes=False, sync=lambda: None, refresh=lambda _: over.wait(PATIENCE)
    )
    access: Any = SimpleNamespace(look=lambda: None)
    following = Following(Settings(), surfaces, access)
    monkeypatch.setattr(module, "time", SimpleNamespace(monotonic=lambda: now))

    async def look() -> None:
        nonlocal now
        looks = [asyncio.create_task(following.look_for(f"{number:020x}")) for number in range(16)]
        for _ in range(3):  # until all have begun
            await asyncio.sleep(0)
        await following.look_for("f" * 20)
        now += 2
        with pytest.raises(BusyError, match="does not answer"):
            await following.look_for("f" * 20)
        over.set()
        await asyncio.gather(*looks)

    asyncio.run(look())
