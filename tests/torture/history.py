"""A history of one server under load, through one disaster after another, and what the checker says of it.

Clients upload, delete and read all the time, whatever becomes of the server; with tokens they are two owners and an
admin, who push the same bytes under the same names. `tests.history.checker` gets what they asked and what came back,
and nothing else: neither it nor the clients look into the server's folder.
"""

from __future__ import annotations

import io
import random
import time
from collections import Counter
from collections.abc import Sequence
from contextlib import ExitStack, closing
from dataclasses import dataclass, field
from pathlib import Path

import lodestream as ls
from lodestream.formats import write_stream
from tests.history.checker import check
from tests.history.disasters import KINDS, Disasters
from tests.history.driver import Client, Crowd, Goods
from tests.history.events import Finding, History, Subject
from tests.history.site import Site, can_fill
from tests.server.helpers import hills, npy

__all__ = ["CLIENTS", "Done", "possible", "run"]

#: That are at work at the same time.
CLIENTS = 5

_BODIES = 8
_NAMES = 3
_SHOWN = 10


@dataclass
class Done:
    """What happened.

    Attributes
    ----------
    operations : int
        Asked, and not refused by a server that was down.
    uploads, deletes, reads, pointed : int
        Acknowledged, or answered with what they asked for.
    refused : int
        Answered 507.
    unanswered : int
    owners : int
        With a token of their own; 0 without tokens.
    disasters : Counter
        Of each kind.
    ready : int
        Surfaces that could be fetched at the end.
    findings : list of Finding
    seconds : float
    """

    operations: int = 0
    uploads: int = 0
    deletes: int = 0
    reads: int = 0
    pointed: int = 0
    refused: int = 0
    unanswered: int = 0
    owners: int = 0
    disasters: Counter[str] = field(default_factory=Counter)
    ready: int = 0
    findings: list[Finding] = field(default_factory=list)
    seconds: float = 0.0


def possible() -> tuple[str, ...]:
    """The kinds of disasters that this machine can have."""
    return tuple(kind for kind in KINDS if kind != "full" or can_fill())


def run(
    folder: Path,
    count: int,
    seconds: float | None = None,
    *,
    seed: int = 1,
    kinds: Sequence[str] | None = None,
    owners: bool = True,
    longest: float = 1.5,
) -> Done:
    """Let so many disasters happen to a server, or as many as the seconds allow, and judge the history.

    Parameters
    ----------
    folder : Path
        An empty one.
    count : int
    seconds : float or None
    seed : int
        Of all that is left to chance but the moments at which processes run.
    kinds : sequence of str or None
        Those of `KINDS` that may come, each as often as the others; None for all that this machine can have.
    owners : bool
        With tokens, and with surfaces that differ in nothing but their owner or their name.
    longest : float
        Most seconds between two things that happen.

    Raises
    ------
    AssertionError
        When a server does not start, and nothing more can be asked; the findings up to then are in its message.
    """
    started = time.monotonic()
    kinds = possible() if kinds is None else tuple(kinds)
    random_ = random.Random(seed)
    history = History(admins=frozenset({"admin"}))
    root = folder / "site"
    root.mkdir()
    site = Site(root, history, "64m" if "full" in kinds else None)
    done, held = Done(owners=2 if owners else 0), ExitStack()
    held.callback(site.close)
    try:
        goods, subjects, picture = _goods(site, owners, with_picture="extra" in kinds)
        site.start()
        crowd = Crowd(history, goods, site.servers, subjects, seed=seed, size=CLIENTS)
        operator = held.enter_context(closing(Client("operator", history, goods, site.servers, crowd.ids, random_)))
        # Their ids are learned first, so that a list can be read whatever is answered later.
        for subject in goods.bodies:
            operator.upload(subject)
        disasters = Disasters(site, history, operator, picture, folder, random_, longest)
        left: list[str] = []
        with crowd:
            while disasters.count < count and (seconds is None or time.monotonic() - started < seconds):
                left = left or random_.sample(kinds, len(kinds))
                disasters.happen(left.pop())
        done.disasters = disasters.done
        done.ready = disasters.settle([subject for subject in goods.bodies if subject in crowd.ids])
        site.stop()
    except AssertionError as error:
        raise AssertionError("\n".join((str(error), *map(str, check(history)[:_SHOWN])))) from error
    finally:
        held.close()
    done.findings = check(history)
    _count(history, done)
    done.seconds = time.monotonic() - started
    return done


def _goods(site: Site, owners: bool, *, with_picture: bool) -> tuple[Goods, list[Subject], Subject | None]:
    """What there is to push: bodies of their own, with owners each under two names and of two owners."""
    names: tuple[str, ...] = ("ann", "ben") if owners else ()
    tokens = {name: site.make_token(name, "write") for name in names}
    if owners:
        tokens["admin"] = site.make_token("admin", "admin")
    goods = Goods(tokens=tokens)
    for number in range(_BODIES // 2 if owners else _BODIES):
        body = npy(hills(25 + 9 * number, 40, seed=number))
        for owner in names or (None,):
            goods.add(owner, f"hills {number}", body, array=True)
        if owners:
            goods.add(names[number % 2], f"other {number}", body, array=True)
        if number < _NAMES:
            goods.names[f"latest-{number}"] = names[number % 2] if owners else None
    goods.add(names[0] if owners else None, "cut short", npy(hills(seed=77))[:-1], sound=False)
    subjects = list(goods.bodies)
    if not with_picture:
        return goods, subjects, None
    return goods, subjects, goods.add(names[-1] if owners else None, "picture", _geotiff())


def _geotiff() -> bytes:
    file = io.BytesIO()
    write_stream(ls.Surface(hills(60, 50, seed=99)), "geotiff", file)
    return file.getvalue()


def _count(history: History, done: Done) -> None:
    done.operations = len(history.operations)
    for operation in history.operations:
        status = None if operation.answer is None else operation.answer.status
        done.unanswered += status is None
        done.refused += status == 507
        done.uploads += operation.kind == "upload" and status in (200, 202)
        done.deletes += operation.kind == "delete" and status == 204
        done.reads += operation.kind in ("look", "list", "fetch", "values", "follow", "names") and status == 200
        done.pointed += operation.kind in ("point", "unpoint") and status in (200, 204)
