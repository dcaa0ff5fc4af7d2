"""Formats of several blocks that CFD's programs read: PLOT3D, VTS, and VTM as files of a folder and as an archive."""

from __future__ import annotations

import errno
import io
import os
import struct
from pathlib import Path
from typing import Any
from zipfile import ZipFile

import numpy as np
import pytest

from lodestream import formats
from lodestream.errors import FormatError, FormatWarning
from lodestream.formats.vtk import writer
from lodestream.surface import Block, Surface


def block(columns: int = 9, start: float = 0.0, hole: bool = False, dtype: Any = np.float64) -> Block:
    x, y = np.meshgrid(start + np.arange(columns) / 3, np.arange(6.0))
    points = np.stack((x, y, np.sin(x) + y), axis=-1).astype(dtype)
    mask = np.ones(x.shape, np.bool_)
    mask[2, 3] = mask[0, 0] = not hole
    return Block(points, mask=mask if hole else None, attributes={"speed": points[..., 2] * 2})


def wing(dtype: Any = np.float64) -> Surface:
    return Surface(blocks=[block(hole=True, dtype=dtype), block(4, 8 / 3, dtype=dtype)], metadata={"unit": "m"})


def same(back: Surface, surface: Surface) -> None:
    assert [it.shape for it in back.blocks] == [it.shape for it in surface.blocks]
    for one, other in zip(back.blocks, surface.blocks, strict=True):
        valid = np.ones(other.shape, np.bool_) if other.mask is None else other.mask
        np.testing.assert_array_equal(np.ones(one.shape, np.bool_) if one.mask is None else one.mask, valid)
        np.testing.assert_array_equal(one.points[valid], other.points[valid])


# PLOT3D.


@pytest.mark.parametrize("suffix", ["p3d", "x", "g", "unf", "plot3d"])
@pytest.mark.parametrize("dtype", [np.float32, np.float64])
def test_blocks_come_back_from_plot3d(tmp_path: Path, suffix: str, dtype: Any) -> None:
    with pytest.warns(FormatWarning, match="PLOT3D is written without speed, unit, which it cannot hold"):
        formats.write(wing(dtype), tmp_path / f"a.{suffix}")
    back = formats.read(tmp_path / f"a.{suffix}")
    same(back, wing(dtype))
    assert back.blocks[0].points.dtype == dtype


def test_plot3d_is_what_fortran_writes(tmp_path: Path) -> None:
    formats.write(Surface(np.arange(12.0).reshape(3, 2, 2).astype(np.float32)), tmp_path / "a.p3d")
    content = (tmp_path / "a.p3d").read_bytes()
    assert struct.unpack_from("<3i", content) == (4, 1, 4)
    assert struct.unpack_from("<4i", content, 12) == (8, 2, 3, 8)
    assert struct.unpack_from("<i12fi", content, 28) == (48, *range(0, 12, 2), *range(1, 12, 2), 48)
    assert len(content) == 28 + 8 + 48


def test_vtk_reads_plot3d(tmp_path: Path) -> None:
    pyvista = pytest.importorskip("pyvista")
    with pytest.warns(FormatWarning):
        formats.write(wing(), tmp_path / "a.p3d")
    reader = pyvista.MultiBlockPlot3DReader(str(tmp_path / "a.p3d"))
    reader.auto_detect_format = True
    grids = reader.read()
    assert [grid.dimensions for grid in grids] == [(9, 6, 1), (4, 6, 1)]
    np.testing.assert_allclose(grids[1].points.reshape(6, 4, 3), wing().blocks[1].points, rtol=1e-6)
    blanks = np.asarray(grids[0].point_data["IBlank"]).reshape(6, 9)
    np.testing.assert_array_equal(blanks != 0, wing().blocks[0].mask)


def test_iblank_that_agrees_with_the_holes_is_written(tmp_path: Path) -> None:
    hole = block(hole=True)
    values = np.where(np.asarray(hole.mask), 1, 0).astype(np.int32)
    values[5, 5] = -7
    surface = Surface(blocks=[Block(hole.points, mask=hole.mask, attributes={"iblank": values})])
    formats.write(surface, tmp_path / "a.p3d")
    back = formats.read(tmp_path / "a.p3d")
    same(back, surface)
    assert back.attributes["iblank"][5, 5] == -7
    # What says 0 where there is a point is no IBLANK of these holes.
    values[4, 4] = 0
    other = Surface(blocks=[Block(hole.points, mask=hole.mask, attributes={"iblank": values})])
    with pytest.warns(FormatWarning, match="without iblank"):
        formats.write(other, tmp_path / "b.p3d")
    same(formats.read(tmp_path / "b.p3d"), surface)


def test_a_closed_axis_of_plot3d_repeats_its_first_points(tmp_path: Path) -> None:
    angle = np.arange(8) * np.pi / 4
    ring = np.stack(np.broadcast_arrays(np.cos(angle), np.sin(angle), np.arange(5.0)[:, None]), axis=-1)
    formats.write(Surface(ring, (False, True)), tmp_path / "a.p3d")
    assert struct.unpack_from("<2i", (tmp_path / "a.p3d").read_bytes(), 16) == (9, 5)
    back = formats.read(tmp_path / "a.p3d")
    assert back.closed == (False, True)
    np.testing.assert_array_equal(back.points, ring)


def test_integers_that_a_double_does_not_hold_are_refused(tmp_path: Path) -> None:
    with pytest.raises(FormatError, match="a double of PLOT3D holds"):
        formats.write(Surface(np.full((2, 2, 3), 2**53 + 1)), tmp_path / "a.p3d")
    assert list(tmp_path.iterdir()) == []


# VTK.


def test_pyvista_shows_no_cell_of_a_hole(tmp_path: Path) -> None:
    pyvista = pytest.importorskip("pyvista")
    x, y = np.meshgrid(np.arange(9.0), np.arange(9.0))
    mask = np.ones(x.shape, np.bool_)
    mask[4, 4] = False
    formats.write(Surface(np.stack((x, y, 0 * x), axis=-1), mask=mask), tmp_path / "a.vts")
    grid = pyvista.read(tmp_path / "a.vts")
    hidden = np.asarray(grid.cell_data["vtkGhostType"]).reshape(8, 8) > 0
    assert np.argwhere(hidden).tolist() == [[3, 3], [3, 4], [4, 3], [4, 4]]
    assert np.flatnonzero(grid.point_data["vtkGhostType"]).tolist() == [4 * 9 + 4]
    # What VTK draws of a grid.
    assert grid.extract_surface(algorithm="geometry").n_cells == 60
    assert np.isfinite(grid.points).all()


@pytest.mark.parametrize("holes", ["one", "all but a line", "all but a point"])
def test_points_beside_hidden_cells_stay(tmp_path: Path, holes: str) -> None:
    pytest.importorskip("vtkmodules")
    x, y = np.meshgrid(np.arange(7.0), np.arange(7.0))
    mask = np.ones(x.shape, np.bool_)
    if holes == "one":
        mask[3, 3] = False
    else:
        mask[:] = False
        mask[3, 1 : 6 if "line" in holes else 2] = True
    surface = Surface(np.stack((x, y, x * y), axis=-1), mask=mask)
    formats.write(surface, tmp_path / "a.vts")
    same(formats.read(tmp_path / "a.vts"), surface)


def test_vtm_is_a_file_and_a_folder(tmp_path: Path) -> None:
    pyvista = pytest.importorskip("pyvista")
    for speed in (1.0, 3.0):  # the second replaces the first
        surface = wing()
        for it in surface.blocks:
            it.attributes["speed"][:] = speed
        formats.write(surface, tmp_path / "wing.vtm")
    assert sorted(path.relative_to(tmp_path).as_posix() for path in tmp_path.rglob("*")) == [
        *("wing", "wing.vtm", "wing/wing_0.vts", "wing/wing_1.vts")
    ]
    grids = pyvista.read(tmp_path / "wing.vtm")
    assert [grid.dimensions for grid in grids] == [(9, 6, 1), (4, 6, 1)]
    assert {float(value) for value in grids[1].point_data["speed"]} == {3.0}
    same(formats.read(tmp_path / "wing/wing_0.vts", tmp_path / "wing/wing_1.vts"), surface)
    fewer = Surface(blocks=[block()])
    formats.write(fewer, tmp_path / "wing.vtm")
    assert [path.name for path in (tmp_path / "wing").iterdir()] == ["wing_0.vts"]


def test_vtm_as_an_archive_holds_the_same_files(tmp_path: Path) -> None:
    body = io.BytesIO()
    formats.write_stream(wing(), "vtm", _Pipe(body))  # type: ignore[arg-type]  # only its `write` is used
    with ZipFile(body) as archive:
        assert archive.namelist() == ["surface.vtm", "surface/surface_0.vts", "surface/surface_1.vts"]
        assert archive.testzip() is None
        archive.extractall(tmp_path)
    pyvista = pytest.importorskip("pyvista")
    assert pyvista.read(tmp_path / "surface.vtm").n_blocks == 2
    same(formats.read(tmp_path / "surface/surface_0.vts", tmp_path / "surface/surface_1.vts"), wing())


class _Pipe:
    """A file that can only be written."""

    def __init__(self, file: io.BytesIO) -> None:
        self.write = file.write


@pytest.mark.parametrize("name", ["none/wing.vtm", "full/wing.vtm"])
def test_an_error_of_the_disk_names_the_vtm(tmp_path: Path, name: str, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "full").mkdir()

    def full(*_: Any) -> None:
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC), ".wing.12ab.tmp")

    monkeypatch.setattr(writer, "write_block", full)
    with pytest.raises(OSError, match=r"wing\.vtm'$") as found:
        formats.write(wing(), tmp_path / name)
    assert (found.value.filename, found.value.filename2) == (str(tmp_path / name), None)
    assert list((tmp_path / "full").iterdir()) == []


def test_what_lies_in_the_folder_of_a_vtm_is_never_deleted(tmp_path: Path) -> None:
    (tmp_path / "wing").mkdir()
    (tmp_path / "wing" / "wing_0.vts").write_text("old")
    (tmp_path / "wing" / "notes.txt").write_text("keep")
    with pytest.raises(FormatError, match=r"wing\.vtm: expected the folder 'wing' .* got 'notes.txt' in it"):
        formats.write(wing(), tmp_path / "wing.vtm")
    assert (tmp_path / "wing" / "wing_0.vts").read_text() == "old"
    (tmp_path / "tail").write_text("a file")
    with pytest.raises(FormatError, match="got a file of that name"):
        formats.write(wing(), tmp_path / "tail.vtm")
    assert sorted(path.name for path in tmp_path.iterdir()) == ["tail", "wing"]


def test_a_folder_without_its_vtm_is_of_somebody_else(tmp_path: Path) -> None:
    (tmp_path / "wing").mkdir()
    (tmp_path / "wing" / "wing_0.vts").write_text("mine")
    (tmp_path / "wing" / "wing_7.vts").write_text("mine")
    with pytest.raises(FormatError, match=r"expected no folder 'wing' with files beside wing\.vtm"):
        formats.write(wing(), tmp_path / "wing.vtm")
    assert [path.read_text() for path in (tmp_path / "wing").iterdir()] == ["mine", "mine"]
    assert [path.name for path in tmp_path.iterdir()] == ["wing"]


def test_a_folder_with_the_name_of_a_block_is_not_deleted(tmp_path: Path) -> None:
    formats.write(wing(), tmp_path / "wing.vtm")
    (tmp_path / "wing" / "wing_2.vts").mkdir()
    (tmp_path / "wing" / "wing_2.vts" / "notes.txt").write_text("keep")
    with pytest.raises(FormatError, match=r"got 'wing_2\.vts' in it"):
        formats.write(wing(), tmp_path / "wing.vtm")
    assert (tmp_path / "wing" / "wing_2.vts" / "notes.txt").read_text() == "keep"


@pytest.mark.parametrize("earlier", [False, True])
def test_a_vtm_that_is_interrupted_leaves_what_was_there(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, earlier: bool
) -> None:
    if earlier:
        formats.write(wing(), tmp_path / "wing.vtm")
    before = {path: path.read_bytes() for path in tmp_path.rglob("*") if path.is_file()}
    rename, renamed = Path.rename, 0

    def interrupt(*given: Any) -> Any:
        nonlocal renamed
        found = rename(*given)
        renamed += 1
        if renamed == 1:
            raise KeyboardInterrupt
        return found

    monkeypatch.setattr(Path, "rename", interrupt)
    with pytest.raises(KeyboardInterrupt):
        formats.write(Surface(blocks=[block(5)]), tmp_path / "wing.vtm")
    assert {path: path.read_bytes() for path in tmp_path.rglob("*") if path.is_file()} == before
    assert len(list(tmp_path.iterdir())) == 2 * earlier


@pytest.mark.parametrize("step", ["block", "rename"])
def test_a_vtm_that_cannot_be_written_leaves_the_old_one(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, step: str
) -> None:
    formats.write(wing(), tmp_path / "wing.vtm")
    before = {path: path.read_bytes() for path in tmp_path.rglob("*") if path.is_file()}
    replace = Path.replace

    def fail(*given: Any) -> Any:
        if step == "block" and given[1] == 0:
            return write_block(*given)
        if step == "rename" and Path(given[1]).suffix != ".vtm":
            return replace(*given)
        raise OSError(28, "No space left on device")

    write_block = writer.write_block
    if step == "block":
        monkeypatch.setattr(writer, "write_block", fail)
    else:
        monkeypatch.setattr(Path, "replace", fail)
    with pytest.raises(OSError, match="No space left"):
        formats.write(Surface(blocks=[block(5), block(5), block(5)]), tmp_path / "wing.vtm")
    assert {path: path.read_bytes() for path in tmp_path.rglob("*") if path.is_file()} == before
