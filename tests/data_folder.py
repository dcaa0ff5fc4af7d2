"""What lies where in the data folder of a server, for tests that look at one from outside.

Of tests beside those of the server itself only these lines know it (docs/operating.md, docs/formats.md).
"""

from __future__ import annotations

import contextlib
import hashlib
import json
import os
import random
import shutil
import time
from collections import Counter
from collections.abc import Iterator
from pathlib import Path
from typing import Any

__all__ = [
    "PLACES",
    "age",
    "below",
    "built",
    "bytes_of_surfaces",
    "container",
    "contents",
    "copy_index",
    "copy_rest",
    "copy_small",
    "damage_index",
    "leave_unfinished",
    "manifest",
    "move_index",
    "remove_index",
    "remove_scratch",
    "strays",
    "upload_file",
    "warm",
]

#: Files and folders of it, as `tests.faults` tells apart where a call fails.
PLACES = (
    "lock",
    "tokens.json",
    "lodestream.json",
    "names",
    "surfaces",
    "built",
    "containers",
    "uploads",
    ".lodestream",
    "scratch",
    "scratch/index.sqlite",
    "scratch/incoming",
    "scratch/partial",
    "scratch/work",
    "scratch/levels",
)

#: What refers to something else; each before what it refers to, so that a copy in this order has all of it.
_SMALL = ("names", "surfaces", "built")
_BYTES = ("uploads", "containers")

_INDEX = Path("scratch") / "index.sqlite"
_PAGE = 4096


def manifest(data: Path, surface: str) -> Path:
    """The small file that says that there is a surface."""
    return data / "surfaces" / f"{surface}.json"


def built(data: Path, surface: str) -> Path:
    """The small file that says what became of its build."""
    return data / "built" / f"{surface}.json"


def upload_file(data: Path, surface: str) -> Path:
    """The first file of a surface's upload."""
    return data / "uploads" / str(_read(manifest(data, surface))["upload"]) / "0"


def container(data: Path, sha256: str | None) -> Path:
    """The file of a container."""
    return data / "containers" / f"{sha256}.lode"


def _read(small: Path) -> dict[str, Any]:
    # The first line, or all of it: a checksum comes after.
    found: dict[str, Any] = json.JSONDecoder().raw_decode(small.read_text())[0]
    return found


def below(folder: Path) -> Iterator[Path]:
    """Everything below a folder; what vanishes meanwhile is passed over, where `Path.rglob` of Python 3.11 raises."""
    for above, folders, files in os.walk(folder):
        yield from (Path(above, name) for name in (*folders, *files))


def bytes_of_surfaces(data: Path) -> Counter[str]:
    """The hashes of all files of uploads and containers, and how many files have each."""
    return contents(data / "uploads") + contents(data / "containers")


def contents(folder: Path) -> Counter[str]:
    """The hashes of all files beneath a folder, and how many files have each."""
    return Counter(hashlib.sha256(path.read_bytes()).hexdigest() for path in below(folder) if path.is_file())


def leave_unfinished(data: Path, surface: str) -> None:
    """Put there what a server that is killed during an upload, a build and a change leaves behind."""
    ends = "0123456789abcdef"
    for name in ("incoming", "work"):
        left = data / "scratch" / name / f"{surface}.{ends}"
        left.mkdir(parents=True)
        (left / "0").write_bytes(b"half of an upload")
    (data / ".lodestream" / f"{ends}.new").write_bytes(b'{"id": ')
    for name, stray in (("uploads", f"{ends * 4}/0"), ("containers", f"{ends * 4}.lode")):
        path = data / name / stray
        path.parent.mkdir(exist_ok=True)
        path.write_bytes(b"what nothing refers to")


def strays(data: Path) -> list[str]:
    """The files of uploads and containers that no small file refers to."""
    uploads = {str(_read(path)["upload"]) for path in _listed(data / "surfaces")}
    containers = {str(_read(path)["container"]) for path in _listed(data / "built")}
    return [
        *(f"uploads/{path.name}" for path in _listed(data / "uploads") if path.name not in uploads),
        *(f"containers/{path.name}" for path in _listed(data / "containers") if path.stem not in containers),
    ]


def age(data: Path, seconds: float) -> None:
    """Let everything that is there be older."""
    then = time.time() - seconds
    for path in below(data):
        os.utime(path, (then, then))


# A backup.


def copy_small(source: Path, target: Path) -> None:
    """Begin a backup under load as docs/operating.md says: small files come before what they refer to."""
    for name in _SMALL:
        _copy(source / name, target / name)


def copy_rest(source: Path, target: Path) -> None:
    """End that backup."""
    for path in _listed(source):
        if path.is_dir() and path.name in _BYTES:
            _copy(path, target / path.name)
    for name in ("lodestream.json", "tokens.json"):
        with contextlib.suppress(FileNotFoundError):
            shutil.copy2(source / name, target / name)


def copy_index(source: Path, target: Path) -> None:
    """Copy the index too."""
    (target / _INDEX.parent).mkdir(exist_ok=True)
    for path in _index(source):
        with contextlib.suppress(FileNotFoundError):
            shutil.copy2(path, target / _INDEX.parent / path.name)


def move_index(source: Path, target: Path) -> None:
    """Move the index of a folder to another one, in place of what is there; no server is running."""
    remove_index(target)
    (target / _INDEX.parent).mkdir(parents=True, exist_ok=True)
    for path in _index(source):
        path.rename(target / _INDEX.parent / path.name)


def _copy(source: Path, target: Path) -> None:
    # As rsync does: what is gone when its turn comes is left out.
    target.mkdir(parents=True, exist_ok=True)
    for path in _listed(source):
        with contextlib.suppress(FileNotFoundError):
            if path.is_dir():
                _copy(path, target / path.name)
            else:
                shutil.copy2(path, target / path.name)


def _listed(folder: Path) -> Iterator[Path]:
    with contextlib.suppress(FileNotFoundError):
        yield from sorted(folder.iterdir())


# The index, and the folder in which it lies.


def _index(data: Path) -> list[Path]:
    """Its file, and those that the database keeps beside it."""
    return sorted((data / _INDEX.parent).glob(f"{_INDEX.name}*"))


def remove_index(data: Path) -> None:
    """Take the index away."""
    for path in _index(data):
        path.unlink(missing_ok=True)


def remove_scratch(data: Path) -> None:
    """Take the folder away in which the index lies, at one moment."""
    gone = data.with_name(f"{data.name}.scratch")
    with contextlib.suppress(FileNotFoundError):
        (data / _INDEX.parent).rename(gone)
        shutil.rmtree(gone)


def damage_index(data: Path, how: str, random_: random.Random) -> None:
    """Damage the index.

    Parameters
    ----------
    data : Path
    how : "cut", "head" or "pages"
        Nothing is left of it; its first page is; any of its pages, and of its log, are other bytes. If it is being made
        again at this moment, it may not be there.
    random_ : Random
    """
    if how == "cut":
        with contextlib.suppress(FileNotFoundError):
            os.truncate(data / _INDEX, 0)
        return
    chosen = [data / _INDEX] if how == "head" else [path for path in _index(data) if not path.name.endswith("-shm")]
    for path in chosen:
        with contextlib.suppress(FileNotFoundError), path.open("r+b") as file:
            pages = -(-path.stat().st_size // _PAGE)
            for page in range(pages):
                if random_.random() < 0.5 if how == "pages" else page == 0:
                    file.seek(page * _PAGE)
                    file.write(random_.randbytes(_PAGE))


def warm() -> None:
    """Make what each process makes first that opens a folder, and that takes as long as looking through a small one."""
    from lodestream_server.store import layout

    layout._adapters()
