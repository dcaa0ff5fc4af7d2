"""`encode` of surfaces that do not fit into the memory that there is."""

from __future__ import annotations

import gc
import multiprocessing
import os
from collections.abc import Callable, Iterator
from concurrent.futures import ProcessPoolExecutor, ThreadPoolExecutor
from functools import cache
from pathlib import Path
from typing import Any
from unittest import mock

import numpy as np
import pytest
from numpy.typing import NDArray

import lodestream as ls
from lodestream.container.capacity import default_memory
from lodestream.encoding import encode as encoding
from lodestream.encoding import folder_build, tasks
from lodestream.encoding.memory import checked_memory
from lodestream.encoding.prepared import prepare
from lodestream.encoding.references import root_of
from lodestream.scratch import FolderScratch

from ..surfaces import terrain

LITTLE = 1 << 20


@pytest.fixture(autouse=True)
def _small_pieces() -> Iterator[None]:
    """So little memory makes several pieces of two levels of `_heights`."""
    with mock.patch.object(folder_build, "_FEWEST", 1 << 13):
        yield


@cache
def _values() -> NDArray[np.int16]:
    values = np.rint(300 * terrain((510, 130))).astype(np.int16)
    values.flags.writeable = False
    return values


def _heights() -> ls.Surface:
    return ls.Surface(_values(), metadata={"name": "hills"})


@cache
def _container() -> bytes:
    return ls.encode(_heights())


@cache
def _container_of_values() -> bytes:
    return ls.encode(_values())


@pytest.fixture
def cut(monkeypatch: pytest.MonkeyPatch) -> Callable[[int], None]:
    """Let the task of coding fail after so many calls."""

    def after(count: int) -> None:
        calls, code = [0], tasks.code

        def failing(*arguments: Any) -> None:
            calls[0] += 1
            if calls[0] > count:
                raise KeyboardInterrupt
            code(*arguments)

        monkeypatch.setattr(tasks, "code", failing)

    return after


def test_a_file_has_the_bytes_of_one_piece(tmp_path: Path) -> None:
    surface, told = _heights(), [0.0]
    ls.encode(surface, out=tmp_path / "a.lode", memory=LITTLE, progress=told.append)
    assert (tmp_path / "a.lode").read_bytes() == _container()
    assert told == sorted(told)
    assert told[-1] == 1.0
    assert len(told) > 10
    assert [path.name for path in tmp_path.iterdir()] == ["a.lode"]


def test_bytes_are_those_of_one_piece() -> None:
    surface = _heights()
    assert ls.encode(surface, "0.1%", memory=LITTLE) == ls.encode(surface, "0.1%")


@pytest.mark.long
def test_noise_is_tried_on_coarser_lattices(tmp_path: Path) -> None:
    noise = np.random.default_rng(0).integers(0, 2**32, (300, 310)).astype(np.uint32).view(np.float32)
    noise = np.where(np.isfinite(noise), noise, 0).astype(np.float32)
    assert ls.encode(noise, memory=LITTLE) == ls.encode(noise)


def test_processes_share_the_work(tmp_path: Path) -> None:
    surface = _heights()
    path = tmp_path / "heights.npy"
    np.save(path, surface.points)
    mapped = ls.Surface(np.load(path, mmap_mode="r"), metadata={"name": "hills"})
    with ProcessPoolExecutor(2, multiprocessing.get_context("spawn")) as executor:
        assert ls.encode(mapped, executor=executor, memory=LITTLE) == _container()


@pytest.mark.sweep(6)
@pytest.mark.parametrize("shape", [(1, 2), (2, 3), (40, 50), (150, 150)])
@pytest.mark.parametrize("kind", ["heights", "holes", "closed columns", "closed rows", "closed both"])
@pytest.mark.long
def test_small_surfaces_are_built_by_an_executor_too(shape: tuple[int, int], kind: str) -> None:
    heights = np.rint(300 * terrain(shape)).astype(np.int16)
    mask = np.hypot(*np.mgrid[-1 : 1 : shape[0] * 1j, -1 : 1 : shape[1] * 1j]) < 1.2 if kind == "holes" else None
    if mask is not None:
        mask[0, 0] = True
    closed = kind in ("closed rows", "closed both"), kind in ("closed columns", "closed both")
    surface = ls.Surface(heights, closed, mask=mask)
    with ThreadPoolExecutor(2) as executor:
        assert ls.encode(surface, executor=executor) == ls.encode(surface)


def test_what_is_no_surface_is_told_in_words(tmp_path: Path) -> None:
    with pytest.raises(ls.InputError, match="expected a surface, such as an array or the path of a file, got None"):
        ls.encode(None)  # type: ignore[call-overload]
    with pytest.raises(ls.InputError, match="either points, as an array, or blocks, got neither"):
        ls.Surface()
    with pytest.raises(ls.InputError, match=r"such as lodestream.Surface\(array\) makes of an array, got ndarray"):
        ls.write(np.zeros((3, 4)), tmp_path / "a.npy")  # type: ignore[arg-type]


def test_a_surface_of_one_point_is_refused_whoever_builds() -> None:
    with ThreadPoolExecutor(1) as executor, pytest.raises(ls.InputError, match="at least two points"):
        ls.encode(np.zeros((1, 1)), executor=executor)


def test_what_has_an_executor_is_none() -> None:
    class Client:
        """As that of Dask, which has ``submit`` too, but other futures."""

        def get_executor(self) -> None: ...

    with pytest.raises(ls.InputError, match=r"got .*Client: pass what its get_executor\(\) returns"):
        ls.encode(np.zeros((9, 9)), executor=Client())  # type: ignore[call-overload]


def test_an_interrupted_build_leaves_nothing(tmp_path: Path, cut: Callable[[int], None]) -> None:
    cut(1)
    with pytest.raises(KeyboardInterrupt):
        ls.encode(_heights(), out=tmp_path / "a.lode", memory=LITTLE)
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize("kind", ["heights", "torus of 64 bits"])
def test_a_named_folder_is_kept_and_the_build_goes_on(
    tmp_path: Path, cut: Callable[[int], None], monkeypatch: pytest.MonkeyPatch, kind: str
) -> None:
    surface, scratch = _heights(), tmp_path / "scratch"
    if kind != "heights":
        surface = ls.Surface(surface.points.astype(np.int64) + 2**60, (True, True))
    expected = ls.encode(surface)
    cut(2)
    with pytest.raises(KeyboardInterrupt):
        ls.encode(surface, out=tmp_path / "a.lode", memory=LITTLE, scratch=scratch)
    monkeypatch.undo()
    assert not (tmp_path / "a.lode").exists()
    called = []
    for name in ("coordinates", "first_step", "second_step", "core"):
        monkeypatch.setattr(tasks, name, lambda *arguments, name=name: called.append(name))
    ls.encode(surface, out=tmp_path / "a.lode", memory=LITTLE, scratch=scratch)
    assert not called
    assert (tmp_path / "a.lode").read_bytes() == expected
    assert not list(scratch.iterdir())


def test_a_build_of_something_else_begins_anew(
    tmp_path: Path, cut: Callable[[int], None], monkeypatch: pytest.MonkeyPatch
) -> None:
    surface, scratch = _heights(), tmp_path / "scratch"
    cut(1)
    with pytest.raises(KeyboardInterrupt):
        ls.encode(surface, out=tmp_path / "a.lode", memory=LITTLE, scratch=scratch)
    monkeypatch.undo()
    other = ls.Surface(surface.points + np.int16(1), metadata=surface.metadata)
    ls.encode(other, out=tmp_path / "a.lode", memory=LITTLE, scratch=scratch)
    assert (tmp_path / "a.lode").read_bytes() == ls.encode(other)


def test_points_that_are_one_are_found_again_in_the_values() -> None:
    rows, columns = np.mgrid[:300, :280] / 40
    points = np.stack([np.cos(rows), rows * columns, np.sin(rows + columns)], axis=-1)
    points[0, 5] = points[-1, 7] = points[9, 0]  # which lie at one place
    metadata = {"faces": {"joined": True}}
    whole = ls.encode(ls.Surface(points, metadata=metadata))
    decoded = ls.decode(whole)
    assert decoded.joints is not None
    assert decoded.joints.places.points.size
    assert ls.encode(decoded, memory=LITTLE) == whole
    assert decoded.joints is not None


def test_what_has_no_bands_says_so() -> None:
    surface = ls.Surface(np.rint(300 * terrain((510, 130))).astype(np.int16))
    with pytest.raises(ls.TooLargeError, match="rms"):
        ls.encode(surface, memory=LITTLE, rms="0.1%")


def test_numbers_whose_squares_are_no_float64_keep_to_the_memory(tmp_path: Path) -> None:
    heights = 1e290 * terrain((300, 280))
    with pytest.raises(ls.TooLargeError, match=r"at most 1 MiB to encode, got one that takes about 2 MiB .* squares"):
        ls.encode(heights, out=tmp_path / "a.lode", memory=1 << 20)
    assert not any(tmp_path.iterdir())
    ls.encode(heights, out=tmp_path / "a.lode", memory=2 << 20)
    assert np.array_equal(ls.decode(tmp_path.joinpath("a.lode").read_bytes()).points, heights)
    with ThreadPoolExecutor(1) as executor:  # nobody has said how much memory there is
        assert ls.encode(heights, executor=executor) == (tmp_path / "a.lode").read_bytes()


def test_more_memory_than_needed_means_one_piece(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(encoding, "FolderBuild", None)
    ls.encode(_heights(), out=tmp_path / "a.lode")
    assert os.listdir(tmp_path) == ["a.lode"]
    assert default_memory() > 1 << 20


class _Plane:
    """A source that cannot be known but by its values."""

    shape, dtype = _values().shape, np.dtype(np.int16)

    def __init__(self) -> None:
        self.values = _heights().points

    def read(self, window: tuple[slice, slice]) -> NDArray[np.int16]:
        return self.values[window]


def test_a_source_goes_on_if_its_values_are_the_same(
    tmp_path: Path, cut: Callable[[int], None], monkeypatch: pytest.MonkeyPatch
) -> None:
    source, scratch = _Plane(), tmp_path / "scratch"
    cut(2)
    for _ in range(2):
        with pytest.raises(KeyboardInterrupt):
            ls.encode(source, out=tmp_path / "a.lode", memory=LITTLE, scratch=scratch)
        assert {path.name for path in tmp_path.iterdir()} == {"scratch"}
        assert [path for path in scratch.iterdir() if path.name.startswith(".")] == [], "copies"
    monkeypatch.undo()
    called = []
    coordinates = tasks.coordinates

    def counted(*arguments: Any) -> None:
        called.append(arguments)
        coordinates(*arguments)

    monkeypatch.setattr(tasks, "coordinates", counted)
    ls.encode(source, out=tmp_path / "a.lode", memory=LITTLE, scratch=scratch)
    assert not called
    assert (tmp_path / "a.lode").read_bytes() == ls.encode(source.values)
    cut(2)
    with pytest.raises(KeyboardInterrupt):
        ls.encode(source, out=tmp_path / "a.lode", memory=LITTLE, scratch=scratch)
    source.values = source.values[::-1]
    monkeypatch.undo()
    ls.encode(source, out=tmp_path / "a.lode", memory=LITTLE, scratch=scratch)
    assert (tmp_path / "a.lode").read_bytes() == ls.encode(source.values)
    assert {path.name for path in tmp_path.iterdir()} == {"a.lode", "scratch"}


def _mapped(path: Path, values: NDArray[Any]) -> NDArray[Any]:
    np.save(path, values)
    mapped: NDArray[Any] = np.load(path, mmap_mode="r")
    return mapped


def test_a_file_of_the_same_time_and_size_is_another_one(
    tmp_path: Path, cut: Callable[[int], None], monkeypatch: pytest.MonkeyPatch
) -> None:
    path, scratch = tmp_path / "heights.npy", tmp_path / "scratch"
    values = _heights().points
    mapped = _mapped(path, values)
    state = path.stat()
    cut(1)
    with pytest.raises(KeyboardInterrupt):
        ls.encode(mapped, out=tmp_path / "a.lode", memory=LITTLE, scratch=scratch)
    monkeypatch.undo()
    other = _mapped(path, values[::-1])
    os.utime(path, ns=(state.st_atime_ns, state.st_mtime_ns))
    ls.encode(other, out=tmp_path / "a.lode", memory=LITTLE, scratch=scratch)
    assert (tmp_path / "a.lode").read_bytes() == ls.encode(np.ascontiguousarray(values[::-1]))


def test_a_file_that_is_written_to_meanwhile_is_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path, code = tmp_path / "heights.npy", tasks.code
    mapped = _mapped(path, _heights().points)

    def writing(*arguments: Any) -> None:
        os.utime(path)
        code(*arguments)

    monkeypatch.setattr(tasks, "code", writing)
    with pytest.raises(ls.InputError, match=r"heights\.npy to stay as it is until it is encoded"):
        ls.encode(mapped, out=tmp_path / "a.lode", memory=LITTLE)
    assert {path.name for path in tmp_path.iterdir()} == {"heights.npy"}


def test_changes_in_a_map_that_are_not_in_its_file_are_encoded(tmp_path: Path) -> None:
    path = tmp_path / "heights.npy"
    np.save(path, _heights().points)
    mapped: NDArray[np.int16] = np.load(path, mmap_mode="c")
    mapped[100:200, 50:90] += 77
    with ProcessPoolExecutor(1, multiprocessing.get_context("spawn")) as executor:
        container = ls.encode(mapped, executor=executor, memory=LITTLE)
    assert container == ls.encode(np.array(mapped))


def test_arrays_in_files_are_not_copied_for_workers(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    written, write = list[str](), FolderScratch._write

    def spy(self: FolderScratch, *arguments: Any) -> None:
        written.append(str(self.folder))
        write(self, *arguments)

    monkeypatch.setattr(FolderScratch, "_write", spy)
    mapped = _mapped(tmp_path / "heights.npy", _heights().points)
    with ThreadPoolExecutor(1) as executor:
        assert ls.encode(mapped, executor=executor, memory=LITTLE) == _container_of_values()
    assert written
    assert not any(folder.endswith("surface") for folder in written)


def test_the_same_build_is_not_made_twice_at_once(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    surface, code, said = _heights(), tasks.code, list[str]()
    other = ls.Surface(surface.points[::-1].copy())

    def second(*arguments: Any) -> None:
        if not said:
            said.append("")
            with pytest.raises(ls.InputError, match="the same build is at work there") as refused:
                ls.encode(surface, out=tmp_path / "b.lode", memory=LITTLE, scratch=tmp_path / "scratch")
            said.append(str(refused.value))
            ls.encode(other, out=tmp_path / "b.lode", memory=LITTLE, scratch=tmp_path / "scratch")
            ls.encode(surface, out=tmp_path / "a.lode", memory=LITTLE)
        code(*arguments)

    monkeypatch.setattr(tasks, "code", second)
    ls.encode(surface, out=tmp_path / "a.lode", memory=LITTLE, scratch=tmp_path / "scratch")
    assert str(tmp_path / "scratch") in said[1]
    assert (tmp_path / "a.lode").read_bytes() == ls.encode(surface)
    assert (tmp_path / "b.lode").read_bytes() == ls.encode(other)


@pytest.mark.parametrize("memory", [None, LITTLE])
def test_a_folder_that_is_missing_is_named(tmp_path: Path, memory: int | None) -> None:
    with pytest.raises(FileNotFoundError, match=r"expected a folder to write .*nodir'$"):
        ls.encode(_heights(), out=tmp_path / "nodir" / "a.lode", memory=memory)
    with pytest.raises(IsADirectoryError, match="got a folder"):
        ls.encode(_heights(), out=tmp_path, memory=memory)
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize("options", [{}, {"memory": LITTLE}, {"memory": 1 << 40}])
def test_warnings_name_the_caller(options: dict[str, Any]) -> None:
    heights = np.where(np.arange(130) > 20, _heights().points, np.nan)
    surface = ls.Surface(heights, attributes={"kind": np.ones(heights.shape, np.uint8)})
    with pytest.warns(ls.FormatWarning, match="left out") as found:
        ls.encode(surface, **options)
    assert [warning.filename for warning in found] == [__file__]


@pytest.mark.parametrize(
    ("text", "size"),
    [("1MiB", 1 << 20), (" 1.5 gib ", 3 << 29), ("2000kB", 2_000_000), ("3G", 3 * 10**9), (1 << 21, 1 << 21)],
)
def test_memory_is_a_number_or_text(text: str | int, size: int) -> None:
    assert checked_memory(text) == size
    number: Any = np.int64(5 << 20)
    assert checked_memory(number) == 5 << 20


@pytest.mark.parametrize("memory", ["much", "", "16 lb", "-1MiB", 0.5, True, b"1MiB", "1KiB", 0, -5, 1023 << 10])
def test_memory_that_is_none_or_too_little_says_so(memory: Any) -> None:
    with pytest.raises(ls.OptionError, match=r"^expected (memory in bytes, such as|1 MiB of memory or more).* got "):
        ls.encode(_heights(), memory=memory)


def test_text_says_how_much_memory_there_is() -> None:
    surface = _heights()
    assert ls.encode(surface, memory="1MiB") == _container()


@pytest.mark.long
def test_copies_of_one_source_are_all_in_files(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    xarray = pytest.importorskip("xarray")
    heights = _heights().points.astype(np.float32)
    heights[:40, :30] = np.nan
    rows, columns = np.mgrid[:510.0, :130.0]
    data = xarray.Dataset(
        {"z": (("y", "x"), heights), "speed": (("y", "x"), heights[::-1].copy())},
        coords={"lat": (("y", "x"), rows + columns / 9), "lon": (("y", "x"), columns - rows / 9)},
    )
    seen: list[NDArray[Any]] = []

    def spy(surface: ls.Surface, *others: Any) -> Any:
        block = surface.blocks[0]
        assert block.mask is not None
        seen.extend([block.points, block.mask, *block.attributes.values()])
        assert all(root_of(array) is not None for array in seen)
        assert len(list(tmp_path.glob(".a.lode.*.lodestream/source/arrays/*.npy"))) > 2
        return prepare(surface, *others)

    monkeypatch.setattr(folder_build, "prepare", spy)
    ls.encode(data, out=tmp_path / "a.lode", memory=LITTLE)
    assert [array.shape for array in seen] == [(510, 130, 3), (510, 130), (510, 130)]
    assert (tmp_path / "a.lode").read_bytes() == ls.encode(ls.Surface.from_xarray(data))


def test_a_map_whose_file_was_replaced_is_encoded_itself(tmp_path: Path) -> None:
    values = _heights().points
    mapped = _mapped(tmp_path / "heights.npy", values)
    np.save(tmp_path / "new.npy", values // 2 + np.int16(7))
    os.replace(tmp_path / "new.npy", tmp_path / "heights.npy")
    ls.encode(mapped, out=tmp_path / "a.lode", memory=LITTLE)
    assert (tmp_path / "a.lode").read_bytes() == ls.encode(values)


@pytest.mark.skipif(not Path("/proc/self/maps").exists(), reason="the system does not tell what is mapped")
@pytest.mark.parametrize("failing", [False, True])
def test_files_that_were_removed_are_mapped_no_more(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, failing: bool
) -> None:
    if failing:
        monkeypatch.setattr(tasks, "measure", None)
    try:
        ls.encode(_Plane(), out=tmp_path / "a.lode", memory=LITTLE)
    except TypeError:
        assert failing
    gc.collect()
    assert str(tmp_path) not in Path("/proc/self/maps").read_text()
