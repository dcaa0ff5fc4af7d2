"""Objects whose arrays stay in their files."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from lodestream.encoding.references import dump, load, root_of
from lodestream.errors import UnavailableError
from lodestream.scratch import FolderScratch
from lodestream.surface import Surface


@dataclass
class _Pair:
    first: NDArray[Any]
    second: NDArray[Any]


def test_maps_and_views_of_them_are_references(tmp_path: Path) -> None:
    scratch = FolderScratch(tmp_path / "files")
    whole = np.arange(100_000, dtype=np.float32).reshape(100, 500, 2)
    scratch.write("whole", whole)
    mapped = scratch.read("whole")
    views = [mapped, mapped[..., 1], mapped[3:50:2, ::-1], mapped[..., np.newaxis], mapped[::-1].T, mapped[5, 7, 1:2]]
    own = [np.arange(3), mapped[:0], np.array(mapped[:2, :2])]
    dump(_Pair(np.ones(2), np.zeros(1)), tmp_path / "small")
    dump([*views, *own], tmp_path / "object")
    assert (tmp_path / "object").stat().st_size < 5000
    for array, again in zip([*views, *own], load(tmp_path / "object"), strict=True):
        assert again.dtype == array.dtype
        assert np.array_equal(again, array)
    assert not load(tmp_path / "object")[0].flags.writeable


def test_a_surface_is_a_reference(tmp_path: Path) -> None:
    scratch = FolderScratch(tmp_path)
    scratch.write("heights", np.arange(200_000, dtype=np.int16).reshape(400, 500))
    surface = Surface(scratch.read("heights"), metadata={"name": "hill"})
    dump(surface, tmp_path / "surface")
    assert (tmp_path / "surface").stat().st_size < 5000
    again = load(tmp_path / "surface")
    assert np.array_equal(again.points, surface.points)
    assert again.metadata == {"name": "hill"}


def test_a_file_that_is_gone_is_missed(tmp_path: Path) -> None:
    scratch = FolderScratch(tmp_path)
    scratch.write("heights", np.ones(50_000))
    dump(scratch.read("heights"), tmp_path / "object")
    scratch.remove("heights")
    with pytest.raises(FileNotFoundError):
        load(tmp_path / "object")


def test_another_version_is_refused_before_anything_is_unpickled(tmp_path: Path) -> None:
    path = tmp_path / "a.pickle"
    dump(np.arange(3), path)
    path.write_bytes(b"lodestream 0.0.1\nno pickle")
    with pytest.raises(UnavailableError, match=r"workers of the same versions: lodestream 0\.0\.1 builds"):
        load(path)


@pytest.mark.parametrize("order", ["C", "F"])
def test_a_map_of_another_file_than_the_one_of_its_name_is_none_of_it(tmp_path: Path, order: Any) -> None:
    path, values = tmp_path / "a.npy", np.asarray(np.arange(6000.0).reshape(60, 100), order=order)
    np.save(path, values)
    mapped = np.load(path, mmap_mode="r")
    for view in (mapped, mapped[3:, ::-2], mapped.T, np.asarray(mapped)):
        assert root_of(view) is not None
    for other in (values + 1, values[:50]):
        np.save(tmp_path / "b.npy", other)
        (tmp_path / "b.npy").replace(path)
        assert root_of(mapped) is None
        assert root_of(mapped[3:, ::-2]) is None
    assert root_of(np.load(path, mmap_mode="r")) is not None
