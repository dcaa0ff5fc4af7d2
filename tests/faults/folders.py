"""Folders as servers leave them: with surfaces in every state, with leftovers, with damage."""

from __future__ import annotations

import copy
import shutil
from collections.abc import Callable
from contextlib import ExitStack
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

from numpy.typing import NDArray

from tests import data_folder
from tests.server.helpers import hills, npy

from .oracle import Ledger, Talk
from .programs import Programs, Server
from .shim import Fault

__all__ = ["DAMAGES", "HARMLESS", "Folder", "Made"]

_ALWAYS = 1 << 31
_LONG = 2 * 86400.0


@dataclass
class Folder:
    """A folder at rest, and what its server has acknowledged.

    Attributes
    ----------
    data : Path
    ledger : Ledger
    token : str
        Of the scope admin.
    """

    data: Path
    ledger: Ledger
    token: str

    def copy(self, target: Path) -> Folder:
        """The same again in another place."""
        shutil.copytree(self.data, target, symlinks=True)
        return Folder(target, copy.deepcopy(self.ledger), self.token)


class Made:
    """Folders to be copied, each made when it is first asked for.

    Parameters
    ----------
    programs : Programs
    folder : Path
        Where they are made; there is none yet.
    """

    def __init__(self, programs: Programs, folder: Path) -> None:
        folder.mkdir()
        self._programs = programs
        self._folder = folder

    @cached_property
    def plain(self) -> Folder:
        """Three surfaces that are ready."""
        return _plain(self._programs, self._folder / "plain")

    @cached_property
    def mixed(self) -> Folder:
        """Surfaces ready and queued, one that failed, two with one container, one without its container; leftovers."""
        return _mixed(self._programs, self.plain.copy(self._folder / "mixed"))


def _plain(programs: Programs, data: Path) -> Folder:
    programs.shim.beneath(data)
    made = programs.run("token", "create", "admin", "--scope", "admin", "--data", str(data))
    assert made.code == 0, made.text()
    folder = Folder(data, Ledger(), made.text().splitlines()[-1])
    with ExitStack() as held:
        talk = _serve(programs, folder, held)
        for seed in (1, 2, 3):
            surface = _push(talk, hills(12, 11, seed=seed))
            entry = talk.ready(surface)
            assert entry is not None, talk.problems
            folder.ledger.kept[surface].container = entry["container_sha256"]
    return folder


def _mixed(programs: Programs, folder: Folder) -> Folder:
    programs.shim.beneath(folder.data)
    with ExitStack() as held:
        talk = _serve(programs, folder, held)
        for surface in (_push(talk, hills(12, 11, seed=1), closed="none"), _push(talk, None)):
            talk.quiet(surface)
    with ExitStack() as held:
        # A build that finds the disk full waits in the queue for as long as this server lives.
        held.enter_context(programs.shim.failing(Fault("mkdir", "scratch/work/ID", 0, "ENOSPC", times=_ALWAYS)))
        talk = _serve(programs, folder, held)
        for seed in (5, 6):
            queued = _push(talk, hills(12, 11, seed=seed))
    _container(folder, 1).unlink()
    folder.ledger.kept[_surface(folder, 1)].bare = True
    data_folder.leave_unfinished(folder.data, queued)
    return folder


def _serve(programs: Programs, folder: Folder, held: ExitStack) -> Talk:
    server = Server(programs, folder.data)
    held.callback(server.program.stop)
    return Talk(held.enter_context(server.client(folder.token)), folder.ledger, [])


def _push(talk: Talk, points: NDArray[Any] | None, **query: str) -> str:
    body = npy(hills(12, 11, seed=9))[:-1] if points is None else npy(points)
    answer = talk.ask("POST", "/v1/surfaces", (202,), content=body, params=query)
    assert answer is not None, talk.problems
    talk.ledger.stored(str(answer.json()["id"]), points, "before the fault")
    return str(answer.json()["id"])


def _surface(folder: Folder, number: int) -> str:
    return list(folder.ledger.kept)[number]


def _container(folder: Folder, number: int) -> Path:
    return data_folder.container(folder.data, folder.ledger.kept[_surface(folder, number)].container)


def _upload(folder: Folder) -> Path:
    return data_folder.upload_file(folder.data, _surface(folder, 0))


def _flip(path: Path) -> None:
    data = bytearray(path.read_bytes())
    data[len(data) // 2] ^= 1
    path.write_bytes(data)


def _lose(folder: Folder) -> None:
    # What was uploaded is nobody's then, and must stay: somebody may bring the manifest back.
    surface = _surface(folder, 0)
    _flip(data_folder.manifest(folder.data, surface))
    del folder.ledger.kept[surface]


def _leave_strays(folder: Folder) -> None:
    data_folder.leave_unfinished(folder.data, _surface(folder, 0))
    data_folder.age(folder.data, _LONG)


#: What befalls a copy of the plain folder: after each of these a repair brings everything back, but a manifest.
DAMAGES: dict[str, Callable[[Folder], None]] = {
    "whole": lambda folder: None,
    "strays": _leave_strays,
    "flipped container": lambda folder: _flip(_container(folder, 0)),
    "missing container": lambda folder: _container(folder, 0).unlink(),
    "flipped upload": lambda folder: _flip(_upload(folder)),
    "missing upload": lambda folder: _upload(folder).unlink(),
    "flipped built": lambda folder: _flip(data_folder.built(folder.data, _surface(folder, 0))),
    "missing built": lambda folder: data_folder.built(folder.data, _surface(folder, 0)).unlink(),
    "flipped manifest": _lose,
}

#: Those of them that are no damage: what was not built yet is no more than that.
HARMLESS = ("whole", "strays", "missing built")
