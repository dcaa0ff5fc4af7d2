"""Checking the data of a server, in whatever store: is everything there, and whole, that its small objects refer to?

Small objects have checksums, uploads and containers are named by their hashes. In a bucket servers may go on working
meanwhile: what is deleted while it is checked is no finding. A repair builds nothing: it removes what
says that a surface is built, so that the next start of a server builds it, and only if its upload is whole. Uploads and
manifests are never touched.
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Collection
from dataclasses import replace

from lodestream.container import read_index
from lodestream.errors import LodestreamError
from lodestream.stores import AbsentError, Store, StoreError

from ..builds.finished import CHECKED, ERRORS, TOLD, figures_of
from ..problems import StandbyError
from ..store import layout
from ..store.changes import ChangeLog
from ..store.identity import establish, read_identity
from ..store.layout import BUILT, IDENTITY, SURFACES, Built, DamagedObjectError, Identity
from ..store.lease import Lease
from .facts import CONTAINER, Facts, Found
from .findings import Finding, Report

__all__ = ["check", "require_data"]


def require_data(store: Store) -> None:
    """Check that a store holds the data of a server, damaged or not.

    Raises
    ------
    LodestreamError
        If it does not.
    StoreError
        If it cannot be read.
    """
    for prefix in (SURFACES, BUILT):
        if next(iter(store.entries(prefix)), None) is not None:
            return
    try:
        layout.read(store, IDENTITY)
    except AbsentError:
        raise LodestreamError(f"expected the data of a server, with {IDENTITY}, got {store.describe()}") from None


def check(
    store: Store,
    *,
    repair: bool = False,
    waiting: Collection[str] = (),
    lease: Lease | None = None,
    progress: Callable[[int, int], None] = lambda done, total: None,
) -> Report:
    """Check the data of a server. Without a repair nothing is changed; with one no server may write meanwhile.

    Parameters
    ----------
    store : Store
    repair : bool
        Whether to remove what keeps a surface with a whole upload from being built again.
    waiting : collection of str
        Surfaces that the next start does not build.
    lease : Lease or None
        Of a bucket: a repair needs it, and other servers are told of it.
    progress : callable
        Called with the bytes that were read of uploads and containers, and the bytes of all of them.

    Raises
    ------
    LodestreamError
        If it holds no data of a server, or those of another version.
    StoreError
        If it cannot be listed. What cannot be read is a finding.
    """
    require_data(store)
    started = time.monotonic()
    report = Report(store.describe())
    judge = _Judge(store, report, repair, waiting, lease)
    judge.identity()
    with Facts(store, report, progress) as facts:
        facts.gather()
        for found in facts.surfaces():
            judge.surface(found)
    if lease is not None and any(found.repaired for found in report.findings):
        changes = ChangeLog(store)
        changes.begin()
        changes.write()
    report.seconds = time.monotonic() - started
    return report


class _Judge:
    """Says what facts mean, and repairs what it may."""

    def __init__(
        self, store: Store, report: Report, repair: bool, waiting: Collection[str], lease: Lease | None
    ) -> None:
        self._store, self._report, self._repair, self._waiting = store, report, repair, waiting
        self._lease = lease

    def identity(self) -> None:
        try:
            read_identity(self._store)
            return
        except AbsentError:
            found = Finding("identity", IDENTITY, None, "expected the identity of the data, got none")
        except DamagedObjectError as error:
            found = Finding("identity", IDENTITY, None, str(error))
        self._found(found, self._identify, "written again")

    def _identify(self) -> None:
        # It only tells an index of other data from the one of these.
        try:
            tag = layout.read(self._store, IDENTITY)[1]
        except AbsentError:
            establish(self._store, known=True)
        else:
            self._store.replace(IDENTITY, layout.dump(Identity(layout.VERSION, layout.new_write())), tag)

    def surface(self, it: Found) -> None:
        whole, lacks = it.upload_state == "whole", it.upload_state in ("bad", "missing")
        again = it.built in ("none", "bad")
        if not whole:
            served = it.built == "ready" and it.container_state == "whole"
            unknown = it.built == "unreadable" or it.container_state == "unreadable"
            problem = it.upload_problem or f"expected {it.files} files, got none"
            lost = lacks and not served and not unknown
            words = "left; its container is whole, and is served" if self._repair and served else None
            self._found(Finding("upload", layout.upload_key(it.upload, 0), it.id, problem, words, lost=lost))
        key = layout.built_key(it.id)
        if it.built in ("bad", "unreadable"):
            lost = lacks and it.built == "bad"
            self._again(Finding("built", key, it.id, it.built_problem or "", lost=lost), it.built, whole)
        elif it.built == "ready" and it.container_state != "whole":
            assert it.container is not None
            place, what = layout.container_key(it.container), it.container_state
            problem, lost = it.container_problem or "expected a container, got none", lacks and what != "unreadable"
            found = Finding("version" if what == "version" else "container", place, it.id, problem, lost=lost)
            again = self._again(found, what, whole)
        elif it.built == "ready" and (it.figures != it.container_figures or it.errors not in _vouchers(it)):
            problem = "expected the description that the container gives, got another"
            self._found(Finding("figures", key, it.id, problem), lambda: self._describe(it), "taken from the container")
        self._report.queued += again and whole and it.id not in self._waiting

    def _again(self, found: Finding, state: str, whole: bool) -> bool:
        """Note a finding because of which a surface must be built again; return whether it will be."""
        assert found.surface is not None
        if state == "unreadable" or not whole:
            self._found(found)
            return False
        keys = [layout.built_key(found.surface)]
        if found.what == "container":
            keys.insert(0, found.key)  # first: where one is that has the right size, a server puts none

        def remove() -> None:
            for key in keys:
                self._store.delete([key], self._still)

        return self._found(found, remove, "removed; the next start of the server builds it again")

    def _describe(self, it: Found) -> None:
        """Write the description of a container again; the old one alone has a thumbnail, and who vouches for errors."""
        assert it.container is not None
        key = layout.built_key(it.id)
        data, tag = layout.read(self._store, key)
        built = layout.parse(Built, key, data)
        errors = it.errors if it.errors in _vouchers(it) else TOLD if it.upload_kind == CONTAINER else None
        with self._store.open(layout.container_key(it.container)) as blob:
            figures, size = figures_of(read_index(blob.read, blob.size), {ERRORS: errors}, ()), blob.size
        info, summary = layout.describe(figures, built.summary.thumbnail)
        new = replace(built, container_bytes=size, info=info, summary=summary, write=layout.new_write())
        self._store.replace(key, layout.dump(new), tag)

    def _found(self, found: Finding, mend: Callable[[], None] | None = None, done: str = "") -> bool:
        """Add a finding, mended if that is asked for and possible; return whether it was."""
        if found.surface is not None and self._is_gone(found.surface):
            return False
        if self._repair and mend is not None:
            try:
                self._still()
                mend()
                found = replace(found, repair=done, repaired=True)
            except StoreError as error:
                found = replace(found, repair=f"not repaired: {error}")
        self._report.findings.append(found)
        return found.repaired

    def _still(self) -> float:
        """Return the seconds for which no server writes; see `Store.delete`."""
        if self._lease is None:
            return math.inf
        if not self._lease.held:
            raise StandbyError("another server may have taken the lease of the bucket")
        return self._lease.left

    def _is_gone(self, surface: str) -> bool:
        """Return whether a surface was deleted since its manifest was read."""
        try:
            self._store.get(layout.manifest_key(surface))
        except AbsentError:
            return True
        except StoreError:
            pass
        return False


def _vouchers(it: Found) -> tuple[str | None, ...]:
    """Return who may vouch for the errors of a surface: somebody must for an uploaded container."""
    return (CHECKED, TOLD) if it.upload_kind == CONTAINER else (CHECKED, TOLD, None)
