"""Arrays of other libraries, read window by window."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

import lodestream as ls
from lodestream import sources
from lodestream.sources import is_source

from .surfaces import terrain

HEIGHTS = np.rint(300 * terrain((700, 640))).astype(np.int16)


class _Windows:
    """Counts what is read."""

    def __init__(self, values: NDArray[Any]) -> None:
        self.shape, self.dtype, self._values = values.shape, values.dtype, values
        self.largest = self.read_values = 0

    def read(self, window: tuple[slice, slice]) -> NDArray[Any]:
        part = self._values[window]
        self.largest = max(self.largest, part.size)
        self.read_values += part.size
        return part


def test_a_source_is_read_once_window_by_window(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(sources, "_AT_ONCE", 10_000)
    source = _Windows(HEIGHTS)
    ls.encode(source, out=tmp_path / "a.lode", memory=1 << 20)
    assert (tmp_path / "a.lode").read_bytes() == ls.encode(HEIGHTS)
    assert source.read_values == HEIGHTS.size
    assert source.largest <= 10_000
    assert [path.name for path in tmp_path.iterdir()] == ["a.lode"]


@pytest.mark.sweep(4)
@pytest.mark.parametrize("kind", ["h5py", "zarr", "dask", "xyz"])
@pytest.mark.long
def test_arrays_of_other_libraries(kind: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(sources, "_AT_ONCE", 20_000)
    values: NDArray[Any] = HEIGHTS
    array: Any
    if kind == "h5py":
        h5py = pytest.importorskip("h5py")
        array = h5py.File(tmp_path / "a.h5", "w").create_dataset("z", data=HEIGHTS, chunks=(64, 64))
    elif kind == "zarr":
        zarr = pytest.importorskip("zarr")
        array = zarr.create_array(str(tmp_path / "a.zarr"), data=HEIGHTS, chunks=(100, 100))
    elif kind == "dask":
        array = pytest.importorskip("dask.array").from_array(HEIGHTS, chunks=(128, 300))
    else:
        values = np.stack([HEIGHTS, HEIGHTS[::-1], HEIGHTS], axis=-1).astype(np.float32)
        array = _Windows(values)
    assert is_source(array)
    assert ls.encode(array) == ls.encode(values)


def test_what_is_no_source_is_an_array() -> None:
    assert not any(is_source(value) for value in (HEIGHTS, [[1, 2], [3, 4]], (1, 2), np.ma.masked_array(HEIGHTS)))


@pytest.mark.parametrize("shape", [(700, 640), (1, 9_000), (9_000, 1), (300, 20, 3)])
@pytest.mark.parametrize("chunk", [(1, 1), (64, 64), (1_000, 7), (3, 100_000)])
def test_windows_are_whole_chunks_each_once(
    shape: tuple[int, ...], chunk: tuple[int, int], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(sources, "_AT_ONCE", 5_000)
    times = np.zeros(shape[:2], np.int64)
    for window in sources.windows(shape, chunk):
        times[window] += 1
        sides = [(part.stop - part.start, part.start % side) for part, side in zip(window, chunk, strict=True)]
        assert all(start == 0 for _, start in sides)
        least = math.prod(min(side, length) for side, length in zip(chunk, shape, strict=False))
        assert times[window].size * math.prod(shape[2:]) <= max(5_000, least * 3)
    assert (times == 1).all()


def test_windows_of_another_shape_are_refused() -> None:
    source = _Windows(HEIGHTS)
    source.shape = (700, 641)
    with pytest.raises(ls.InputError, match="expected a window of shape"):
        ls.encode(source)
    source.shape = (700,)
    with pytest.raises(ls.InputError, match="expected a source of shape"):
        ls.encode(source)


def test_windows_of_another_dtype_are_refused() -> None:
    source = _Windows(HEIGHTS)
    source._values = HEIGHTS / 10  # as of files with a scale
    with pytest.raises(ls.InputError, match="expected values of int16, as the source says, got float64"):
        ls.encode(source)


def test_masked_values_are_no_values() -> None:
    source = _Windows(HEIGHTS)
    source._values = np.ma.masked_equal(HEIGHTS, HEIGHTS[3, 5])
    with pytest.raises(ls.InputError, match="got masked ones"):
        ls.encode(source)


def test_a_dask_array_of_arrays_in_memory_goes_through_no_scheduler(monkeypatch: pytest.MonkeyPatch) -> None:
    dask = pytest.importorskip("dask")
    array = pytest.importorskip("dask.array").from_array(HEIGHTS, chunks=(128, 300))

    def scheduler(*_: object, **__: object) -> None:
        pytest.fail("it is sent the whole array")

    with dask.config.set(scheduler=scheduler):
        assert ls.encode(array) == ls.encode(HEIGHTS)
