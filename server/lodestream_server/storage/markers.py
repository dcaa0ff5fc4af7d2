"""Marker files: do these folders belong together, and are all of them there?

A folder that is not mounted looks like an empty one. So each of the three folders holds a file ``identity`` with the
same random number. A server does not start if one is missing or different, because data that seem lost may only be
elsewhere.
"""

from __future__ import annotations

import hashlib
import re
import secrets
from dataclasses import dataclass
from pathlib import Path

from lodestream.errors import LodestreamError

from ..store.durable import remove, sync_folder, write_file
from .folders import Folders
from .records import read_record

__all__ = ["MARKER", "adopt", "establish", "fault", "identity"]

#: Name of the marker in each folder.
MARKER = "identity"

# Beside the folders while they are being marked, so that a marking that was cut short is finished by the next start.
_MARKING = "marking"

_IDENTITY = re.compile(rb"[0-9a-f]{32}\n")
_NOTE = re.compile(rb"([0-9a-f]{32})\n((?:[a-z]+ (?:none|[0-9a-f]{64})\n)*)")


@dataclass(frozen=True)
class _Marking:
    """What the note beside the folders says.

    Attributes
    ----------
    number : str
        What every marker will hold.
    found : dict of str or None
        Of folders that are adopted: by name, the SHA-256 of the marker that was there, None where there was none.
        Empty in a folder that is marked for the first time.
    """

    number: str
    found: dict[str, str | None]

    def to_bytes(self) -> bytes:
        lines = (f"{name} {before or 'none'}\n" for name, before in self.found.items())
        return f"{self.number}\n{''.join(lines)}".encode()


def establish(at: Folders) -> str:
    """Check the markers; create them in a new folder or in one of an earlier version.

    Returns
    -------
    str
        The number in the markers.

    Raises
    ------
    LodestreamError
        If a marker is missing or different, or if a folder without markers lacks what its records refer to.
    OSError
        If the folders cannot be read or written.
    """
    marking = _marking(at)
    problem = fault(at)
    if problem is not None:
        raise LodestreamError(
            f"{problem}. Is a disk not mounted? Nothing was changed. If the folders were moved here on purpose, run "
            f"`lodestream fsck --adopt {at.root}`"
        )
    if marking is None:
        number = identity(at.records)
        if number is not None and all(identity(folder) for folder in at.kept):
            return number
        marking = _Marking(secrets.token_hex(16), {})
    _mark(at, marking)
    return marking.number


def identity(folder: Path) -> str | None:
    """Return the number in the marker of a folder; None if there is no marker.

    Raises
    ------
    LodestreamError
        If the file is not a marker.
    OSError
        If it cannot be read.
    """
    path = folder / MARKER
    data = _contents(path)
    if data is not None and not _IDENTITY.fullmatch(data):
        raise LodestreamError(f"expected 32 hexadecimal digits and the end of the line in {path}, got {data[:40]!a}")
    return None if data is None else data.decode().strip()


def fault(at: Folders) -> str | None:
    """Return the reason why a server would not start in a folder; None if it would."""
    marking = _marking(at)
    if marking is not None and marking.found:
        return _fault_of_adopted(at, marking)
    marks = {folder: identity(folder) for folder in at.kept}
    known = {mark for mark in (*marks.values(), marking and marking.number) if mark is not None}
    if len(known) > 1:
        listing = ", ".join(f"{folder.name}/ {mark or 'none'}" for folder, mark in marks.items())
        return f"expected the same marker in each folder of {at.root}, got {listing}"
    if known and marking is None:
        without = [f"{folder.name}/" for folder, mark in marks.items() if mark is None]
        if without:
            return f"expected the marker of this data folder in {' and '.join(without)} of {at.root}, got none"
        return None
    return _fault_of_unmarked(at)


def adopt(at: Folders) -> None:
    """Mark the folders as belonging together, whatever their markers say; missing folders are created.

    If this ends between two markers, the next start finishes it.

    Raises
    ------
    OSError
        If the folders cannot be read or written.
    """
    for folder in at.kept:
        folder.mkdir(exist_ok=True)
    _mark(at, _Marking(secrets.token_hex(16), {folder.name: _hash(folder) for folder in at.kept}))


def _fault_of_adopted(at: Folders, marking: _Marking) -> str | None:
    # Whoever asked for it spoke of the folders that were there: not of what is mounted in their places since.
    for folder in at.kept:
        before = marking.found.get(folder.name)
        if not folder.is_dir() or (_hash(folder) != before and identity(folder) != marking.number):
            return (
                f"expected the {folder.name}/ of {at.root} that were being adopted when that was cut short, got others"
            )
    return None


def _fault_of_unmarked(at: Folders) -> str | None:
    # Of a version before markers, restored from its backup, or new.
    has_uploads, has_containers = any(at.all_uploads()), any(at.all_containers())
    if not any(at.all_records()):
        if any(at.tombstones()) or not (has_uploads or has_containers):
            return None
        there = " and ".join(name for name, has in (("uploads/", has_uploads), ("containers/", has_containers)) if has)
        return (
            f"expected records in records/ of {at.root}, which has no marker yet, got none although there are {there}"
        )
    needed = _needed(at)
    for folder, has in ((at.uploads, has_uploads), (at.containers, has_containers)):
        if folder in needed and not has:
            return (
                f"expected in {folder.name}/ of {at.root}, which has no marker yet, the files that {needed[folder]} of "
                "its records refer to, got none"
            )
    return None


def _needed(at: Folders) -> dict[Path, int]:
    """Return how many records refer to an upload, and to a container, by folder."""
    needed = dict.fromkeys((at.uploads, at.containers), 0)
    for path in at.all_records():
        try:
            record = read_record(path)
        except ValueError:
            continue
        # An earlier version dropped the upload of what had failed.
        needed[at.uploads] += record.state != "failed" and not record.upload_lost
        needed[at.containers] += record.state == "ready"
    return {folder: count for folder, count in needed.items() if count}


def _mark(at: Folders, marking: _Marking) -> None:
    write_file(at.root / _MARKING, marking.to_bytes())
    for folder in at.kept:
        folder.mkdir(exist_ok=True)
        write_file(folder / MARKER, f"{marking.number}\n".encode())
    remove(at.root / _MARKING)
    sync_folder(at.root)


def _marking(at: Folders) -> _Marking | None:
    path = at.root / _MARKING
    data = _contents(path)
    if data is None:
        return None
    parts = _NOTE.fullmatch(data)
    if parts is None:
        raise LodestreamError(f"expected the number of a marker, and of those before, in {path}, got {data[:40]!a}")
    lines = (line.split() for line in parts[2].decode().splitlines())
    return _Marking(parts[1].decode(), {name: None if before == "none" else before for name, before in lines})


def _hash(folder: Path) -> str | None:
    data = _contents(folder / MARKER)
    return None if data is None else hashlib.sha256(data).hexdigest()


def _contents(path: Path) -> bytes | None:
    try:
        return path.read_bytes()
    except (FileNotFoundError, NotADirectoryError):
        return None
