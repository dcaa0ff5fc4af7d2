"""Moving files that have no place into ``damaged/``; nothing is deleted."""

from __future__ import annotations

import errno
import hashlib
import os
import secrets
import shutil
from pathlib import Path

from ..store.durable import remove, rename, sync_folder
from .folders import Folders, is_folder

__all__ = ["set_aside"]


def set_aside(at: Folders, path: Path) -> Path:
    """Move a file or folder into ``damaged/``, and return its new path.

    If ``damaged/`` is on another disk, the file is copied, and removed here once the copy is on disk and equal.

    Raises
    ------
    OSError
        If it cannot be moved; it is then unchanged.
    """
    folder = at.damaged / path.parent.relative_to(at.root)
    folder.mkdir(parents=True, exist_ok=True)
    for changed in (folder.parent, at.damaged, at.root):
        sync_folder(changed)
    target = folder / path.name
    if target.exists():
        target = folder / f"{path.name}.{secrets.token_hex(4)}"
    try:
        rename(path, target)
    except OSError as error:
        if error.errno != errno.EXDEV:
            raise
        _copy(path, target)
        remove(path)
    sync_folder(path.parent)
    return target


def _copy(source: Path, target: Path) -> None:
    new = target.with_name(f"{target.name}.{secrets.token_hex(8)}.new")
    try:
        if is_folder(source):
            shutil.copytree(source, new, symlinks=True)
        else:
            shutil.copy2(source, new, follow_symlinks=False)
        for path in (*_files(new), *_folders(new)):
            _sync(path)
        if _digests(source) != _digests(new):
            raise OSError(errno.EIO, f"expected a copy of {source} like the original, got another")
        rename(new, target)
    except OSError:
        remove(new)
        raise


def _files(path: Path) -> list[Path]:
    return sorted(item for item in path.rglob("*") if not item.is_dir()) if path.is_dir() else [path]


def _folders(path: Path) -> list[Path]:
    return [path, *(item for item in path.rglob("*") if item.is_dir())] if path.is_dir() else []


def _sync(path: Path) -> None:
    if path.is_symlink():
        return
    handle = os.open(path, os.O_RDONLY)
    try:
        os.fsync(handle)
    finally:
        os.close(handle)


def _digests(path: Path) -> dict[str, str]:
    digests = {}
    for item in _files(path):
        if item.is_symlink():
            digests[str(item.relative_to(path))] = f"-> {item.readlink()}"
            continue
        with item.open("rb") as file:
            digests[str(item.relative_to(path))] = hashlib.file_digest(file, "sha256").hexdigest()
    return digests
