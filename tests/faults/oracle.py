"""What a server has acknowledged, and whether it stands by it: asked by HTTP, compared by hashes.

Nothing here knows how the server keeps anything.
"""

from __future__ import annotations

import contextlib
import hashlib
import time
from dataclasses import dataclass, field
from typing import Any

import httpx
import numpy as np
from numpy.typing import NDArray

import lodestream as ls

from .programs import PATIENCE

__all__ = ["Kept", "Ledger", "Problem", "Talk"]

#: What an answer may say while a call fails: the server's fault, or not now.
_EXCUSES = (409,)

# Where a token is needed and the file of tokens cannot be read, nobody may do anything.
_NO_TOKENS = (401, 403)

_RETRIES = 5


@dataclass(frozen=True, order=True)
class Problem:
    """Something that must not be.

    Attributes
    ----------
    case : str
        The fault after which it was seen, or the one that concerned the surface.
    kind : "lost", "wrong", "answer", "hangs" or "died"
        Something acknowledged is gone; something is another; an answer is no clean error; something takes too long; a
        process has ended.
    text : str
    """

    case: str
    kind: str
    text: str

    def __str__(self) -> str:
        return f"{self.kind}: {self.case}: {' '.join(self.text.split())}"


@dataclass
class Kept:
    """A surface that a server has acknowledged.

    Attributes
    ----------
    points : array of shape (rows, columns) or None
        What was uploaded; None for what is no surface, whose build fails.
    case : str
        The fault that concerns it.
    container : str or None
        The SHA-256 of its container, once that was told.
    bare : bool
        Its container is not there, which a server sees when it is asked for it: then it builds it again.
    """

    points: NDArray[Any] | None
    case: str
    container: str | None = None
    bare: bool = False


@dataclass
class Ledger:
    """What has been acknowledged.

    Attributes
    ----------
    kept : dict
        By id, what was answered that it is stored.
    gone : dict
        By id, what was answered that it is deleted, and the case.
    """

    kept: dict[str, Kept] = field(default_factory=dict)
    gone: dict[str, str] = field(default_factory=dict)

    def stored(self, surface: str, points: NDArray[Any] | None, case: str) -> None:
        """An upload was acknowledged."""
        self.gone.pop(surface, None)
        self.kept.setdefault(surface, Kept(points, case)).case = case

    def deleted(self, surface: str, case: str) -> None:
        """A delete was acknowledged."""
        self.kept.pop(surface, None)
        self.gone[surface] = case


_decoded: dict[str, NDArray[Any]] = {}


class Talk:
    """A talk with a server, in which whatever must not be is noted.

    Parameters
    ----------
    http : httpx.Client
    ledger : Ledger
    problems : list of Problem
        Grows.

    Attributes
    ----------
    case : str
        What the problems belong to now.
    lenient : bool
        A call may fail now, so that an answer may be an error.
    no_tokens : bool
        The call that may fail is one for the file of tokens.
    """

    def __init__(self, http: httpx.Client, ledger: Ledger, problems: list[Problem]) -> None:
        self.http = http
        self.ledger = ledger
        self.problems = problems
        self.case = ""
        self.lenient = False
        self.no_tokens = False

    def say(self, kind: str, text: str, case: str | None = None) -> None:
        """Note a problem."""
        self.problems.append(Problem(case or self.case, kind, text))

    def ask(self, method: str, url: str, good: tuple[int, ...], **options: Any) -> httpx.Response | None:
        """The answer, if its status is one of those expected; what is neither that nor a clean error is noted."""
        what = f"{method} {url}"
        answer: httpx.Response | None = None
        try:
            request = self.http.build_request(method, url, **options)
            answer = self.http.send(request, stream=True, follow_redirects=True)
            answer.read()
        except httpx.TimeoutException:
            self.say("hangs", f"{what}: no answer within {PATIENCE:g} s")
            return None
        except httpx.TransportError as error:
            # Of an answer that has begun nothing can be taken back: it is cut short, as whoever reads it sees.
            if answer is None or not self.lenient:
                self.say("answer", f"{what}: {error!r}")
            return None
        finally:
            if answer is not None:
                answer.close()
        if answer.status_code in good:
            return answer
        if not self._clean(answer):
            self.say(self._kind(answer), f"{what}: {answer.status_code} {answer.text[:200]}")
        return None

    def _clean(self, answer: httpx.Response) -> bool:
        if not self.lenient or answer.headers.get("content-type") != "application/problem+json":
            return False
        status = answer.status_code
        return status >= 500 or status in _EXCUSES or (self.no_tokens and status in _NO_TOKENS)

    def _kind(self, answer: httpx.Response) -> str:
        return "lost" if answer.status_code == 404 else "answer"

    def awaited(self) -> None:
        """Wait until the server says what there is."""
        until = time.monotonic() + PATIENCE
        with contextlib.suppress(httpx.TransportError):  # others see that it has died
            while self.http.get("/v1/surfaces?limit=1").status_code == 503:
                if time.monotonic() > until:
                    self.say("hangs", f"no list within {PATIENCE:g} s")
                    return
                time.sleep(0.05)

    def look(self, surface: str) -> dict[str, Any] | None:
        """What the server says of a surface."""
        answer = self.ask("GET", f"/v1/surfaces/{surface}", (200,))
        entry: dict[str, Any] | None = answer.json() if answer is not None else None
        return entry

    def quiet(self, surface: str) -> dict[str, Any] | None:
        """What the server says of a surface once nothing more happens to it by itself, for now."""
        until, pause = time.monotonic() + PATIENCE, 0.01
        while time.monotonic() < until:
            entry = self.look(surface)
            if entry is None and not self.lenient:
                return None
            if entry is not None and (entry["state"] not in ("queued", "building") or entry["reason"]):
                return entry
            time.sleep(pause)
            pause = min(1.5 * pause, 0.1)
        self.say("hangs", f"{surface} is not built within {PATIENCE:g} s")
        return None

    def ready(self, surface: str) -> dict[str, Any] | None:
        """What the server says of a surface once it is ready, or will not be; it is told to try again if it can be."""
        until, tries = time.monotonic() + PATIENCE, 0
        while True:
            entry = self.quiet(surface)
            if entry is None or entry["state"] == "ready" or time.monotonic() > until:
                return entry
            if tries == _RETRIES:
                return entry
            tries += 1
            self.ask("POST", f"/v1/surfaces/{surface}/retry", (200, 202, 409))
            time.sleep(0.1 + 0.2 * tries)

    def check(self, only: str | None = None) -> None:
        """Compare what the server has with what it has acknowledged; everything, or one surface."""
        self.lenient = False
        case = self.case
        listed = None if only else self._listed()
        for surface, kept in self.ledger.kept.items():
            self.case = kept.case
            if only in (None, surface):
                if listed is not None and surface not in listed:
                    self.say("lost", f"{surface} is not listed any more")
                self._whole(surface, kept)
        for surface, by in self.ledger.gone.items():
            if only in (None, surface) and self.http.get(f"/v1/surfaces/{surface}").status_code != 404:
                self.say("wrong", f"{surface} was deleted and is there again", by)
        self.case = case
        if listed is not None:
            for surface in sorted(listed - self.ledger.kept.keys() - self.ledger.gone.keys()):
                self.say("wrong", f"{surface} is listed, and nobody has uploaded it")

    def _listed(self) -> set[str] | None:
        answer = self.ask("GET", "/v1/surfaces?limit=1000", (200,))
        return {entry["id"] for entry in answer.json()["surfaces"]} if answer is not None else None

    def _whole(self, surface: str, kept: Kept) -> None:
        if kept.points is None:
            entry = self.quiet(surface)
            if entry is not None and entry["state"] == "ready":
                self.say("wrong", f"{surface} was no surface, and is ready")
            return
        if kept.bare:
            self.lenient = True
            self.ask("GET", f"/v1/surfaces/{surface}/container", (200,))
            self.lenient = False
        entry = self.ready(surface)
        if entry is None:
            return
        if entry["state"] != "ready":
            self.say("lost", f"{surface} is {entry['state']} for good: {entry['reason']}")
            return
        kept.container = kept.container or entry["container_sha256"]
        if kept.container != entry["container_sha256"]:
            self.say("wrong", f"{surface} has another container than before")
        self.container(surface, kept)

    def container(self, surface: str, kept: Kept) -> None:
        """Fetch a container, and compare it with what was uploaded."""
        answer = self.ask("GET", f"/v1/surfaces/{surface}/container", (200,))
        if answer is None:
            return
        sha256 = hashlib.sha256(answer.content).hexdigest()
        if sha256 != kept.container:
            self.say("wrong", f"the container of {surface} has {len(answer.content)} other bytes")
        elif sha256 not in _decoded:
            _decoded[sha256] = ls.decode(answer.content).points
        if sha256 in _decoded and not np.array_equal(_decoded[sha256], kept.points):  # type: ignore[arg-type]
            self.say("wrong", f"{surface} is another surface than the one that was uploaded")
