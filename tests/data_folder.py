"""What lies where in the data folder of a server, for tests that look at one from outside.

Of tests beside those of the server itself only these lines know it (docs/operating.md, docs/formats.md).
"""

from __future__ import annotations

import contextlib
import hashlib
import json
import shutil
import subprocess
import sys
from collections import Counter
from collections.abc import Callable, Collection, Iterator
from pathlib import Path
from typing import Any

__all__ = [
    "APART",
    "KEPT",
    "PLACES",
    "bytes_of_surfaces",
    "container",
    "contents",
    "copy_rest",
    "copy_small",
    "damage_after_kill",
    "leave_unfinished",
    "manifest",
    "upload_file",
    "warm",
    "when_fsck_builds",
]

#: Files and folders of it, as `tests.faults` tells apart where a call fails.
PLACES = ("lock", "tokens.json", "records", "uploads", "containers", "incoming", "work", "levels", "damaged")

#: A folder that may be on another file system than the rest.
APART = "damaged"

#: The folders in which everything acknowledged lies, without which no server starts.
KEPT = ("records", "uploads", "containers")

_SMALL = ("records",)
_NOT_COPIED = ("incoming", "work", "levels", "lock")

#: Of the files that a repair must not lose, these are none: a marker says only where its folder belongs.
_NO_BYTES = ("records", "lock", "identity")


def manifest(data: Path, surface: str) -> Path:
    """The small file that says that there is a surface."""
    return data / "records" / f"{surface}.json"


def upload_file(data: Path, surface: str) -> Path:
    """The first file of a surface's upload."""
    return data / "uploads" / str(json.loads(manifest(data, surface).read_bytes())["upload"]) / "0"


def container(data: Path, sha256: str | None) -> Path:
    """The file of a container."""
    return data / "containers" / f"{sha256}.lode"


def bytes_of_surfaces(data: Path) -> Counter[str]:
    """The hashes of all files of uploads and containers, wherever they lie by now, and how many files have each."""
    return contents(data, without=_NO_BYTES)


def contents(folder: Path, *, without: tuple[str, ...] = ()) -> Counter[str]:
    """The hashes of all files beneath a folder, and how many files have each; without some names."""
    return Counter(
        hashlib.sha256(path.read_bytes()).hexdigest()
        for path in folder.rglob("*")
        if path.is_file() and not set(without).intersection(path.relative_to(folder).parts)
    )


def leave_unfinished(data: Path, surface: str) -> None:
    """Put there what a server that is killed during an upload, a build and a change leaves behind."""
    ends = "0123456789abcdef"
    for name in ("incoming", "work"):
        left = data / name / f"{surface}.{ends}"
        left.mkdir(parents=True)
        (left / "0").write_bytes(b"half of an upload")
    (data / "records" / f"{surface}.json.{ends}.new").write_bytes(b'{"id": ')


def copy_small(source: Path, target: Path) -> None:
    """Begin a backup under load as docs/operating.md says: what says which surfaces there are comes first."""
    _copy(source, target, lambda name: name in _SMALL)


def copy_rest(source: Path, target: Path) -> None:
    """End that backup."""
    _copy(source, target, lambda name: name not in (*_SMALL, *_NOT_COPIED))


def _copy(source: Path, target: Path, chosen: Callable[[str], bool] = lambda name: True) -> None:
    # As rsync does: what is gone when its turn comes is left out.
    target.mkdir(parents=True, exist_ok=True)
    for path in filter(lambda path: chosen(path.name), _listed(source)):
        with contextlib.suppress(FileNotFoundError):
            if path.is_dir():
                _copy(path, target / path.name)
            else:
                shutil.copy2(path, target / path.name)


def _listed(folder: Path) -> Iterator[Path]:
    with contextlib.suppress(FileNotFoundError):
        yield from sorted(folder.iterdir())


def damage_after_kill(data: Path, stored: Collection[str]) -> list[Any]:
    """What ``lodestream fsck`` finds damaged after a kill, where these surfaces were acknowledged.

    An upload in its place whose record was not written yet was not acknowledged; the next start takes it up, after
    which nothing must be found at all.
    """
    from lodestream_server.storage.storage import Storage

    findings = [
        finding
        for finding in _fsck(data)
        if finding["what"] not in ("leftover", "version")
        and (finding["problem"] != "expected a record, got none" or finding["surface"] in stored)
    ]
    Storage(data).close()
    return [*findings, *_fsck(data)]


def _fsck(data: Path) -> list[dict[str, Any]]:
    command = [sys.executable, "-m", "lodestream_client", "fsck", str(data), "--json"]
    done = subprocess.run(command, stdout=subprocess.PIPE, check=False)
    findings: list[dict[str, Any]] = json.loads(done.stdout)["findings"]
    return findings


def warm() -> None:
    """Make what each process makes first that opens a folder, and that takes as long as looking through a small one."""
    from lodestream_server.storage import records

    records._adapter()


def when_fsck_builds(begin: Callable[[], object]) -> None:
    """Have something done before ``lodestream fsck`` builds in this process."""
    from lodestream_server.maintenance import repair

    names: Any = repair
    rebuild = names.rebuild

    def begin_and_rebuild(*args: Any, **options: Any) -> Any:
        begin()
        return rebuild(*args, **options)

    names.rebuild = begin_and_rebuild
