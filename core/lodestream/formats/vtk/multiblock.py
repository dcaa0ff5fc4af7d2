"""Write VTM: a file that names one .vts for each block, in a folder beside it; or one archive without a folder.

Source: "VTK XML Formats" of the VTK documentation; names as ParaView gives them.
"""

from __future__ import annotations

import re
import secrets
import shutil
from collections.abc import Sequence
from pathlib import Path
from typing import BinaryIO

from ...errors import FormatError
from ...surface import Surface
from ..archives import new_archive, new_member
from . import writer

__all__ = ["MEDIA_TYPE", "SUFFIXES", "sniff", "write", "write_beside"]

SUFFIXES = (".vtm",)
MEDIA_TYPE = "application/zip"

#: What an archive calls the surface.
_NAME = "surface"


def sniff(head: bytes, suffix: str) -> bool:
    """Return False: the blocks are read as .vts files of one surface, and files that a .vtm names are not opened."""
    return False


def write(surface: Surface, file: BinaryIO) -> None:
    """Write a ZIP archive of ``surface.vtm`` and of the folder ``surface`` with the blocks."""
    with new_archive(file) as archive:
        with new_member(archive, f"{_NAME}.vtm") as member:
            member.write(_index(_NAME, _names(_NAME, len(surface.blocks))))
        for number, name in enumerate(_names(_NAME, len(surface.blocks))):
            with new_member(archive, f"{_NAME}/{name}") as member:
                writer.write_block(surface, number, member)


def write_beside(surface: Surface, path: Path) -> None:
    """Write NAME.vtm, and the folder NAME beside it with NAME_0.vts and so on, of eleven blocks NAME_00.vts.

    Both are written under temporary names and put in place by renaming, the folder first. A folder of that name is
    replaced if NAME.vtm is there and nothing but its blocks is in the folder, or if it is empty.

    Raises
    ------
    FormatError
        If there is a file of the folder's name, or a folder with other files, or with files and without NAME.vtm.
    OSError
        If the disk does not take it; what was there before is there again then.
    """
    folder = path.with_suffix("")
    _check_folder(folder, path)
    token = secrets.token_hex(4)
    new, old = (path.with_name(f".{folder.name}.{token}.{word}") for word in ("tmp", "old"))
    index = path.with_name(f".{path.name}.{token}.tmp")
    try:
        new.mkdir()
        names = _names(folder.name, len(surface.blocks))
        for number, name in enumerate(names):
            with (new / name).open("xb") as file:
                writer.write_block(surface, number, file)
        index.write_bytes(_index(folder.name, names))
        try:
            if folder.exists():
                folder.rename(old)
            new.rename(folder)
            index.replace(path)
        finally:  # what is where says how far it came, after an interruption too
            unplaced = index.exists()
            if unplaced and not new.exists():
                shutil.rmtree(folder, ignore_errors=True)
            if unplaced and old.exists():
                old.rename(folder)
        shutil.rmtree(old, ignore_errors=True)
    finally:
        index.unlink(missing_ok=True)
        shutil.rmtree(new, ignore_errors=True)


def _check_folder(folder: Path, path: Path) -> None:
    """Refuse to replace files that this module has not written."""
    if not folder.exists() and not folder.is_symlink():
        return
    ours = re.compile(re.escape(folder.name) + r"_\d+\.vts")
    if folder.is_symlink() or not folder.is_dir():
        raise FormatError(f"expected a place for the folder {folder.name!r} of the blocks, got a file of that name")
    entries = list(folder.iterdir())
    other = sorted(entry.name for entry in entries if not ours.fullmatch(entry.name) or not entry.is_file())
    if other:
        raise FormatError(
            f"expected the folder {folder.name!r} with nothing but blocks of an earlier .vtm, got {other[0]!r} in it"
        )
    if entries and not path.is_file():
        raise FormatError(
            f"expected no folder {folder.name!r} with files beside {path.name}, which is not there, got one: "
            "move it, or choose another name"
        )


def _names(stem: str, count: int) -> list[str]:
    digits = len(str(count - 1))  # so that a shell has them in their order
    return [f"{stem}_{number:0{digits}}.vts" for number in range(count)]


def _index(folder: str, names: Sequence[str]) -> bytes:
    from xml.sax.saxutils import quoteattr

    lines = [
        '<?xml version="1.0"?>',
        '<VTKFile type="vtkMultiBlockDataSet" version="1.0" byte_order="LittleEndian" header_type="UInt64">',
        "<vtkMultiBlockDataSet>",
        *(
            f'<DataSet index="{number}" name="block {number}" file={quoteattr(f"{folder}/{name}")}/>'
            for number, name in enumerate(names)
        ),
        "</vtkMultiBlockDataSet>",
        "</VTKFile>",
    ]
    return "\n".join(lines).encode() + b"\n"
