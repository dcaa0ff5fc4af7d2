"""Files read into a folder, and found there again only as they are."""

from __future__ import annotations

import hashlib
import os
import shutil
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

import lodestream as ls
from lodestream.encoding import reading
from lodestream.encoding.reading import read_into, reading_key

LITTLE = 1 << 20


def _write(path: Path, values: NDArray[Any]) -> None:
    rasterio = pytest.importorskip("rasterio")
    size = {"height": values.shape[0], "width": values.shape[1], "count": 1, "dtype": values.dtype.name}
    with rasterio.open(path, "w", driver="GTiff", transform=rasterio.Affine.scale(2.0), **size) as file:
        file.write(values, 1)


def _values() -> NDArray[np.float32]:
    return np.arange(250_000, dtype=np.float32).reshape(500, 500) % 97


def _read(folder: Path) -> ls.Surface:
    paths = [folder / "a.tif"]
    name = hashlib.sha256(reading_key(paths).encode()).hexdigest()  # as the command line has it
    return read_into(folder / "kept" / name, paths, LITTLE, kept=True)


def test_a_file_is_read_once(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    _write(tmp_path / "a.tif", _values())
    _read(tmp_path)
    monkeypatch.setattr(reading, "read", None)
    assert np.array_equal(_read(tmp_path).points, _values())


def test_a_file_of_the_same_time_and_size_is_another_one(tmp_path: Path) -> None:
    path = tmp_path / "a.tif"
    _write(path, _values())
    state = path.stat()
    _read(tmp_path)
    _write(path, _values() + 1)
    os.utime(path, ns=(state.st_atime_ns, state.st_mtime_ns))
    assert (path.stat().st_size, path.stat().st_mtime_ns) == (state.st_size, state.st_mtime_ns)
    assert np.array_equal(_read(tmp_path).points, _values() + 1)


def test_a_file_that_is_written_to_while_it_is_read_is_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    _write(tmp_path / "a.tif", _values())

    def writing(path: Path, **options: Any) -> ls.Surface:
        surface = ls.read(path, **options)
        os.utime(path)
        return surface

    monkeypatch.setattr(reading, "read", writing)
    with pytest.raises(ls.InputError, match=r"a\.tif to stay as it is until it is read"):
        _read(tmp_path)
    monkeypatch.undo()
    assert np.array_equal(_read(tmp_path).points, _values())


def test_room_on_the_disk_is_looked_at_before_a_file_is_copied(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    _write(tmp_path / "a.tif", _values())
    monkeypatch.setattr(shutil, "disk_usage", lambda folder: SimpleNamespace(free=16 * 250_000 - 1))
    with pytest.raises(ls.TooLargeError, match="of room"):
        _read(tmp_path)
    assert not list(tmp_path.glob("kept/*/*"))
    surface = read_into(tmp_path / "files", [tmp_path / "a.tif"], LITTLE, by_bands=False)
    assert np.array_equal(surface.points, _values())
