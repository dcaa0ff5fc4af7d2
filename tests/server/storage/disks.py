"""Disks that are full, and disks that lose what was never synchronised: for `store.durable.disk`."""

from __future__ import annotations

import errno
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import BinaryIO, TypeVar

from lodestream_server.store.durable import Disk

T = TypeVar("T")

__all__ = ["CountingDisk", "FullDisk", "LosingDisk", "StickyDisk"]


class CountingDisk(Disk):
    """A disk that is asked before each step that needs room; here it always has some.

    Attributes
    ----------
    steps : list of str
        The steps so far, by name.
    """

    def __init__(self) -> None:
        self.steps: list[str] = []

    def ask(self, step: str) -> None:
        """Raise when there is no room."""
        self.steps.append(step)

    def make_folder(self, path: Path) -> None:
        self.ask("make_folder")
        super().make_folder(path)

    def create(self, path: Path) -> BinaryIO:
        self.ask("create")
        return super().create(path)

    def write(self, file: BinaryIO, data: bytes) -> None:
        try:
            self.ask("write")
        except OSError:
            # A disk fills up in the middle of what is written.
            super().write(file, data[: len(data) // 2])
            raise
        super().write(file, data)

    def sync(self, handle: int, path: Path) -> None:
        self.ask("sync")
        super().sync(handle, path)

    def rename(self, source: Path, target: Path) -> None:
        self.ask("rename")
        super().rename(source, target)


class FullDisk(CountingDisk):
    """A disk that one step finds full, or that one and all after it.

    Parameters
    ----------
    step : int
        Number of the step, from 0.
    lasting : bool
        It stays full.
    """

    def __init__(self, step: int, *, lasting: bool = False) -> None:
        super().__init__()
        self._step = step
        self._lasting = lasting

    def ask(self, step: str) -> None:
        number = len(self.steps)
        super().ask(step)
        if number == self._step or (self._lasting and number > self._step):
            raise OSError(errno.ENOSPC, "No space left on device")


class StickyDisk(Disk):
    """A disk that removes nothing beneath some folders."""

    def __init__(self, *folders: Path) -> None:
        self._folders = folders

    def unlink(self, path: Path) -> None:
        self._ask(path)
        super().unlink(path)

    def remove_folder(self, path: Path) -> None:
        self._ask(path)
        super().remove_folder(path)

    def _ask(self, path: Path) -> None:
        if any(path.is_relative_to(folder) for folder in self._folders):
            raise OSError(errno.EIO, "Input/output error")


class _Node:
    """A file or a folder, as it stands and as it would be found after the power has failed."""

    def __init__(self, folder: bool) -> None:
        self.folder = folder
        self.data = b""
        self.safe_data = b""
        self.names: dict[str, _Node] = {}
        self.safe_names: dict[str, _Node] = {}


class LosingDisk(Disk):
    """A disk that remembers what was synchronised, and can show what remains when the power fails.

    What was not synchronised may be lost or kept, bytes apart from names: `remains` shows each. Every step is done on
    the real disk too.

    Parameters
    ----------
    root : Path
        The folder in question; what is there now is safe.
    after : callable
        Called after each step with this disk.
    """

    def __init__(self, root: Path, after: Callable[[LosingDisk], None]) -> None:
        self._root = root
        self._top = self._scan(root)
        self._after = after
        self._open: dict[int, _Node] = {}

    def remains(self, *, names: bool, data: bool) -> dict[str, bytes | None]:
        """What a power failure would leave: the bytes of each file, None for a folder.

        Names, or bytes, that were not synchronised are kept if so said.
        """
        return dict(self._show(self._top, "", names, data))

    def make_folder(self, path: Path) -> None:
        super().make_folder(path)
        self._folder(path).names[path.name] = _Node(folder=True)
        self._after(self)

    def create(self, path: Path) -> BinaryIO:
        file = super().create(path)
        self._folder(path).names[path.name] = self._open[id(file)] = _Node(folder=False)
        self._after(self)
        return file

    def write(self, file: BinaryIO, data: bytes) -> None:
        super().write(file, data)
        self._open[id(file)].data += data
        self._after(self)

    def sync(self, handle: int, path: Path) -> None:
        super().sync(handle, path)
        if path == self._root or self._root in path.parents:
            node = self._node(path)
            node.safe_data, node.safe_names = node.data, dict(node.names)
        self._after(self)

    def rename(self, source: Path, target: Path) -> None:
        super().rename(source, target)
        self._folder(target).names[target.name] = self._folder(source).names.pop(source.name)
        self._after(self)

    def unlink(self, path: Path) -> None:
        super().unlink(path)
        self._folder(path).names.pop(path.name, None)
        self._after(self)

    def remove_folder(self, path: Path) -> None:
        super().remove_folder(path)
        self._folder(path).names.pop(path.name, None)
        self._after(self)

    def _folder(self, path: Path) -> _Node:
        return self._node(path.parent)

    def _node(self, path: Path) -> _Node:
        node = self._top
        for name in path.relative_to(self._root).parts:
            node = node.names[name]
        return node

    def _scan(self, path: Path) -> _Node:
        node = _Node(path.is_dir())
        if node.folder:
            node.names = {child.name: self._scan(child) for child in path.iterdir()}
            node.safe_names = dict(node.names)
        else:
            node.data = node.safe_data = path.read_bytes()
        return node

    def _show(self, node: _Node, path: str, names: bool, data: bool) -> Iterator[tuple[str, bytes | None]]:
        if not node.folder:
            yield path, node.data if data else node.safe_data
            return
        yield path, None
        for name, child in (node.names if names else node.safe_names).items():
            yield from self._show(child, f"{path}/{name}", names, data)
