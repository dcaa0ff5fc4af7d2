"""Checking a data folder: is everything there and undamaged that its records refer to?

A container is named by its SHA-256, which is checked; if it is wrong, the checksums of sections and segments show
where. An upload is compared with the hash that was computed when it arrived. Nothing is changed here; `repair` does
that.
"""

from __future__ import annotations

import hashlib
import os
import time
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, BinaryIO, Literal

from lodestream.container import FrameReader, Index, read_index
from lodestream.container.sections import check_of
from lodestream.errors import LodestreamError

from ..builds.finished import figures_of
from ..storage import markers, work
from ..storage.folders import Folders, is_file, is_folder
from ..storage.records import Record, read_record
from ..storage.recovery import stray_containers
from ..storage.uploads import check_upload
from ..storage.versions import other_version

__all__ = ["Finding", "Report", "What", "check", "check_container"]

What = Literal["marker", "record", "upload", "container", "figures", "version", "leftover"]

_CHUNK = 1 << 20


@dataclass(frozen=True)
class Finding:
    """Something that is wrong.

    Attributes
    ----------
    what : str
        ``record``, ``upload`` or ``container``: damaged or missing. ``figures``: a record's description of its
        container differs from the container. ``marker``: the folders do not belong together, or one is missing.
        ``version``: a sound container of another format version; the next start builds it again, and it does not count
        as damage. ``leftover``: a file that nothing refers to, as killed processes leave them; the next start removes
        it or moves it away, and it does not count as damage.
    path : Path
    surface : str or None
        The surface that it belongs to.
    problem : str
        What was expected and what was found.
    repair : str or None
        What was done about it.
    repaired : bool
        Whether a second check found nothing wrong.
    lost : bool
        Whether the surface can neither be served nor built again from this folder.
    """

    what: What
    path: Path
    surface: str | None
    problem: str
    repair: str | None = None
    repaired: bool = False
    lost: bool = False

    @property
    def key(self) -> tuple[What, Path, str | None]:
        """Identifies the finding in a second check."""
        return self.what, self.path, self.surface


@dataclass
class Report:
    """What was checked, and what was found.

    Attributes
    ----------
    folder : Path
    surfaces : int
        Records, including unusable ones.
    containers, uploads : int
        Containers and uploads that exist and that a record refers to, sound or damaged; shared ones count once.
    bytes : int
        Their size on disk.
    seconds : float
    findings : list of Finding
        Including files that are missing.
    records : dict of Record
        By surface.
    """

    folder: Path
    surfaces: int = 0
    containers: int = 0
    uploads: int = 0
    bytes: int = 0
    seconds: float = 0.0
    findings: list[Finding] = field(default_factory=list)
    records: dict[str, Record] = field(default_factory=dict)

    @property
    def damage(self) -> list[Finding]:
        """The findings that count as damage: all but leftovers and other versions."""
        return [finding for finding in self.findings if finding.what not in ("leftover", "version")]

    @property
    def clean(self) -> bool:
        """Whether nothing is damaged, or all damage has been repaired."""
        return all(finding.repaired for finding in self.damage)

    def to_json(self) -> dict[str, Any]:
        """Return plain values for JSON."""
        return {
            "folder": str(self.folder),
            "clean": self.clean,
            "surfaces": self.surfaces,
            "containers": self.containers,
            "uploads": self.uploads,
            "bytes": self.bytes,
            "seconds": round(self.seconds, 3),
            "findings": [
                {
                    "what": finding.what,
                    "path": str(finding.path.relative_to(self.folder)),
                    "surface": finding.surface,
                    "problem": finding.problem,
                    "repair": finding.repair,
                    "repaired": finding.repaired,
                    "lost": finding.lost,
                }
                for finding in self.findings
            ],
        }


def check(root: Path) -> Report:
    """Check a folder that no server uses meanwhile.

    Raises
    ------
    LodestreamError
        If it is not the data folder of a server.
    OSError
        If something in it cannot be read.
    """
    at = Folders(root)
    if not any(is_folder(folder) for folder in at.kept):
        raise LodestreamError(f"expected the data folder of a server, with records, uploads and containers, got {root}")
    started = time.monotonic()
    report = Report(root)
    problem = markers.fault(at)
    if problem is not None:
        report.findings.append(Finding("marker", root, None, problem))
    for path in at.all_records():
        report.surfaces += 1
        try:
            record = read_record(path)
        except ValueError as error:
            report.findings.append(Finding("record", path, path.stem, f"expected a record: {error}"))
        else:
            report.records[record.id] = record
    uploads: dict[str, str | None] = {}
    indexes: dict[str, Index | str] = {}
    for record in report.records.values():
        report.findings.extend(_upload(at, record, report, uploads))
        if record.state == "ready":
            report.findings.extend(_container(at, record, report, indexes))
    report.findings.extend(_strays(at, report))
    report.seconds = time.monotonic() - started
    return report


def _upload(at: Folders, record: Record, report: Report, known: dict[str, str | None]) -> Iterator[Finding]:
    path = at.upload(record)
    # Of what was damaged nothing is left here; and earlier versions dropped the upload of what had failed.
    dropped = record.upload_lost or (record.state == "failed" and record.upload is None)
    if dropped and not any(is_file(file) for file in at.files(record)):
        return
    # Several surfaces may have the same upload.
    if record.folder not in known:
        there = [file for file in at.files(record) if is_file(file)]
        report.uploads += bool(there)
        report.bytes += sum(file.stat().st_size for file in there)
        known[record.folder] = check_upload(at.files(record), record)
    problem = known[record.folder]
    if problem is not None:
        yield Finding("upload", path, record.id, problem)


def _container(at: Folders, record: Record, report: Report, indexes: dict[str, Index | str]) -> Iterator[Finding]:
    sha256 = record.container or ""
    path = at.container(sha256)
    # Several surfaces may have the same container.
    if sha256 not in indexes:
        indexes[sha256] = check_container(path, sha256)
        if is_file(path):
            report.containers += 1
            report.bytes += path.stat().st_size
    index = indexes[sha256]
    if isinstance(index, str):
        # Where its bytes are not those of its name, that is what the text says.
        yield Finding("version" if index == other_version(path) else "container", path, record.id, index)
    elif figures_of(index, record.info, at.files(record)) != record.info:
        problem = "expected the description that the container gives, got another"
        yield Finding("figures", at.record(record.id), record.id, problem)


def check_container(path: Path, sha256: str) -> Index | str:
    """Return the index of a sound container, or a description of what is wrong with it.

    Raises
    ------
    OSError
        If it exists and cannot be read: the disk has a problem, which may pass.
    """
    frames, digest = FrameReader(keeps=()), hashlib.sha256()
    place = None
    try:
        with path.open("rb") as file:
            while chunk := file.read(_CHUNK):
                digest.update(chunk)
                if place is None:
                    try:
                        for _ in frames.feed(chunk):
                            pass
                    except LodestreamError as error:
                        place = str(error)
            if digest.hexdigest() != sha256:
                where = f"; {place}" if place else ""
                return f"expected bytes with the SHA-256 of the name, got {digest.hexdigest()}{where}"
            return place or _index(file)
    except (FileNotFoundError, NotADirectoryError) as error:
        return f"expected a container: {error.strerror}"


def _index(file: BinaryIO) -> Index | str:
    def read(offset: int, length: int) -> bytes:
        file.seek(offset)
        return file.read(length)  # buffered: as many bytes as there are, however few the system gives at a time

    try:
        index = read_index(read, os.fstat(file.fileno()).st_size)
    except LodestreamError as error:
        return str(error)
    for segment in index.segments:
        if check_of(read(segment.range.offset, segment.range.length)) != segment.check:
            return f"expected segments that match the index, got another one (at byte {segment.range.offset})"
    return index


def _strays(at: Folders, report: Report) -> Iterator[Finding]:
    folders = {record.folder for record in report.records.values()}
    # Who knows what the records that cannot be used speak of?
    unusable = any(finding.what == "record" for finding in report.findings)
    deleted = {path.stem for path in at.tombstones()}
    for upload in at.all_uploads():
        owned = False
        for copy in at.copies(upload):
            try:
                record = read_record(copy)
            except ValueError:
                continue
            if record.folder != upload.name:
                continue
            owned = True
            if record.id not in deleted and not is_file(at.record(record.id)):
                yield Finding("record", at.record(record.id), record.id, "expected a record, got none")
        if not (owned or unusable or upload.name in folders):
            yield Finding(
                "leftover", upload, None, "expected a file that a record refers to, got one that no record refers to"
            )
    for container in () if unusable else stray_containers(at, report.records.values()):
        yield Finding(
            "leftover", container, None, "expected a file that a record refers to, got one that no record refers to"
        )
    for path in at.tombstones():
        yield Finding("leftover", path, path.stem, "expected no surface that is still being deleted, got one")
    for path in at.unfinished():
        yield Finding("leftover", path, None, "expected a record, got a file that was being written")
    queued = {record.id for record in report.records.values() if record.state == "queued"}
    continuing = queued - work.begun(at) if is_folder(at.work) else set[str]()
    for folder in (at.incoming, at.work, at.levels):
        for path in sorted(folder.iterdir()) if is_folder(folder) else ():
            if folder == at.work and path.name in continuing:
                continue
            yield Finding("leftover", path, None, "expected no unfinished uploads, builds or levels, got one")
