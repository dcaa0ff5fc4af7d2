"""Clients that upload, delete and read at one or several servers, and record what they asked and what came back."""

from __future__ import annotations

import hashlib
import random
import threading
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, TypeAlias

import httpx

from tests.patience import PATIENCE as _PATIENCE

from .events import Answer, History, Kind, Operation, Seen, Subject

__all__ = ["Client", "Crowd", "Goods", "Server"]

_SETTLED = ("ready", "failed", "waiting")

_CHANGES = ("upload", "delete", "retry", "point", "unpoint")

# What is asked of a surface by its id.
_OF_ONE = ("delete", "retry", "look", "fetch", "values", "point")


@dataclass(frozen=True)
class Server:
    """One process of a server.

    Attributes
    ----------
    name : str
        Of this process; after a restart it is another.
    url : str
    only_reads : bool
        It is not asked for any change.
    """

    name: str
    url: str
    only_reads: bool = False


#: The servers that can be asked now; none while they are down.
Servers: TypeAlias = Callable[[], Sequence[Server]]


@dataclass
class Goods:
    """What clients have to push.

    Attributes
    ----------
    bodies : dict
        The bytes of each subject.
    tokens : dict
        The text of each token, by its name; empty where there are none.
    arrays : set of Subject
        Those whose bytes are an NPY file, which the finest level comes back as.
    names : dict
        Names that stay, each with its owner.
    """

    bodies: dict[Subject, bytes] = field(default_factory=dict)
    tokens: Mapping[str, str] = field(default_factory=dict)
    arrays: set[Subject] = field(default_factory=set)
    names: dict[str, str | None] = field(default_factory=dict)

    def add(self, owner: str | None, name: str, body: bytes, *, sound: bool = True, array: bool = False) -> Subject:
        """One thing more."""
        subject = Subject(owner, name, hashlib.sha256(body).hexdigest(), sound)
        self.bodies[subject] = body
        if array:
            self.arrays.add(subject)
        return subject


class Client:
    """Asks, and records it; an operation without an answer is a result like any other.

    Parameters
    ----------
    name : str
    history : History
    goods : Goods
    servers : callable
    ids : dict
        The id of each subject, for all clients, as soon as one of them is told.
    random_ : Random
    """

    def __init__(
        self,
        name: str,
        history: History,
        goods: Goods,
        servers: Servers,
        ids: dict[Subject, str],
        random_: random.Random,
    ) -> None:
        self._name = name
        self._history = history
        self._goods = goods
        self._servers = servers
        self._ids = ids
        self._random = random_
        self._http = httpx.Client(trust_env=False, timeout=_PATIENCE)

    def close(self) -> None:
        """Close its connections."""
        self._http.close()

    def upload(self, subject: Subject) -> Answer | None:
        """Push."""
        body = self._goods.bodies[subject]
        how = self._random.choices(({"content": body}, {"content": self._slowly(body)}, _as_form(body)), (5, 2, 3))[0]

        def ask(url: str, headers: dict[str, str]) -> Answer:
            return _entry(self._http.post(f"{url}/v1/surfaces", params={"name": subject.name}, headers=headers, **how))

        answer = self._do("upload", subject.owner, subject, None, ask)
        if answer is not None and answer.seen:
            self._ids.setdefault(subject, answer.seen[0].id)
        return answer

    def delete(self, subject: Subject, caller: str | None) -> Answer | None:
        """Delete, whether the caller may or not."""
        return self._of_surface("delete", "DELETE", "", subject, caller)

    def retry(self, subject: Subject) -> Answer | None:
        """Have it built again."""
        return self._of_surface("retry", "POST", "/retry", subject, subject.owner)

    def look(self, subject: Subject, caller: str | None = None) -> Answer | None:
        """Ask for its state."""
        return self._of_surface("look", "GET", "", subject, caller or subject.owner)

    def fetch(self, subject: Subject) -> Answer | None:
        """Ask for its container."""

        def ask(url: str, headers: dict[str, str]) -> Answer:
            answer = self._http.get(f"{url}/v1/surfaces/{self._ids[subject]}/container", headers=headers)
            return _file(answer, answer.headers.get("etag", "").strip('"'))

        return self._do("fetch", subject.owner, subject, self._ids.get(subject), ask)

    def values(self, subject: Subject) -> Answer | None:
        """Ask for its finest level as an NPY file; None where it is not one, or not known to be ready."""

        def ask(url: str, headers: dict[str, str]) -> Answer:
            found = self._http.get(f"{url}/v1/surfaces/{self._ids[subject]}", headers=headers)
            levels = found.json().get("levels") if found.status_code == 200 else None
            if not levels:
                return _entry(found)
            finest = f"{url}/v1/surfaces/{self._ids[subject]}/levels/{len(levels) - 1}"
            return _file(self._http.get(finest, headers=headers))

        if subject not in self._goods.arrays:
            return None
        return self._do("values", subject.owner, subject, self._ids.get(subject), ask)

    def list(self, caller: str | None) -> Answer | None:
        """Ask what there is, page by page."""

        def ask(url: str, headers: dict[str, str]) -> Answer:
            seen: list[Seen] = []
            place = "/v1/surfaces?limit=1000"
            while place:
                answer = self._http.get(f"{url}{place}", headers=headers)
                if answer.status_code != 200:
                    return _entry(answer)
                page = answer.json()
                seen += map(_seen, page["surfaces"])
                place = page["next"]
            return Answer(200, tuple(seen))

        return self._do("list", caller, None, None, ask)

    def point(self, name: str, subject: Subject) -> Answer | None:
        """Let a name lead to a surface."""

        def ask(url: str, headers: dict[str, str]) -> Answer:
            wanted = {"surface": self._ids[subject]}
            return _entry(self._http.put(f"{url}/v1/names/{name}", json=wanted, headers=headers), entries=False)

        return self._do("point", self._goods.names[name], subject, self._ids.get(subject), ask, name)

    def unpoint(self, name: str) -> Answer | None:
        """Let a name lead nowhere."""

        def ask(url: str, headers: dict[str, str]) -> Answer:
            return _entry(self._http.delete(f"{url}/v1/names/{name}", headers=headers))

        return self._do("unpoint", self._goods.names[name], None, None, ask, name)

    def follow(self, name: str) -> Answer | None:
        """Ask for the surface to which a name leads."""

        def ask(url: str, headers: dict[str, str]) -> Answer:
            return _entry(self._http.get(f"{url}/v1/names/{name}", headers=headers))

        return self._do("follow", self._goods.names[name], None, None, ask, name)

    def names(self, caller: str | None) -> Answer | None:
        """Ask which names there are."""

        def ask(url: str, headers: dict[str, str]) -> Answer:
            names: list[tuple[str, str]] = []
            place = "/v1/names?limit=1000"
            while place:
                answer = self._http.get(f"{url}{place}", headers=headers)
                if answer.status_code != 200:
                    return _entry(answer)
                page = answer.json()
                names += ((each["name"], each["surface"].rpartition("/")[2]) for each in page["names"])
                place = page["next"]
            return Answer(200, names=tuple(names))

        return self._do("names", caller, None, None, ask)

    def settled(self, subject: Subject, until: float) -> str | None:
        """The state in which a surface stays, "absent" if there is none; None if there is no answer until then."""
        while time.monotonic() < until:
            answer = self.look(subject)
            if answer is not None and answer.status == 404:
                return "absent"
            if answer is not None and answer.seen and answer.seen[0].state in _SETTLED:
                return answer.seen[0].state
            time.sleep(0.05)
        return None

    def _slowly(self, body: bytes) -> Iterator[bytes]:
        step = max(1, len(body) // 8)
        for start in range(0, len(body), step):
            yield body[start : start + step]
            time.sleep(self._random.uniform(0, 0.02))

    def _of_surface(self, kind: Kind, method: str, path: str, subject: Subject, caller: str | None) -> Answer | None:
        def ask(url: str, headers: dict[str, str]) -> Answer:
            address = f"{url}/v1/surfaces/{self._ids[subject]}{path}"
            return _entry(self._http.request(method, address, headers=headers))

        return self._do(kind, caller, subject, self._ids.get(subject), ask)

    def _do(
        self,
        kind: Kind,
        caller: str | None,
        subject: Subject | None,
        surface: str | None,
        ask: Callable[[str, dict[str, str]], Answer],
        name: str | None = None,
    ) -> Answer | None:
        servers = [each for each in self._servers() if not (each.only_reads and kind in _CHANGES)]
        if not servers or (kind in _OF_ONE and surface is None):
            time.sleep(0.02)
            return None
        server = self._random.choice(servers)
        token = self._goods.tokens.get(caller or "")
        headers = {} if token is None else {"authorization": f"Bearer {token}"}
        operation = self._history.begin(self._name, server.name, kind, caller, subject, surface, name)
        if server.name in self._history.ends:  # between the choice and the beginning
            self._history.forget(operation)
            return None
        answer = self._asked(operation, lambda: ask(server.url, headers))
        if answer is not None:
            self._history.end(operation, answer)
        return answer

    def _asked(self, operation: Operation, ask: Callable[[], Answer]) -> Answer | None:
        try:
            return ask()
        except httpx.ConnectError:
            # Nothing was sent; of several requests the ones before only read.
            self._history.forget(operation)
            time.sleep(0.02)
        except httpx.TransportError:
            self._history.cut(operation)
            time.sleep(0.02)
        return None


def _as_form(body: bytes) -> dict[str, Any]:
    return {"files": {"file": ("file", body)}}


def _seen(entry: dict[str, Any]) -> Seen:
    return Seen(entry["id"], entry["state"], entry["name"], entry["container_sha256"])


def _entry(answer: httpx.Response, *, entries: bool = True) -> Answer:
    """A surface, or a problem; without entries something else."""
    if answer.headers.get("content-type", "").startswith("application/problem+json"):
        return Answer(answer.status_code, code=str(answer.json()["code"]))
    if answer.status_code in (200, 202) and answer.content and entries:
        return Answer(answer.status_code, (_seen(answer.json()),))
    return Answer(answer.status_code)


def _file(answer: httpx.Response, named: str | None = None) -> Answer:
    if answer.status_code != 200:
        return _entry(answer)
    return Answer(200, sha256=hashlib.sha256(answer.content).hexdigest(), named=named)


class Crowd:
    """Clients at work, each in a thread of its own, from the beginning of the ``with`` block to its end.

    Parameters
    ----------
    history : History
    goods : Goods
    servers : callable
    subjects : sequence of Subject
        Those that may be uploaded and deleted at any moment; all others are only read.
    seed : int
    size : int
    """

    def __init__(
        self,
        history: History,
        goods: Goods,
        servers: Servers,
        subjects: Sequence[Subject],
        *,
        seed: int,
        size: int,
    ) -> None:
        self.ids: dict[Subject, str] = {}
        self._goods = goods
        self._subjects = list(subjects)
        self._all = list(goods.bodies)
        self._callers: list[str | None] = [*goods.tokens] or [None]
        self._names = [*goods.names] or [""]
        self._over = threading.Event()
        self._failures: list[BaseException] = []
        self._clients = []
        self._threads = []
        for number in range(size):
            random_ = random.Random(f"{seed} {number}")
            client = Client(f"client {number}", history, goods, servers, self.ids, random_)
            self._clients.append(client)
            self._threads.append(threading.Thread(target=self._work, args=(client, random_)))

    def __enter__(self) -> Crowd:
        for thread in self._threads:
            thread.start()
        return self

    def __exit__(self, *exception: object) -> None:
        self._over.set()
        for thread in self._threads:
            thread.join()
        for client in self._clients:
            client.close()
        if self._failures and exception[0] is None:
            raise self._failures[0]

    def _work(self, client: Client, random_: random.Random) -> None:
        try:
            while not self._over.is_set():
                self._act(client, random_)
                self._over.wait(random_.uniform(0, 0.03))
        except BaseException as error:
            self._failures.append(error)

    def _act(self, client: Client, random_: random.Random) -> None:
        subject = random_.choice(self._subjects)
        any_ = random_.choice(self._all)
        name = random_.choice(self._names)
        match random_.choices(range(10), (35, 16, 20, 8, 15, 6, *((9, 2, 6, 3) if name else (0, 0, 0, 0))))[0]:
            case 0:
                client.upload(subject)
            case 1:
                # Most often it is the owner.
                client.delete(subject, random_.choice((*self._callers, subject.owner, subject.owner)))
            case 2:
                client.look(any_, random_.choice(self._callers))
            case 3:
                client.list(random_.choice(self._callers))
            case 4:
                client.fetch(any_)
            case 5:
                client.values(any_)
            case 6:
                owner = self._goods.names[name]
                client.point(name, random_.choice([each for each in self._subjects if each.owner == owner]))
            case 7:
                client.unpoint(name)
            case 8:
                client.follow(name)
            case _:
                client.names(random_.choice(self._callers))
