"""Folders for files that another library writes before they are handed over."""

from __future__ import annotations

import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import BinaryIO

__all__ = ["folder_beside"]


@contextmanager
def folder_beside(file: BinaryIO) -> Iterator[Path]:
    """Make a temporary folder on the disk of an open file: its files may be as large as that one.

    The system's folder for temporary files is often small, or memory. It is taken if the file is not on a disk.
    """
    name = getattr(file, "name", None)
    path = Path(name) if isinstance(name, str) else None
    if path is None or not path.is_absolute() or not path.is_file():
        with tempfile.TemporaryDirectory(prefix="lodestream-") as folder:
            yield Path(folder)
        return
    with tempfile.TemporaryDirectory(prefix=f"{path.name[:50]}.", dir=path.parent) as folder:
        yield Path(folder)
