"""What may befall a server: ended, killed, out of room, lost and restored, without its index, without an extra."""

from __future__ import annotations

import random
import time
from collections import Counter
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, TypeVar

from tests import data_folder
from tests.patience import PATIENCE as _PATIENCE
from tests.server.helpers import eventually

from .driver import Client
from .events import History, Subject
from .site import Site

__all__ = ["KINDS", "Disasters"]

T = TypeVar("T")

#: What may become of an index.
_INDICES = ("removed", "scratch", "cut", "head", "pages")

#: Seconds after which what nothing refers to may be removed, and more.
_LONG = 2 * 86400.0


_MISSING_EXTRA = '''"""Stands where rasterio would be, and says that it is not installed."""

raise ModuleNotFoundError("No module named 'rasterio'", name="rasterio")
'''


class Disasters:
    """Things that happen to one server while clients are at work.

    Parameters
    ----------
    site : Site
        A server is running there before and after each of them.
    history : History
    operator : Client
        Who asks what nobody else does.
    picture : Subject or None
        A GeoTIFF that nobody but the operator uploads and deletes; without it no extra can be missing.
    folder : Path
        Any place apart from the server's.
    random_ : Random
    longest : float
        Most seconds for which clients are left alone.

    Attributes
    ----------
    done : Counter
        How often each kind came.
    """

    def __init__(
        self,
        site: Site,
        history: History,
        operator: Client,
        picture: Subject | None,
        folder: Path,
        random_: random.Random,
        longest: float,
    ) -> None:
        self.done = Counter[str]()
        self._site = site
        self._history = history
        self._operator = operator
        self._picture = picture
        self._folder = folder
        self._random = random_
        self._longest = longest
        self._left: dict[str, list[Any]] = {}

    @property
    def count(self) -> int:
        """How many came."""
        return sum(self.done[kind] for kind in KINDS)

    def happen(self, kind: str) -> None:
        """Let one of `KINDS` happen."""
        self._calm()
        KINDS[kind](self)
        self.done[kind] += 1

    def restart(self) -> None:
        """The server is told to end, and started again."""
        self._site.stop()
        self._site.start()

    def kill(self) -> None:
        """The server is killed at any moment, some of its build processes before it."""
        if self._random.random() < 0.5:
            self.done["build processes killed"] += self._site.kill_builds()
            self._calm()
        self._site.kill()
        self._site.start()

    def full(self) -> None:
        """The disk fills up; a server ends, and another starts, while it is full."""
        disk = self._site.disk
        assert disk is not None, "expected a site on a disk of its own"
        before = self._history.refused()
        disk.fill(self._random.choice((0, 0, 4096, 30_000)))
        self._calm()
        if self._history.refused() == before:  # there was room enough, or nobody had anything new
            disk.fill(0)
            eventually(lambda: self._history.refused() > before, "an upload for which there is no room")
        end = self._next("full", ("go on", "kill", "stop"))
        if end != "go on":
            self._end(end)
            self._site.start()
            self._calm()
        disk.empty()

    def backup(self) -> None:
        """The folder is copied under load as docs/operating.md says, lost later, and restored from the copy.

        With no index, with one that was copied under load too, or with the one of the folder that was lost.
        """
        site, history = self._site, self._history
        index = self._next("backup", ("none", "copied", "later"))
        history.mark("backup begins")
        data_folder.copy_small(site.data, site.backup)
        self._calm()
        data_folder.copy_rest(site.data, site.backup)
        if index == "copied":
            data_folder.copy_index(site.data, site.backup)
        history.mark("backup ends")
        self._calm()
        self._end(self._random.choice(("kill", "stop")))
        if index == "later":
            data_folder.move_index(site.data, site.backup)
        history.mark("restored")
        site.move_to(site.backup)
        site.start(ready=True)

    def index(self) -> None:
        """A server starts without its index, with a damaged one, or with one of long ago."""
        how = self._next("index", (*_INDICES, "older"))
        self._end(self._random.choice(("kill", "stop")))
        data, aside = self._site.data, self._site.aside
        if how == "older":
            data_folder.move_index(aside, data)
        elif how == "removed":
            data_folder.move_index(data, aside)
        else:
            self._harm(how)
        self._site.start(ready=True)

    def live_index(self) -> None:
        """The same while the server runs: it asks for a little patience, and makes the index again."""
        self._harm(self._next("live index", _INDICES))
        eventually(self._lists, "a server to make its index again")

    def _harm(self, how: str) -> None:
        data = self._site.data
        if how == "removed":
            data_folder.remove_index(data)
        elif how == "scratch":
            data_folder.remove_scratch(data)
        else:
            data_folder.damage_index(data, how, self._random)

    def _lists(self) -> bool:
        answer = self._operator.list(next(iter(self._history.admins), None))
        return answer is not None and answer.status == 200

    def collect(self) -> None:
        """Everything is old, and what nothing refers to is removed while no server runs."""
        site = self._site
        self._end(self._random.choice(("kill", "stop")))
        data_folder.age(site.data, _LONG)
        self._fsck("--collect")
        if left := data_folder.strays(site.data):
            self._history.found("collect", f"expected no strays, got {len(left)}: {', '.join(left[:3])}")
        site.start()

    def _fsck(self, option: str) -> None:
        result = self._site.command("fsck", str(self._site.inside), option)
        # What was deleted during a backup may be restored without its files, which is damage.
        restored = self.done["backup"] and result.returncode == 1 and " damaged" in result.stdout
        if result.returncode != 0 and not restored:
            said = " / ".join((result.stdout + result.stderr).strip().splitlines()[-3:])
            expected = f"expected lodestream fsck {option} to end with 0"
            self._history.found("fsck", f"{expected}, got {result.returncode}: {said}")

    def extra(self) -> None:
        """A server starts without rasterio: what needs it waits, and is built once it is there again."""
        assert self._picture is not None, "expected a GeoTIFF, got none"
        picture, operator, site = self._picture, self._operator, self._site
        modules = self._folder / "without-rasterio"
        modules.mkdir(exist_ok=True)
        (modules / "rasterio.py").write_text(_MISSING_EXTRA)
        self._end(self._random.choice(("kill", "stop")))
        site.start(without=modules)
        operator.delete(picture, picture.owner)
        operator.upload(picture)
        self._reaches(picture, "waiting", "without rasterio")
        self._end(self._random.choice(("kill", "stop")))
        if self._next("extra", ("request", "command")) == "command":
            self._fsck("--retry")
            site.start()
        else:
            site.start()
            operator.retry(picture)
        self._reaches(picture, "ready", "with rasterio again")

    def settle(self, subjects: Sequence[Subject]) -> int:
        """Wait until every build has come to its end, ask for everything; how many surfaces are ready."""
        until, ready = time.monotonic() + 2 * _PATIENCE, 0
        operator = self._operator
        operator.list(None if not subjects else subjects[0].owner)
        operator.names(None if not subjects else subjects[0].owner)
        for subject in subjects:
            state = operator.settled(subject, until)
            if state == "waiting":
                # Half of a surface may have been restored: somebody has to push it again, which is a retry too.
                again = operator.upload if self.done["backup"] else operator.retry
                again(subject)
                state = operator.settled(subject, until)
            if state is None or state == "waiting":
                self._history.found("never built", f"{subject}: expected its build to come to an end, got {state}")
            operator.fetch(subject)
            operator.values(subject)
            ready += state == "ready"
        return ready

    def _reaches(self, subject: Subject, state: str, words: str) -> None:
        until = time.monotonic() + _PATIENCE
        found = self._operator.settled(subject, until)
        if found != state:
            self._history.found("extra", f"{subject} {words}: expected it to be {state}, got {found}")

    def _end(self, how: str) -> None:
        if how == "kill":
            self._site.kill()
        else:
            self._site.stop()

    def _calm(self) -> None:
        time.sleep(self._random.uniform(0.05, 1) * self._random.choice((self._longest / 5, self._longest)))

    def _next(self, what: str, choices: Sequence[T]) -> T:
        """One of some choices, each once before any of them comes again."""
        left: list[T] = self._left.setdefault(what, [])
        if not left:
            left += self._random.sample(choices, len(choices))
        return left.pop()


#: What may happen, by name.
KINDS: dict[str, Callable[[Disasters], None]] = {
    "restart": Disasters.restart,
    "kill": Disasters.kill,
    "full": Disasters.full,
    "backup": Disasters.backup,
    "index": Disasters.index,
    "live-index": Disasters.live_index,
    "collect": Disasters.collect,
    "extra": Disasters.extra,
}
