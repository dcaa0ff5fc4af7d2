"""What clients have asked of one or several servers, and what came back: the history that `checker` judges."""

from __future__ import annotations

import gzip
import pickle
import threading
import time
from bisect import bisect_right
from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Literal, TypeAlias

__all__ = ["Answer", "Finding", "History", "Kind", "Mark", "Operation", "Seen", "Span", "Subject"]

Kind: TypeAlias = Literal[
    "upload", "delete", "retry", "look", "list", "fetch", "values", "point", "unpoint", "follow", "names"
]
MarkKind: TypeAlias = Literal["backup begins", "backup ends", "restored"]

# What a history has in a file.
_RECORDED = ("admins", "operations", "marks", "ends", "findings", "lag", "troubles", "waiting")


@dataclass(frozen=True)
class Subject:
    """Bytes that somebody pushes under a name: on a server one surface.

    Attributes
    ----------
    owner : str or None
        Name of the token; None where there are no tokens.
    name : str
    sha256 : str
        Of the bytes.
    sound : bool
        They can be read and built.
    """

    owner: str | None
    name: str
    sha256: str
    sound: bool = True

    def __str__(self) -> str:
        return f"{self.name} of {self.owner}" if self.owner else self.name


@dataclass(frozen=True)
class Seen:
    """What an answer says of one surface.

    Attributes
    ----------
    id, state : str
    name : str or None
    container : str or None
        SHA-256 in hexadecimal digits.
    """

    id: str
    state: str
    name: str | None = None
    container: str | None = None


@dataclass(frozen=True)
class Answer:
    """What came back.

    Attributes
    ----------
    status : int
        Of HTTP; of the last answer where the first one is a redirect.
    seen : tuple of Seen
    code : str or None
        Of a problem document.
    sha256 : str or None
        Of the bytes of a container, or of the values.
    named : str or None
        The SHA-256 under which the server showed a container.
    names : tuple of (str, str)
        Names that stay, and the ids of the surfaces to which they lead.
    """

    status: int
    seen: tuple[Seen, ...] = ()
    code: str | None = None
    sha256: str | None = None
    named: str | None = None
    names: tuple[tuple[str, str], ...] = ()


@dataclass(eq=False)
class Operation:
    """One thing that a client asked for.

    Attributes
    ----------
    client, server : str
        Who asked, and whom: one process of a server, which has another name after a restart.
    kind : Kind
    caller : str or None
        Name of the token with which it was asked.
    subject : Subject or None
        None for a list, and of a name for all but where it is to lead.
    surface : str or None
        The id that was asked for.
    begun : float
        Seconds, by the history's clock.
    ended : float or None
        When the answer had come; None when none came.
    answer : Answer or None
    name : str or None
        A name that stays, and leads to one surface after another.
    """

    client: str
    server: str
    kind: Kind
    caller: str | None
    subject: Subject | None
    surface: str | None
    begun: float
    ended: float | None = None
    answer: Answer | None = None
    name: str | None = None

    def __str__(self) -> str:
        ended = "" if self.ended is None else f"{self.ended:.4f}"
        words = f"{self.begun:10.4f} to {ended:>9} {self.client} at {self.server}: {self.kind}"
        if self.name is not None:
            words += f" {self.name}" + (f" to {self.subject}" if self.subject is not None else "")
        if self.caller is not None:
            words += f" as {self.caller}"
        if self.answer is None:
            return f"{words}: no answer"
        states = ", ".join(seen.state for seen in self.answer.seen) if self.kind != "list" else ""
        return f"{words}: {self.answer.status} {states or self.answer.code or ''}".rstrip()


@dataclass(frozen=True)
class Mark:
    """Something that happened to all surfaces at one moment."""

    kind: MarkKind
    moment: float


@dataclass(frozen=True)
class Span:
    """A time, of one server or of all."""

    begun: float
    ended: float
    server: str | None = None

    def holds(self, operation: Operation) -> bool:
        """Whether an operation was asked and answered within it, at its server."""
        if operation.ended is None or self.server not in (None, operation.server):
            return False
        return self.begun <= operation.begun and operation.ended <= self.ended


@dataclass(frozen=True)
class Finding:
    """Something that must not be.

    Attributes
    ----------
    rule : str
        Which promise is broken, in a word or two.
    text : str
        What was expected and what came, in one line.
    operations : tuple of Operation
        What was asked of that surface around it, in the order in which it began.
    """

    rule: str
    text: str
    operations: tuple[Operation, ...] = ()

    def __str__(self) -> str:
        return "\n".join((f"{self.rule}: {self.text}", *(f"  {operation}" for operation in self.operations)))


@dataclass
class History:
    """A history as it is being recorded, by several threads.

    Attributes
    ----------
    clock : callable
        Seconds, of any beginning; the same for all that is recorded.
    admins : frozenset of str
        Callers who may change what belongs to others.
    operations : list of Operation
    marks : list of Mark
    ends : dict
        When another server was ready after each of them: what it had not answered has happened by then, or never.
    findings : list of Finding
        What was seen to be wrong while it was recorded.
    lag : float or None
        Seconds after which servers that follow another one show what it has acknowledged; None: they do so at once.
    troubles : list of Span
        Times of which that is not so, one after another.
    waiting : list of Span
        When a server was known not to be the one that writes: it acknowledges nothing then, and does nothing.
    """

    clock: Callable[[], float] = time.monotonic
    admins: frozenset[str] = frozenset()
    operations: list[Operation] = field(default_factory=list)
    marks: list[Mark] = field(default_factory=list)
    ends: dict[str, float] = field(default_factory=dict)
    findings: list[Finding] = field(default_factory=list)
    lag: float | None = None
    troubles: list[Span] = field(default_factory=list)
    waiting: list[Span] = field(default_factory=list)
    _open: Counter[str] = field(default_factory=Counter, repr=False)
    _lock: threading.Lock = field(default_factory=threading.Lock, repr=False)

    def begin(
        self,
        client: str,
        server: str,
        kind: Kind,
        caller: str | None = None,
        subject: Subject | None = None,
        surface: str | None = None,
        name: str | None = None,
    ) -> Operation:
        """Note that something is about to be asked."""
        with self._lock:
            operation = Operation(client, server, kind, caller, subject, surface, self.clock(), name=name)
            self.operations.append(operation)
            self._open[server] += 1
            return operation

    def end(self, operation: Operation, answer: Answer) -> None:
        """Note what was answered."""
        with self._lock:
            operation.ended = self.clock()
            operation.answer = answer
            self._open[operation.server] -= 1

    def cut(self, operation: Operation) -> None:
        """Note that no answer will come."""
        with self._lock:
            self._open[operation.server] -= 1

    def forget(self, operation: Operation) -> None:
        """Take back what was never sent."""
        with self._lock:
            self.operations.remove(operation)
            self._open[operation.server] -= 1

    def open(self, server: str) -> int:
        """How many answers of a server are still to come."""
        with self._lock:
            return self._open[server]

    def trouble(self, span: Span) -> None:
        """Note a time in which servers need not follow in time; it is the latest one."""
        with self._lock:
            self.troubles.append(span)

    def waits(self, span: Span) -> None:
        """Note when a server did not write."""
        with self._lock:
            self.waiting.append(span)

    def since(self, operation: Operation) -> float | None:
        """From which moment on an answer may tell the state; None: from when it was asked for.

        What was acknowledged is told by the server that writes.
        """
        if self.lag is None or operation.ended is None or operation.answer is None:
            return None
        if operation.kind in ("upload", "retry") and operation.answer.status in (200, 202):
            return None
        since = operation.begun - self.lag
        # One after another: those before one that is too early are too early as well.
        for number in range(bisect_right(self.troubles, operation.ended, key=lambda span: span.begun) - 1, -1, -1):
            span = self.troubles[number]
            if span.ended < since:
                break
            since = min(since, span.begun - self.lag)
        return since

    def refused(self) -> int:
        """How often it was answered until now that there is no room."""
        with self._lock:
            return sum(operation.answer is not None and operation.answer.status == 507 for operation in self.operations)

    def server_ended(self, server: str) -> None:
        """Note that a server has ended, and that all it was doing has happened by now, or never will."""
        with self._lock:
            self.ends.setdefault(server, self.clock())

    def ended_if_quiet(self, server: str) -> bool:
        """Note the same of a server that has given every answer; whether it has."""
        with self._lock:
            if not self._open[server]:
                self.ends.setdefault(server, self.clock())
            return not self._open[server]

    def mark(self, kind: MarkKind) -> None:
        """Note that a backup begins or has ended, or that a server is about to start in what was restored from it."""
        with self._lock:
            self.marks.append(Mark(kind, self.clock()))

    def write(self, path: Path) -> None:
        """Write all that was recorded to a file, from which `read` makes it again."""
        with self._lock:
            recorded = {name: getattr(self, name) for name in _RECORDED}
            path.write_bytes(gzip.compress(pickle.dumps(recorded), compresslevel=1))

    @classmethod
    def read(cls, path: Path) -> History:
        """Make a history of a file that `write` has written."""
        return cls(**pickle.loads(gzip.decompress(path.read_bytes())))

    def found(self, rule: str, text: str) -> None:
        """Note that something is wrong."""
        with self._lock:
            self.findings.append(Finding(rule, text))
