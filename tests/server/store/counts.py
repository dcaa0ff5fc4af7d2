"""What each operation on surfaces costs, exactly: requests to the store, bytes, SQL statements, synchronisations.

``python -m tests.server.store.counts`` prints the table of `docs/reliability.md`.
"""

from __future__ import annotations

import hashlib
import sqlite3
import tempfile
from collections.abc import Callable, Iterator
from contextlib import closing, contextmanager
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any
from unittest.mock import patch

from lodestream.operating_system import synchronise_file, synchronise_folder
from lodestream.stores import Folder
from lodestream_server.store.layout import Manifest
from lodestream_server.store.surfaces import Surfaces

__all__ = ["Cost", "counted", "table"]

#: Surfaces that there are in all operations; a page has all of them.
SURFACES = 100
#: Bytes of each upload and of each container.
BYTES = 1000

_REQUESTS = ("get", "create", "replace", "put_file", "open", "delete", "entries", "probe")


@dataclass
class Cost:
    """What an operation costs.

    Attributes
    ----------
    requests : list of str
        Names of the methods of the store that were called, in order.
    written, read : int
        Bytes of objects.
    statements : int
        Of SQL, ``BEGIN`` and ``COMMIT`` included.
    synchronised : int
        Files and folders that were put on disk.
    """

    requests: list[str]
    written: int = 0
    read: int = 0
    statements: int = 0
    synchronised: int = 0


class _Counting:
    """A folder that counts what it is asked for."""

    def __init__(self, store: Folder, cost: Cost) -> None:
        self._store, self._cost = store, cost

    def __getattr__(self, name: str) -> Any:
        method = getattr(self._store, name)
        if name not in _REQUESTS:
            return method

        def counted(*given: Any, **named: Any) -> Any:
            self._cost.requests.append(name)
            if name in ("create", "replace"):
                self._cost.written += len(given[1])
            elif name == "put_file":
                self._cost.written += Path(given[1]).stat().st_size
            result = method(*given, **named)
            if name == "get":
                self._cost.read += len(result[0])
            return result

        return counted


@contextmanager
def _watched(cost: Cost) -> Iterator[None]:
    """Count the statements of connections that are made in a block, and what is synchronised."""
    connect = sqlite3.connect

    def traced(*given: Any, **named: Any) -> Any:
        def trace(statement: str) -> None:
            cost.statements += 1

        connection = connect(*given, **named)
        connection.set_trace_callback(trace)
        return connection

    def counting(synchronise: Callable[..., None]) -> Callable[..., None]:
        def counted(*given: Any, **named: Any) -> None:
            cost.synchronised += 1
            synchronise(*given, **named)

        return counted

    with (
        patch("sqlite3.connect", traced),
        patch.object(Surfaces, "now", lambda _: 1e9),  # all times are written in as many digits
        patch("lodestream.stores.folder.synchronise_file", counting(synchronise_file)),
        patch("lodestream.stores.folder.synchronise_folder", counting(synchronise_folder)),
    ):
        yield


def _file(place: Path, number: int) -> tuple[Path, str]:
    """Return a file of `BYTES` bytes, and its SHA-256."""
    body = b"%09d\n" % number * (BYTES // 10)
    path = place / f"{number}.new"
    path.write_bytes(body)
    return path, hashlib.sha256(body).hexdigest()


def _accept(surfaces: Surfaces, place: Path, number: int, upload: int | None = None) -> None:
    file, sha256 = _file(place, number if upload is None else upload)
    options = {"precision": "0.01"}
    manifest = Manifest(
        f"{number:020x}", "a name", "ann", 1e9 + number, ("a.npy",), options, sha256, BYTES, f"{number:032x}"
    )
    surfaces.accept(manifest, [file])


def _built(surfaces: Surfaces, place: Path, number: int) -> None:
    info = {"shape": [9, 7], "closed": [False, False], "bytes": BYTES, "levels": [{"rows": 9, "columns": 7}]}
    surfaces.built(f"{number:020x}", *_file(place, 1000 + number), info)


def counted() -> dict[str, Cost]:
    """Return what each operation costs where there are `SURFACES` surfaces."""
    costs: dict[str, Cost] = {}
    cost = Cost([])
    with tempfile.TemporaryDirectory() as name, _watched(cost):
        place = Path(name)
        store = _Counting(Folder(place / "data"), cost)
        with closing(Surfaces(store, place / "index.sqlite")) as surfaces:
            surfaces.sync()
            for number in range(SURFACES):
                _accept(surfaces, place, number)
                _built(surfaces, place, number)
            surfaces.sync()
            id_ = f"{SURFACES:020x}"

            def count(words: str, operation: Callable[[], object]) -> None:
                cost.requests, cost.written, cost.read, cost.statements, cost.synchronised = [], 0, 0, 0, 0
                operation()
                costs[words] = replace(cost)
                cost.requests = []

            count("an upload is accepted", lambda: _accept(surfaces, place, SURFACES))
            count("the same upload again", lambda: _accept(surfaces, place, SURFACES))
            count("a build begins", lambda: surfaces.begin(id_))
            count("it ends with a container", lambda: _built(surfaces, place, SURFACES))
            count("the same bytes with another name", lambda: _accept(surfaces, place, SURFACES + 1, SURFACES))
            count("a reader refuses them", lambda: surfaces.refused(f"{SURFACES + 1:020x}", "no surface"))
            count("somebody retries that", lambda: surfaces.retry(f"{SURFACES + 1:020x}"))
            surfaces.delete(f"{SURFACES + 1:020x}")
            count("a surface is looked up", lambda: surfaces.get(id_))
            count("its description is read", lambda: surfaces.info(surfaces.get(id_)))
            count("a name comes to lead to it", lambda: surfaces.names.point("a", id_, "ann", lambda _: True, 60.0))
            surfaces.names.delete("a", lambda _: True)
            count("it is deleted", lambda: surfaces.delete(id_))
            count(f"a page of {SURFACES} surfaces", lambda: surfaces.index.page((0.0, ""), SURFACES))
            count(f"`sync` of {SURFACES} known surfaces", surfaces.sync)
            count(f"`sync` of {SURFACES} surfaces without an index", surfaces.restore)
    return costs


def table() -> str:
    """Return the costs as a table of a page."""
    rows = [
        "| | requests to the store | bytes written | bytes read | SQL statements | files and folders synchronised |",
        "| --- | --- | ---: | ---: | ---: | ---: |",
    ]
    for words, cost in counted().items():
        several = {name: cost.requests.count(name) for name in cost.requests}
        requests = ", ".join(f"`{name}`" + (f" {many} times" if many > 1 else "") for name, many in several.items())
        rows.append(
            f"| {words} | {requests or 'none'} | {cost.written:,} | {cost.read:,} | {cost.statements} | "
            f"{cost.synchronised} |"
        )
    return "\n".join(rows) + "\n"


if __name__ == "__main__":
    print(table(), end="")
