"""Marker files: do these folders belong together, and are all of them there?

A folder that is not mounted looks like an empty one. So each of the three folders holds a file ``identity`` with the
same random number. A server does not start if one is missing or different, because data that seem lost may only be
elsewhere.
"""

from __future__ import annotations

import re
import secrets
from pathlib import Path

from lodestream.errors import LodestreamError

from .durable import remove, sync_folder, write_file
from .folders import Folders
from .records import read_record

__all__ = ["MARKER", "adopt", "establish", "fault", "identity"]

#: Name of the marker in each folder.
MARKER = "identity"

# Beside the folders while they are being marked for the first time, so that a start that was cut short is finished.
_MARKING = "marking"

_IDENTITY = re.compile(rb"[0-9a-f]{32}\n")


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
    marking = _read(at.root / _MARKING)
    problem = fault(at)
    if problem is not None:
        raise LodestreamError(
            f"{problem}. Is a disk not mounted? Nothing was changed. If the folders were moved here on purpose, run "
            f"`lodestream fsck --adopt {at.root}`"
        )
    found = identity(at.records)
    if marking is None and found is not None and all(identity(folder) for folder in at.kept):
        return found
    chosen = marking or secrets.token_hex(16)
    _mark(at, chosen)
    return chosen


def identity(folder: Path) -> str | None:
    """The number in the marker of a folder; None if there is no marker.

    Raises
    ------
    LodestreamError
        If the file is not a marker.
    OSError
        If it cannot be read.
    """
    return _read(folder / MARKER)


def fault(at: Folders) -> str | None:
    """The reason why a server would not start in a folder; None if it would."""
    marking = _read(at.root / _MARKING)
    found = {folder: identity(folder) for folder in at.kept}
    known = {mark for mark in (*found.values(), marking) if mark is not None}
    if len(known) > 1:
        told = ", ".join(f"{folder.name}/ {mark or 'none'}" for folder, mark in found.items())
        return f"expected the same marker in each folder of {at.root}, got {told}"
    if known and marking is None:
        without = [f"{folder.name}/" for folder, mark in found.items() if mark is None]
        if without:
            return f"expected the marker of this data folder in {' and '.join(without)} of {at.root}, got none"
        return None
    return _fault_of_unmarked(at)


def adopt(at: Folders) -> None:
    """Mark the folders as belonging together, whatever their markers say; missing folders are created.

    Raises
    ------
    OSError
        If the folders cannot be read or written.
    """
    for folder in at.kept:
        remove(folder / MARKER)
    remove(at.root / _MARKING)
    _mark(at, secrets.token_hex(16))


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
    """How many records speak of an upload, and of a container."""
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


def _mark(at: Folders, mark: str) -> None:
    data = f"{mark}\n".encode()
    write_file(at.root / _MARKING, data)
    for folder in at.kept:
        folder.mkdir(exist_ok=True)
        write_file(folder / MARKER, data)
    remove(at.root / _MARKING)
    sync_folder(at.root)


def _read(path: Path) -> str | None:
    try:
        data = path.read_bytes()
    except (FileNotFoundError, NotADirectoryError):
        return None
    if not _IDENTITY.fullmatch(data):
        raise LodestreamError(f"expected 32 hexadecimal digits and the end of the line in {path}, got {data[:40]!a}")
    return data.decode().strip()
