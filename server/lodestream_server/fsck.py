"""Looking through a server's folder: is everything whole that its records promise?

A container is named by its SHA-256, so it is right or it is not; where it is not, its sections' and segments' checksums
say where. An upload is compared with the hash that was taken while it came in. Nothing is changed here; `repair` does.
"""

from __future__ import annotations

import hashlib
import json
import os
import time
import zlib
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal

from lodestream.container import FrameReader, Index, describe, read_index
from lodestream.errors import LodestreamError

from .records import Record, plain
from .storage import Folders
from .uploads import digest_of

__all__ = ["Finding", "Report", "What", "check", "check_container", "check_upload", "read_record"]

What = Literal["record", "upload", "container", "figures", "leftover"]

_CHUNK = 1 << 20


@dataclass(frozen=True)
class Finding:
    """Something that is not as it should be.

    Attributes
    ----------
    what : str
        ``record``, ``upload`` or ``container``: it is damaged or gone. ``figures``: a record says something else of its
        container than the container itself. ``leftover``: a file that nothing refers to, as a process leaves them that
        is killed; the server removes them when it starts, and they are no damage.
    path : Path
    surface : str or None
        Whose it is.
    problem : str
        What was expected and what came.
    repair : str or None
        What was done about it.
    lost : bool
        The surface could not be saved.
    """

    what: What
    path: Path
    surface: str | None
    problem: str
    repair: str | None = None
    lost: bool = False


@dataclass
class Report:
    """What was looked at, and what was found."""

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
        """The findings that are no leftovers."""
        return [finding for finding in self.findings if finding.what != "leftover"]

    @property
    def clean(self) -> bool:
        """Nothing is damaged, or everything that was has been repaired."""
        return all(finding.repair is not None and not finding.lost for finding in self.damage)

    def to_json(self) -> dict[str, Any]:
        """Plain values."""
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
                    "lost": finding.lost,
                }
                for finding in self.findings
            ],
        }


def check(root: Path) -> Report:
    """Look through a folder in which nobody works meanwhile.

    Raises
    ------
    LodestreamError
        When it is no folder of a server.
    """
    at = Folders(root)
    if not at.records.is_dir() or not at.containers.is_dir():
        raise LodestreamError(f"expected the data folder of a server, with records and containers in it, got {root}")
    started = time.monotonic()
    report = Report(root)
    for path in sorted(at.records.glob("*.json")):
        report.surfaces += 1
        try:
            record = read_record(path)
        except ValueError as error:
            report.findings.append(Finding("record", path, path.stem, f"expected a record: {error}"))
        else:
            report.records[record.id] = record
    indexes: dict[str, Index | str] = {}
    for record in report.records.values():
        if record.state == "queued" or (record.state == "ready" and not record.upload_lost):
            report.findings.extend(_upload(at, record, report))
        if record.state == "ready":
            report.findings.extend(_container(at, record, report, indexes))
    report.findings.extend(_leftovers(at, report))
    report.seconds = time.monotonic() - started
    return report


def read_record(path: Path) -> Record:
    """The record in a file.

    Raises
    ------
    ValueError
        When it is none, or that of another surface; in one line.
    """
    record = Record.from_json(json.loads(path.read_bytes()))
    if path.name != "record.json" and record.id != path.stem:
        raise ValueError(f"expected that of {path.stem}, got that of {record.id[:80]!a}")
    return record


def _upload(at: Folders, record: Record, report: Report) -> Iterator[Finding]:
    report.uploads += 1
    report.bytes += record.upload_bytes
    problem = check_upload(at, record)
    if problem is not None:
        yield Finding("upload", at.uploads / record.id, record.id, problem)


def check_upload(at: Folders, record: Record) -> str | None:
    """What is wrong with an upload; None where nothing is."""
    files = at.upload(record)
    try:
        found = sum(path.stat().st_size for path in files)
        if found != record.upload_bytes:
            return f"expected {record.upload_bytes} bytes, got {found}"
        digest = digest_of(files) if record.upload_sha256 else None
    except OSError as error:
        return f"expected {len(files)} files: {error.strerror}"
    if digest != record.upload_sha256:
        return f"expected files with the SHA-256 {record.upload_sha256}, got {digest}"
    return None


def _container(at: Folders, record: Record, report: Report, indexes: dict[str, Index | str]) -> Iterator[Finding]:
    sha256 = record.container or ""
    path = at.container(sha256)
    # Several surfaces may have the same container.
    if sha256 not in indexes:
        report.containers += 1
        indexes[sha256] = check_container(path, sha256)
        if path.is_file():
            report.bytes += path.stat().st_size
    index = indexes[sha256]
    if isinstance(index, str):
        yield Finding("container", path, record.id, index)
    elif plain(describe(index)) != record.info:
        problem = "expected the figures that the container has, got others"
        yield Finding("figures", at.record(record.id), record.id, problem)


def check_container(path: Path, sha256: str) -> Index | str:
    """The index of a container that is whole, or what is wrong with it."""
    frames, digest = FrameReader(), hashlib.sha256()
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
            return place or _index(file.fileno())
    except OSError as error:
        return f"expected a container: {error.strerror}"


def _index(handle: int) -> Index | str:
    try:
        index = read_index(lambda offset, length: os.pread(handle, length, offset), os.fstat(handle).st_size)
    except LodestreamError as error:
        return str(error)
    for segment in index.segments:
        if zlib.crc32(os.pread(handle, segment.range.length, segment.range.offset)) != segment.crc:
            return f"expected segments that match the index, got another one (at byte {segment.range.offset})"
    return index


def _leftovers(at: Folders, report: Report) -> Iterator[Finding]:
    unreadable = {finding.surface for finding in report.findings if finding.what == "record"}
    kept = {record.id for record in report.records.values() if record.state != "failed"} | unreadable
    containers = {at.container(record.container).name for record in report.records.values()}
    known: dict[Path, set[str | None]] = {
        at.uploads: {*kept},
        at.containers: {*containers},
        at.incoming: set(),
        at.work: set(),
    }
    for folder, names in known.items():
        for path in sorted(folder.iterdir()) if folder.is_dir() else ():
            if path.name not in names:
                yield Finding("leftover", path, None, "expected what a record refers to, got something else")
    for path in sorted(at.records.iterdir()):
        if path.suffix != ".json":
            yield Finding("leftover", path, None, "expected a record, got a file that was being written")
