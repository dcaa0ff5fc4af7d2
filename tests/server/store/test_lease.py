"""The lease of a bucket: one server has it, others wait, and whoever was stopped trusts it no more."""

from __future__ import annotations

import logging
import math
import threading
import time
from concurrent.futures import ThreadPoolExecutor
from typing import Any

import pytest

from lodestream.stores import Store, StoreError, UnacknowledgedError, open_store
from lodestream_server.store.lease import LEASE_SECONDS, Lease
from tests.patience import PATIENCE
from tests.server.helpers import eventually

from .conftest import Place

SECONDS = 15.0


class Clock:
    """Seconds that a test lets go by."""

    def __init__(self, now: float = 0.0) -> None:
        self.now = now

    def __call__(self) -> float:
        return self.now


@pytest.fixture
def in_memory(memory: str) -> Place:
    return lambda: open_store(memory)


PLACES = ["in_memory", *(pytest.param(name, marks=pytest.mark.long) for name in ("bucket_of_s3", "bucket_of_azure"))]


@pytest.fixture(params=PLACES)
def store(request: pytest.FixtureRequest) -> Store:
    make: Place = request.getfixturevalue(request.param)
    return make()


@pytest.fixture
def clock() -> Clock:
    return Clock(1000.0)


def test_nobody_has_it_until_somebody_takes_it(store: Store, clock: Clock) -> None:
    lease = Lease(store, clock=clock)
    assert LEASE_SECONDS == SECONDS
    assert not lease.held
    lease.tend()
    assert lease.held
    assert lease.number == 1
    assert lease.holder is not None


def test_it_is_trusted_a_fifth_less_than_it_lasts_and_from_before_the_write(store: Store, clock: Clock) -> None:
    lease = Lease(store, clock=clock)
    lease.tend()
    clock.now += SECONDS * 0.8 - 0.1
    assert lease.held
    lease.tend()
    clock.now += SECONDS * 0.8 - 0.1
    assert lease.held
    clock.now += 0.2
    assert not lease.held
    lease.tend()
    assert lease.held, "nobody has taken it meanwhile"
    assert lease.number == 1


@pytest.mark.parametrize("method", ["create", "replace"])
def test_what_a_write_takes_counts_in_the_time_for_which_it_is_trusted(
    store: Store, clock: Clock, monkeypatch: pytest.MonkeyPatch, method: str
) -> None:
    lease, write = Lease(store, clock=clock), getattr(store, method)

    def slow(*given: Any) -> Any:
        clock.now += 5.0
        return write(*given)

    monkeypatch.setattr(store, method, slow)
    begun = clock.now
    lease.tend()
    if method == "replace":
        begun = clock.now
        lease.tend()
    clock.now = begun + SECONDS * 0.8 - 0.1
    assert lease.held
    clock.now = begun + SECONDS * 0.8
    assert not lease.held, "others count from when it was written, which may be as early as that"


@pytest.mark.parametrize("offset", [0.0, -1e9, 1e9])
def test_another_one_takes_it_when_it_was_not_renewed_by_its_own_clock(
    store: Store, clock: Clock, offset: float
) -> None:
    theirs = Clock(clock.now + offset)
    first, second = Lease(store, clock=clock), Lease(store, clock=theirs)

    def go(seconds: float) -> None:
        clock.now += seconds
        theirs.now += seconds

    first.tend()
    for _ in range(10):
        second.tend()
        assert not second.held
        assert second.holder == first.holder
        go(5.0)
        first.tend()
    second.tend()
    go(SECONDS - 0.1)
    second.tend()
    assert not second.held
    assert not first.held, "it has stopped before the other one may begin"
    go(0.2)
    second.tend()
    assert second.held
    assert second.number == 2
    first.tend()
    assert not first.held
    assert first.number == 1


def test_a_holder_that_was_stopped_finds_that_it_is_lost_before_it_asks(store: Store, clock: Clock) -> None:
    first = Lease(store, clock=clock)
    first.tend()
    clock.now += 3600.0
    assert not first.held


def test_what_is_given_up_is_taken_at_once(store: Store, clock: Clock) -> None:
    first, second = Lease(store, clock=clock), Lease(store, clock=clock)
    first.tend()
    second.tend()
    first.close()
    assert not first.held
    second.tend()
    assert second.held
    assert second.number == 2


def test_of_many_that_take_it_at_once_one_has_it(store: Store, clock: Clock) -> None:
    for turn in range(5):
        leases = [Lease(store, clock=clock) for _ in range(4)]
        for lease in leases:
            if turn:
                lease.tend()
        clock.now += SECONDS + 1
        with ThreadPoolExecutor(4) as threads:
            list(threads.map(Lease.tend, leases))
        assert sum(lease.held for lease in leases) == 1
        assert max(lease.number for lease in leases) == turn + 1


def test_a_server_that_only_reads_never_takes_it(store: Store, clock: Clock) -> None:
    lease = Lease(store, clock=clock, wanted=False)
    lease.tend()
    clock.now += 100.0
    lease.tend()
    assert not lease.held
    assert list(store.entries("")) == []


class Silent:
    """A store that carries out a write and gives no answer."""

    def __init__(self, store: Store) -> None:
        self._store, self.silent = store, False

    def __getattr__(self, name: str) -> Any:
        method = getattr(self._store, name)
        if name not in ("create", "replace"):
            return method

        def write(*given: Any) -> Any:
            tag = method(*given)
            if self.silent:
                raise UnacknowledgedError("no answer came")
            return tag

        return write


@pytest.mark.parametrize("renewal", [False, True])
def test_a_write_of_which_no_answer_came_is_its_own(store: Store, clock: Clock, renewal: bool) -> None:
    silent: Any = Silent(store)
    lease = Lease(silent, clock=clock)
    if renewal:
        lease.tend()
        clock.now += SECONDS  # it trusts it no more
    silent.silent = True
    with pytest.raises(UnacknowledgedError):
        lease.tend()
    assert not lease.held
    silent.silent = False
    lease.tend()
    assert lease.held
    assert lease.number == 1


def test_an_object_that_is_gone_or_damaged_is_made_again_with_another_number(store: Store, clock: Clock) -> None:
    lease, other = Lease(store, clock=clock), Lease(store, clock=clock)
    lease.tend()
    store.delete(["writer.json"])
    lease.tend()
    assert not lease.held
    clock.now += SECONDS
    lease.tend()
    assert lease.held
    assert lease.number == 2
    store.replace("writer.json", b"{}", store.get("writer.json")[1])
    lease.tend()
    assert not lease.held
    other.tend()
    clock.now += SECONDS
    other.tend()
    assert other.held


@pytest.mark.parametrize("seconds", [SECONDS, 30.0])
def test_an_object_that_somebody_deletes_is_waited_for_as_long_as_its_holder_may_trust_it(
    store: Store, clock: Clock, seconds: float
) -> None:
    first, second = Lease(store, seconds, clock=clock), Lease(store, clock=clock)
    first.tend()
    second.tend()
    first.tend()
    store.delete(["writer.json"])
    while not second.held:
        second.tend()
        assert not (first.held and second.held)
        clock.now += 1.0
    assert clock.now <= 1000.0 + seconds + 2.0
    assert second.number == 1


def test_a_lease_that_says_it_lasts_long_is_waited_for_but_not_for_ever(store: Store, clock: Clock) -> None:
    first, second = Lease(store, 1e9, clock=clock), Lease(store, clock=clock)
    first.tend()
    second.tend()
    clock.now += 599.0
    second.tend()
    assert not second.held
    clock.now += 2.0
    second.tend()
    assert second.held


def test_threads_take_over_from_each_other_and_tell(store: Store, monkeypatch: pytest.MonkeyPatch) -> None:
    seconds = 3.0  # a busy machine may stop a thread for as long as is left until then at a renewal
    turns, renewed, replace = threading.Event(), list[object](), store.replace

    def noted(*given: Any) -> Any:
        renewed.append(given)
        return replace(*given)

    monkeypatch.setattr(store, "replace", noted)
    first, second = Lease(store, seconds), Lease(store, seconds)
    second.turned = turns.set
    first.start()
    eventually(lambda: first.held, "the first one to have it")
    second.start()
    eventually(lambda: len(renewed) > 4, "renewals for longer than a lease lasts")
    assert first.held
    assert not second.held
    turns.clear()
    monkeypatch.setattr(first, "_give_up", lambda: None)  # as if it were killed
    begun = time.monotonic()
    first._ending.set()
    eventually(lambda: second.held, "the second one to take over")
    assert time.monotonic() - begun > seconds / 2
    eventually(turns.is_set, "that to be told")
    second.close()
    assert first._thread is not None
    first._thread.join()
    assert not first.held


@pytest.mark.parametrize("error", [StoreError("no network"), RuntimeError("no network")], ids=["store", "fault"])
def test_a_store_that_does_not_answer_ends_a_lease_and_is_told_once(
    store: Store, caplog: pytest.LogCaptureFixture, monkeypatch: pytest.MonkeyPatch, error: Exception
) -> None:
    lease = Lease(store, 0.3)
    lease.start()
    eventually(lambda: lease.held, "it to be taken")

    def fail(*_: object) -> Any:
        raise error

    with monkeypatch.context() as broken:
        broken.setattr(store, "replace", fail)
        words = "the lease of the bucket could not be looked at: no network"
        eventually(lambda: words in caplog.messages, "that to be told")
        eventually(lambda: not lease.held, "it to end")
        time.sleep(0.2)
    eventually(lambda: lease.held, "it to be held again")
    assert lease.number == 1
    lease.close()
    assert caplog.messages.count(words) == 1
    assert not lease.held
    assert lease._until == -math.inf


def test_who_writes_is_told_only_while_that_is_known(
    store: Store, clock: Clock, monkeypatch: pytest.MonkeyPatch
) -> None:
    first, second = Lease(store, clock=clock), Lease(store, clock=clock)
    assert first.standing == "nobody is known to; try again soon"
    first._name, second._name = "a (process 1)", "b (process 2)"
    first.tend()
    second.tend()
    assert second.standing == "a (process 1) does; send it to that server"
    clock.now += SECONDS * 0.8
    second.tend()
    assert (second.holder, second.unheard) == (None, 0.0), "it has not been renewed"
    assert second.standing == "nobody is known to; try again soon"

    def fail(*_: object) -> Any:
        raise StoreError("no network")

    for method in ("create", "replace", "get_if"):
        monkeypatch.setattr(store, method, fail)
    clock.now += SECONDS
    for lease, seconds in ((first, 27), (second, 15)):
        with pytest.raises(StoreError):
            lease.tend()
        assert (lease.holder, lease.unheard) == (None, seconds), "least of all itself"
        assert lease.standing == (f"it has not answered for {seconds} s, and nobody is known to write; try again later")


def test_the_end_of_a_lease_is_told_while_the_store_hangs_and_a_takeover_names_who_was_silent(
    store: Store, caplog: pytest.LogCaptureFixture, monkeypatch: pytest.MonkeyPatch
) -> None:
    caplog.set_level(logging.INFO)
    lease, over, turned = Lease(store, 1.0), threading.Event(), threading.Event()
    silent = Lease(store, 1.0)
    silent._name = "other (process 1)"
    silent.tend()
    lease.start()
    eventually(lambda: lease.held, "it to be taken")
    eventually(lambda: "and writes" in caplog.text, "that to be told")
    (warning,) = (record.message for record in caplog.records if record.levelname == "WARNING")
    assert warning == (
        "other (process 1) has stopped renewing the lease of the bucket; this server has it (number 2) from now on, "
        "and writes"
    )
    lease.turned = turned.set
    with monkeypatch.context() as hung:
        hung.setattr(store, "replace", lambda *_: over.wait(PATIENCE))
        eventually(turned.is_set, "the end to be told")
        assert not over.is_set()
        assert not lease.held
        # The last one: on a busy machine it may have been late with a renewal before.
        *_, lost = (record.message for record in caplog.records if record.levelname == "ERROR")
        assert lost.startswith("this server has lost the lease of the bucket, which has not answered for ")
        assert lost.endswith(" s; it writes nothing, and nobody is known to")
    over.set()
    lease.close()


def test_no_more_than_the_beginning_of_a_long_name_is_told(store: Store, clock: Clock) -> None:
    first, second = Lease(store, clock=clock), Lease(store, clock=clock)
    first._name = "y" * 1_000_000
    first.tend()
    second.tend()
    assert second.holder == "y" * 200
