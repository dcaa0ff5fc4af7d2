"""A history of four servers of one bucket, killed and stopped behind a network that fails, and what is wrong in it.

One server writes, one waits for that, two only read. Clients ask all of them, whatever becomes of them, and changes
are asked of the first two, whichever writes. Between disasters all is calm for a while, for what servers promise of
times when nothing fails. `tests.history.checker` judges what came back; the times are measured beside it.
"""

from __future__ import annotations

import json
import random
import threading
import time
from bisect import bisect_left
from collections import Counter, defaultdict
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack, closing, contextmanager
from dataclasses import dataclass, field
from operator import itemgetter
from pathlib import Path

import httpx
import pytest

from lodestream.errors import LodestreamError
from lodestream.stores import open_store
from lodestream_server.access.tokens import TokenObject
from lodestream_server.store.layout import WRITER
from tests.history.bucket_site import READERS, WRITERS, BucketSite
from tests.history.checker import check
from tests.history.driver import Client, Crowd, Goods
from tests.history.events import Finding, History, Operation, Span, Subject
from tests.patience import PATIENCE
from tests.server.helpers import hills, npy
from tests.stores.emulators import reach, running_ministack
from tests.stores.faults import Fault, FaultProxy, fault_proxy

__all__ = ["CLIENTS", "DISASTERS", "Done", "Times", "run"]

#: That are at work at the same time, apart from those who look at one reader each, and at tokens.
CLIENTS = 6

#: What happens, beside a network that fails: to the server that writes, the one that waits, or one that reads.
DISASTERS = ("kill", "stop", "end", "kill waiting", "kill reader", "stop reader", "network")

#: Seconds that servers promise: until another one takes over after the lease, until an upload is seen, until a token
#: ends.
_TAKEOVER, _SEEN, _REVOKED = 3.0, 5.0, 10.0

_KINDS = ("lost", "closed", "409", "503", "slow")
#: Requests for the lease that fail when a server goes on.
_OF_LEASE = 20
_BODIES = 6
_NAMES = 3
_SHOWN = 10


@dataclass(frozen=True)
class Times:
    """Settings of the servers, and what the machine may add to what they promise.

    Attributes
    ----------
    lease, look, list_ : float
        Seconds: see `lease_seconds`, `look_seconds`, `list_seconds` of the settings. At first as they are by default.
    slack : float
        Seconds by which anything may be late, on a machine that does several other things.
    """

    lease: float = 15.0
    look: float = 3.0
    list_: float = 600.0
    slack: float = 10.0


@dataclass
class Done:
    """What happened.

    Attributes
    ----------
    operations, uploads, deletes, pointed, reads, unanswered, refused : int
        Asked; acknowledged, or answered with what they asked for; without an answer; answered 503.
    disasters : Counter
        Of each kind.
    faults : int
        Requests to the bucket that failed.
    takeovers, lags, revoked : list of float
        Seconds from a kill or a stop until another server wrote; from the answer to an upload until a reader showed
        it, and from the end of a token until a reader refused it, while nothing failed.
    restless : int
        Times between two disasters in which the lease changed hands although nothing had happened.
    ready : int
        Surfaces that could be fetched at the end.
    findings : list of Finding
    seconds : float
    """

    operations: int = 0
    uploads: int = 0
    deletes: int = 0
    pointed: int = 0
    reads: int = 0
    unanswered: int = 0
    refused: int = 0
    disasters: Counter[str] = field(default_factory=Counter)
    faults: int = 0
    takeovers: list[float] = field(default_factory=list)
    lags: list[float] = field(default_factory=list)
    revoked: list[float] = field(default_factory=list)
    restless: int = 0
    ready: int = 0
    findings: list[Finding] = field(default_factory=list)
    seconds: float = 0.0


def run(
    folder: Path,
    count: int,
    seconds: float | None = None,
    *,
    times: Times = Times(),
    clients: int = CLIENTS,
    seed: int = 1,
    kinds: Sequence[str] = DISASTERS,
    progress: Callable[[str], None] = lambda _: None,
    keep: Path | None = None,
) -> Done:
    """Let so many disasters happen, or as many as the seconds allow, and judge the history.

    Parameters
    ----------
    folder : Path
        An empty one.
    count : int
    seconds : float or None
        Without what it takes to start the servers, and to ask for everything at the end.
    times : Times
    clients : int
    seed : int
        Of all that is left to chance but the moments at which processes run.
    kinds : sequence of str
        Those of `DISASTERS` that may come, each as often as the others.
    progress : callable
        Is told after each disaster how far it is, and then how far it is judged.
    keep : Path or None
        A file in which the history is left if anything is wrong, or if it does not come to its end;
        ``python -m tests.history --again FILE`` judges it again.

    Raises
    ------
    AssertionError
        When a server does not start, two write at once, or something never comes; the findings up to then are in its
        message.
    """
    started, done = time.monotonic(), Done()
    history = History(admins=frozenset({"admin"}), lag=_SEEN + times.slack)
    with ExitStack() as held:
        (folder / "s3").mkdir()
        emulator = held.enter_context(running_ministack(folder / "s3"))
        proxy = held.enter_context(fault_proxy(emulator.port))
        patch = held.enter_context(pytest.MonkeyPatch.context())
        reach(emulator.at(proxy.port), patch)
        story = _Story(emulator.address(), folder, history, proxy, times, clients, seed, done)
        held.callback(story.site.close)
        try:
            story.tell(count, seconds, kinds, progress)
        except AssertionError as error:
            raise AssertionError("\n".join((str(error), *map(str, check(history)[:_SHOWN])))) from error
        finally:
            if keep is not None:
                history.write(keep)
    done.lags = list(_lags(history))
    judged = time.monotonic()
    done.findings = check(history, lambda told: progress(f"judged for {time.monotonic() - judged:.0f} s: {told}"))
    if keep is not None and not done.findings:
        keep.unlink()
    _count(history, done)
    done.seconds = time.monotonic() - started
    return done


class _Story:
    """The servers, the clients, and what happens to them."""

    def __init__(
        self,
        address: str,
        folder: Path,
        history: History,
        proxy: FaultProxy,
        times: Times,
        clients: int,
        seed: int,
        done: Done,
    ) -> None:
        self._history, self._proxy, self._times, self._clients = history, proxy, times, clients
        self._seed, self._done = seed, done
        self._random = random.Random(seed)
        self._store = open_store(address)
        self._tokens = TokenObject(self._store)
        self.site = BucketSite(
            address,
            folder,
            history,
            lease_seconds=times.lease,
            look_seconds=times.look,
            list_seconds=times.list_,
        )

    def tell(
        self,
        count: int,
        seconds: float | None,
        kinds: Sequence[str],
        progress: Callable[[str], None],
    ) -> None:
        site, left = self.site, list[str]()
        goods = self._goods()
        site.open()
        started = time.monotonic()
        crowd = Crowd(self._history, goods, site.servers, list(goods.bodies), seed=self._seed, size=self._clients)
        guests = self._guests("guest")
        beside: list[_Watch | _Guests] = [
            *(_Watch(self._history, goods, site, name, crowd.ids) for name in READERS),
            guests,
        ]
        # Their ids are learned first, so that a list can be read whatever is answered later.
        with closing(self._client("operator", goods, crowd, *WRITERS)) as operator:
            for subject in goods.bodies:
                site.wait(lambda: operator.upload(subject) and subject in crowd.ids, f"{subject} to be taken")  # noqa: B023
        with _at_work(beside):
            with crowd, site.ended_by_failures():
                while self._done.disasters.total() < count and (
                    seconds is None or time.monotonic() - started < seconds
                ):
                    left = left or self._random.sample(kinds, len(kinds))
                    # Every other time is long enough for what readers promise.
                    least, most = self._random.choice(((0.0, 0.2), (1.0, 1.3)))
                    self._calm(self._random.uniform(least, most) * (self._history.lag or 0))
                    self._disaster(left.pop(), goods, crowd)
                    progress(self._told(started))
            time.sleep((self._history.lag or 0) + self._times.look)  # what was uploaded last is seen
        self._calm(0.0, self._settled(goods, crowd))
        with closing(self._guests("last guest")) as last:
            self._calm(0.0, last.step)
        self._judge(guests)
        self._judge(last)

    def _guests(self, name: str) -> _Guests:
        return _Guests(self._history, self.site, self._tokens, name, _REVOKED + self._times.slack)

    def _judge(self, guests: _Guests) -> None:
        """Look how long new tokens were not taken, and revoked ones were, while nothing failed."""
        for what, spans in (("be taken", guests.made), ("end", guests.revoked)):
            for span in spans:
                seconds = span.ended - span.begun
                if seconds > guests.limit and not _troubled(self._history, span.begun, span.ended):
                    text = f"{span.server}: expected a token to {what} within {guests.limit:.0f} s, got {seconds:.1f}"
                    self._history.found("token", text)
        self._done.revoked += [
            span.ended - span.begun for span in guests.revoked if not _troubled(self._history, span.begun, span.ended)
        ]

    def _told(self, started: float) -> str:
        done = self._done
        return (
            f"{time.monotonic() - started:.0f} s: {done.disasters.total()} disasters, {len(done.takeovers)} takeovers, "
            f"{len(self._history.operations):,} operations, findings: {len(self._history.findings)}"
        )

    def _goods(self) -> Goods:
        """What there is to push: bodies of two owners each, and names that stay."""
        owners = ("ann", "ben")
        tokens = {name: self._tokens.create(name, ("write",))[0] for name in owners}
        tokens["admin"] = self._tokens.create("admin", ("admin",))[0]
        goods = Goods(tokens=tokens)
        for number in range(_BODIES):
            body = npy(hills(25 + 9 * number, 40, seed=number))
            for owner in owners:
                goods.add(owner, f"hills {number}", body, array=True)
            goods.add(owners[number % 2], f"other {number}", body, array=True)
            if number < _NAMES:
                goods.names[f"latest-{number}"] = owners[number % 2]
        goods.add(owners[0], "cut short", npy(hills(seed=77))[:-1], sound=False)
        return goods

    def _client(self, name: str, goods: Goods, crowd: Crowd, *of: str) -> Client:
        random_ = random.Random(f"{self._seed} {name}")
        return Client(name, self._history, goods, lambda: self.site.servers(*of), crowd.ids, random_)

    def _leases(self) -> int:
        """How often the lease has been taken."""
        return int(json.loads(self._store.get(WRITER)[0])["number"])

    def _calm(self, seconds: float, work: Callable[[], object] = lambda: None) -> None:
        """Let nothing happen for a while."""
        begun, before = self._history.clock(), self._leases()
        writer = self.site.settle()
        waiting = self.site.called(next(name for name in WRITERS if name != writer))
        settled = self._history.clock()
        time.sleep(seconds)
        work()
        if self._leases() == before:
            self._history.waits(Span(settled, self._history.clock(), waiting))
        else:
            self._done.restless += 1
            self._history.trouble(Span(begun, self._history.clock()))

    def _disaster(self, kind: str, goods: Goods, crowd: Crowd) -> None:
        """Let something happen, and wait until all is as before."""
        begun, site, proxy = self._history.clock(), self.site, self._proxy
        writer = site.settle()
        waiting = next(name for name in WRITERS if name != writer)
        reader = self._random.choice(READERS)
        if kind == "network" or self._random.random() < 0.6:
            proxy.delay = self._random.choice((0.0, 0.05, 0.2))
            where = ("PUT", "GET", "DELETE", ".")
            proxy.faults = [
                Fault(self._random.choice(_KINDS), self._random.randint(1, 8), self._random.choice(where))  # type: ignore[arg-type]
                for _ in range(self._random.randint(1, 4))
            ]
        faults = sum(fault.times for fault in proxy.faults)
        match kind:
            case "kill" | "stop" | "end":
                self._taken_over(kind, writer, waiting)
                if kind == "stop":
                    self._wakes(writer, goods, crowd)
            case "kill waiting" | "kill reader":
                name = waiting if kind == "kill waiting" else reader
                site.kill(name)
                self._moment()
                site.start(name)
            case "stop reader":
                site.stop(reader)
                self._moment()
                site.go_on(reader)
            case _:
                self._moment()
        self._done.faults += faults - sum(fault.times for fault in proxy.faults)
        proxy.faults, proxy.delay = [], 0.0
        site.settle()
        self._history.trouble(Span(begun, self._history.clock()))
        self._done.disasters[kind] += 1

    def _moment(self) -> None:
        time.sleep(self._random.uniform(0.1, 1.5) * self._times.lease)

    def _taken_over(self, kind: str, writer: str, waiting: str) -> None:
        """Let the server that writes go; the other one takes over."""
        site, history, begun = self.site, self._history, time.monotonic()
        {"kill": site.kill, "stop": site.stop, "end": site.end}[kind](writer)
        site.wait(lambda: site.role(waiting) == "writer", f"{waiting} to take over")
        taken = time.monotonic() - begun
        self._done.takeovers.append(taken)
        limit = self._times.lease + _TAKEOVER + self._times.slack
        if taken > limit:
            history.found("takeover", f"{waiting}: expected it to write {limit:.0f} s after a {kind}, got {taken:.1f}")
        if kind != "stop":
            site.start(writer)

    def _wakes(self, name: str, goods: Goods, crowd: Crowd) -> None:
        """Let a server go on that was stopped until another one wrote, and ask it for uploads at once."""
        site, history = self.site, self._history
        since, before = history.clock(), self._leases()
        called = site.called(name)
        if self._random.random() < 0.5:
            self._moment()
        # It does not learn at once that another one has the lease: it must know by the time.
        self._proxy.faults.append(Fault("503", _OF_LEASE, rf"\S+ \S*{WRITER}"))
        self._done.faults += _OF_LEASE  # those that are left are taken off
        site.go_on(name)
        until = time.monotonic() + self._random.uniform(0.3, 1.5) * self._times.lease
        with closing(self._client(f"operator at {name}", goods, crowd, name)) as operator:
            while time.monotonic() < until:
                operator.upload(self._random.choice(list(goods.bodies)))
                time.sleep(0.02)
        if self._leases() == before:
            history.waits(Span(since, history.clock(), called))

    def _settled(self, goods: Goods, crowd: Crowd) -> Callable[[], None]:
        """Ask every server for everything, once every build has come to its end."""

        def work() -> None:
            until = time.monotonic() + PATIENCE
            with closing(self._client("operator", goods, crowd, self.site.writer() or "")) as operator:
                for subject in goods.bodies:
                    state = operator.settled(subject, until)
                    if state == "waiting":
                        operator.retry(subject)
                        state = operator.settled(subject, until)
                    if state is None or state == "waiting":
                        self._history.found("never built", f"{subject}: expected its build to end, got {state}")
                    self._done.ready += state == "ready"
            time.sleep((self._history.lag or 0) + 1)
            for name in (*WRITERS, *READERS):
                with closing(self._client(f"operator at {name}", goods, crowd, name)) as operator:
                    operator.list("ann")
                    operator.names("ann")
                    for subject in goods.bodies:
                        operator.look(subject)
                        operator.fetch(subject)
                        operator.values(subject)

        return work


class _Watch:
    """Looks again and again what one reader has."""

    def __init__(self, history: History, goods: Goods, site: BucketSite, name: str, ids: dict[Subject, str]) -> None:
        self._client = Client(f"watch of {name}", history, goods, lambda: site.servers(name), ids, random.Random(name))

    def step(self) -> None:
        self._client.list("ann")
        time.sleep(0.2)

    def close(self) -> None:
        self._client.close()


class _Guests:
    """Tokens that are made and revoked: how long readers do not take them, and how long they do."""

    def __init__(self, history: History, site: BucketSite, tokens: TokenObject, name: str, limit: float) -> None:
        self.limit = limit
        self.made: list[Span] = []
        self.revoked: list[Span] = []
        self._history, self._site, self._tokens, self._name = history, site, tokens, name
        self._number = 0
        self._http = httpx.Client(trust_env=False, timeout=5.0)

    def step(self) -> None:
        self._number += 1
        name = f"{self._name} {self._number}"
        try:
            begun = self._history.clock()
            text, _ = self._tokens.create(name, ("read",))
            self.made += self._until(text, 200, begun)
            begun = self._history.clock()
            self._tokens.revoke(name)
        except LodestreamError:  # the network fails
            time.sleep(1)
            return
        self.revoked += self._until(text, 401, begun)
        time.sleep(1)

    def _until(self, text: str, status: int, begun: float) -> Iterator[Span]:
        """Ask all readers until they answer so, or the time is over; give the time of each but those that are gone."""
        until = time.monotonic() + self.limit + 1.0
        left = list(self._site.servers(*READERS))
        while left:
            for server in tuple(left):
                try:
                    answer = self._http.get(f"{server.url}/v1/surfaces", headers={"authorization": f"Bearer {text}"})
                except httpx.TransportError:
                    left.remove(server)
                    continue
                if answer.status_code == status or time.monotonic() > until:
                    yield Span(begun, self._history.clock(), server.name)
                    left.remove(server)
            time.sleep(0.1)

    def close(self) -> None:
        self._http.close()


@contextmanager
def _at_work(workers: Sequence[_Watch | _Guests]) -> Iterator[None]:
    """Let each do one step after another, in a thread of its own, until the block ends."""
    over, failures = threading.Event(), list[BaseException]()

    def work(worker: _Watch | _Guests) -> None:
        try:
            with closing(worker):
                while not over.is_set():
                    worker.step()
        except BaseException as error:
            failures.append(error)

    threads = [threading.Thread(target=work, args=(worker,)) for worker in workers]
    for thread in threads:
        thread.start()
    try:
        yield
    finally:
        over.set()
        for thread in threads:
            thread.join()
    if failures:
        raise failures[0]


def _troubled(history: History, begun: float, ended: float) -> bool:
    """Whether anything failed meanwhile, or shortly before."""
    lag = history.lag or 0.0
    return any(span.begun <= ended and begun - lag <= span.ended for span in history.troubles)


def _lags(history: History) -> Iterator[float]:
    """Seconds from the answer to an upload until a reader showed the surface, while nothing failed.

    Of surfaces that the reader did not have before, and that nobody deleted meanwhile.
    """
    deletes = defaultdict[Subject | None, list[Operation]](list)
    for operation in history.operations:
        if operation.kind == "delete":
            deletes[operation.subject].append(operation)
    for reader in READERS:
        lists = sorted(
            (
                (operation.ended, {seen.id for seen in operation.answer.seen})
                for operation in history.operations
                if operation.client == f"watch of {reader}" and operation.kind == "list"
                if operation.ended is not None and operation.answer is not None and operation.answer.status == 200
            ),
            key=itemgetter(0),
        )
        moments = [ended for ended, _ in lists]
        for upload in history.operations:
            if upload.kind != "upload" or upload.ended is None or upload.answer is None or upload.answer.status != 202:
                continue
            id_, acknowledged = upload.answer.seen[0].id, upload.ended
            before = bisect_left(moments, upload.begun)
            if before == 0 or id_ in lists[before - 1][1]:
                continue
            seen = next((ended for ended, ids in lists[before:] if id_ in ids), None)
            if seen is None or _troubled(history, upload.begun, seen):
                continue
            if not any(each.begun < seen and upload.begun < (each.ended or seen) for each in deletes[upload.subject]):
                yield max(0.0, seen - acknowledged)


def _count(history: History, done: Done) -> None:
    done.operations = len(history.operations)
    for operation in history.operations:
        status = None if operation.answer is None else operation.answer.status
        done.unanswered += status is None
        done.refused += status == 503
        done.uploads += operation.kind == "upload" and status in (200, 202)
        done.deletes += operation.kind == "delete" and status == 204
        done.pointed += operation.kind in ("point", "unpoint") and status in (200, 201, 204)
        done.reads += operation.kind in ("look", "list", "fetch", "values", "follow", "names") and status == 200
