"""Room on the disk for a build, looked at before anything is written."""

from __future__ import annotations

import shutil
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

import lodestream as ls

from ..surfaces import terrain


def _values() -> NDArray[np.int16]:
    return np.rint(300 * terrain((510, 200))).astype(np.int16)


class _Plane:
    """A source."""

    def __init__(self, values: NDArray[Any]) -> None:
        self.values, self.shape, self.dtype = values, values.shape, values.dtype

    def read(self, window: tuple[slice, slice]) -> NDArray[Any]:
        return self.values[window]


def _disk(monkeypatch: pytest.MonkeyPatch, free: int) -> None:
    monkeypatch.setattr(shutil, "disk_usage", lambda folder: SimpleNamespace(free=free))


@pytest.mark.parametrize("mapped", [False, True])
def test_room_on_the_disk_is_looked_at_first(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, mapped: bool) -> None:
    values = _values()
    np.save(tmp_path / "a.npy", values)
    surface = np.load(tmp_path / "a.npy", mmap_mode="r") if mapped else values
    needed = values.size * 12 + (0 if mapped else values.nbytes)  # what is in memory is copied too
    _disk(monkeypatch, needed - 1)
    with pytest.raises(ls.TooLargeError, match=f"expected {needed >> 20} MiB of room"):
        ls.encode(surface, out=tmp_path / "a.lode", memory=1 << 20)
    assert [path.name for path in tmp_path.iterdir()] == ["a.npy"]
    _disk(monkeypatch, needed)
    ls.encode(surface, out=tmp_path / "a.lode", memory=1 << 20)


def test_room_on_the_disk_is_looked_at_before_a_source_is_copied(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    source, read = _Plane(_values()), list[object]()
    _disk(monkeypatch, source.values.size * 14 - 1)
    monkeypatch.setattr(source, "read", read.append, raising=False)
    with pytest.raises(ls.TooLargeError, match="of room"):
        ls.encode(source, out=tmp_path / "a.lode", memory=1 << 20)
    assert not read
    assert not list(tmp_path.iterdir())


def test_copies_of_a_source_are_no_room(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    source, frees = _Plane(_values()), [1 << 30, _Plane(_values()).values.size * 12 - 1]
    monkeypatch.setattr(shutil, "disk_usage", lambda folder: SimpleNamespace(free=frees.pop(0)))
    with pytest.raises(ls.TooLargeError, match="of room"):
        ls.encode(source, out=tmp_path / "a.lode", memory=1 << 20)
    assert not frees
