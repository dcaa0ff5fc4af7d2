"""Files of very many small patches: a reader reads them, or refuses them with the limit that they are beyond."""

from __future__ import annotations

import warnings
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from lodestream import formats
from lodestream.errors import FormatError, InputError, TooLargeError
from lodestream.formats import text_arrays
from lodestream.formats.netcdf import hdf5_guard

from . import many_patches

Maker = Callable[[Path, int], Path]

#: Each with a number of patches that is too large, and words of the reason.
REFUSED: list[tuple[Maker, int, type[InputError], str]] = [
    (many_patches.npz_members, 25_000, TooLargeError, "at most 1000 arrays"),
    (many_patches.netcdf_variables, 5_000, FormatError, "one variable over a surface"),
    (many_patches.plot3d_blocks, 100_000, FormatError, "PLOT3D grid file whose size fits"),
    (many_patches.ply_elements, 100_000, FormatError, "within 1,048,576 bytes"),
    (many_patches.obj_polygon, 100_000, FormatError, "3 or 4 corners"),
    (many_patches.pcd_fields, 100_000, FormatError, "within 65,536 bytes"),
    (many_patches.geotiff_bands, 65_535, TooLargeError, "at most 4,096 bands"),
    (many_patches.geotiff_items, 100_000, TooLargeError, "bytes of GDAL's metadata"),
    (many_patches.geotiff_images, 25_000, FormatError, "one image"),
    (many_patches.vtk_fields, 100_000, TooLargeError, "at most 1,000 arrays"),
    (many_patches.vtk_arrays, 100_000, TooLargeError, "at most 1,000 arrays"),
    (many_patches.vts_arrays, 100_000, TooLargeError, "at most 1,000 arrays"),
    (many_patches.vts_pieces, 100_000, TooLargeError, "at most 1,000 arrays"),
    (many_patches.vts_attributes, 10_000, TooLargeError, "at most 100 attributes"),
    (many_patches.vts_attribute, 20_000, TooLargeError, "tags and comments of at most"),
    (many_patches.loose_quads, 25_000, FormatError, "connected pieces"),
]


def name_of(value: object) -> str | None:
    return getattr(value, "__name__", None)


@pytest.mark.sweep(8)
@pytest.mark.parametrize(("maker", "count"), many_patches.READ, ids=name_of)
@pytest.mark.long
def test_very_many_patches_are_read(maker: Maker, count: int, tmp_path: Path) -> None:
    """Whether in proportion to their number, `make bench ARGS=patches` measures with more of them."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # of what is left out
        surface = formats.read(maker(tmp_path, count))
    assert sum(block.points.size for block in surface.blocks) > 1


@pytest.mark.sweep(6)
@pytest.mark.parametrize(("maker", "count", "error", "reason"), REFUSED, ids=name_of)
@pytest.mark.long
def test_a_limit_refuses_very_many_patches(
    maker: Maker, count: int, error: type[InputError], reason: str, tmp_path: Path
) -> None:
    path = maker(tmp_path, count)
    with pytest.raises(error, match=reason):
        formats.read(path)


def test_a_line_of_many_numbers_and_a_word_is_known_for_no_numbers() -> None:
    for line in (b"12 " * 1300 + b"x\n", b"1" * 4000 + b"x\n", b"1" + b" " * 4000 + b"x\n", b"1  ;  2" * 500 + b"x\n"):
        assert not text_arrays.sniff(line, ".txt")


@pytest.mark.parametrize("line", [b"1.5e3, .5;-2. 3E-4\tnan", b"  12  34 ", b"1 ,2 , 3,", b"+1 inf"])
def test_lines_of_numbers_are_known(line: bytes) -> None:
    assert text_arrays.sniff(line + b"\n", ".csv")


@pytest.mark.parametrize("line", [b"1.5.5", b"1e", b"1,,2", b"-", b". 1", b"1 2 x"])
def test_other_lines_are_no_numbers(line: bytes) -> None:
    assert not text_arrays.sniff(line + b"\n", ".csv")


def test_without_a_list_of_chunks_few_are_counted_and_many_refused(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    import h5py

    class Old:
        """A dataset's identifier of an HDF5 that cannot list chunks."""

        def __init__(self, whole: h5py.h5d.DatasetID) -> None:
            self.get_num_chunks = whole.get_num_chunks
            self.get_chunk_info = whole.get_chunk_info

    class Dataset:
        def __init__(self, whole: h5py.Dataset) -> None:
            self.id, self.name = Old(whole.id), whole.name

    monkeypatch.setattr(hdf5_guard, "_HARMLESS_CHUNK", 0)
    with h5py.File(many_patches.hdf5_chunks(tmp_path, 4_000)) as file:
        assert hdf5_guard._large_chunks(Dataset(file["z"])) == hdf5_guard._large_chunks(file["z"])
        assert hdf5_guard._large_chunks(file["z"]) == [(place, 0) for place in range(4_000)]
    with (
        h5py.File(many_patches.hdf5_chunks(tmp_path, 4_001)) as file,
        pytest.raises(TooLargeError, match="4,001 in '/z'"),
    ):
        hdf5_guard._large_chunks(Dataset(file["z"]))


def test_values_of_elements_with_lists_of_other_lengths_are_those_of_the_file(tmp_path: Path) -> None:
    from lodestream.formats.ply.elements import Lists, read_elements
    from lodestream.formats.ply.header import read_header

    path = many_patches.ply_elements(tmp_path, 3)
    tables = read_elements(path, read_header(path))
    for name in "012":
        lists = tables[name]["a"]
        assert isinstance(lists, Lists)
        np.testing.assert_array_equal(lists.counts, [1, 2])
        np.testing.assert_array_equal(lists.values, [5, 6, 7])
