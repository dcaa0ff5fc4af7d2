"""Uploads for tests of the server's data, and a store that fails at a given step."""

from __future__ import annotations

import hashlib
import secrets
from pathlib import Path
from typing import Any

from lodestream.stores import Store
from lodestream_server.store.layout import Manifest, new_write

__all__ = ["CutError", "Failing", "container", "upload"]

_WRITES = ("create", "replace", "put_file", "delete")


class CutError(Exception):
    """The power is gone."""


class Failing:
    """A store that is cut before or after one of its writes.

    Attributes
    ----------
    steps : int
        Twice the writes so far.
    """

    def __init__(self, store: Store, at: int) -> None:
        self._store, self._at, self.steps = store, at, 0

    def __getattr__(self, name: str) -> Any:
        method = getattr(self._store, name)
        if name not in _WRITES:
            return method

        def cut(*given: Any, **named: Any) -> Any:
            self._step()
            result = method(*given, **named)
            self._step()
            return result

        return cut

    def _step(self) -> None:
        if self.steps >= self._at:
            raise CutError
        self.steps += 1


def upload(folder: Path, number: int, owner: str | None = None, **other: Any) -> tuple[Manifest, list[Path]]:
    """Return the manifest and the files of an upload; every third number has the same bytes."""
    body = f"body {number % 3}".encode() * 50
    path = folder / f"upload-{secrets.token_hex(4)}"  # it is the store's, once it is accepted
    path.write_bytes(body)
    sha256 = hashlib.sha256(body).hexdigest()
    given = {
        "id": f"{number:020x}",
        "name": f"surface {number}",
        "owner": owner,
        "created": 1000.0 + number,
        "filenames": ("a.npy",),
        "options": {"precision": "0.1"},
        "upload": sha256,
        "upload_bytes": len(body),
        "write": new_write(),
    }
    return Manifest(**(given | other)), [path]


def container(folder: Path, manifest: Manifest) -> tuple[Path, str, dict[str, Any]]:
    """Return what is built of an upload: the file, its SHA-256 and its description."""
    data = b"container of " + manifest.upload.encode()
    sha256 = hashlib.sha256(data).hexdigest()
    path = folder / f"{sha256}.built"
    path.write_bytes(data)
    return path, sha256, {"bytes": len(data), "shape": [5, 7], "levels": []}
