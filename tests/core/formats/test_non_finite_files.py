"""Infinities in files: read, written where the format has them, and noted where it has not."""

from __future__ import annotations

import json
import warnings
from pathlib import Path

import numpy as np
import pytest

import lodestream as ls
from lodestream.coordinates.seams import merge, restore, unwrap

from ..surfaces import terrain, torus
from ..test_non_finite import lake, plane


def written(surface: ls.Surface, suffix: str, folder: Path) -> ls.Surface:
    path = folder / f"surface{suffix}"
    ls.write(surface, path)
    return ls.read(path)


@pytest.mark.parametrize("suffix", [".npy", ".tif"])
def test_formats_of_numbers_hold_infinite_heights(suffix: str, tmp_path: Path) -> None:
    heights = terrain((33, 40)).astype(np.float32)
    heights[3, 4:9], heights[20:23, 7], heights[9, 9] = np.inf, -np.inf, np.nan
    found = written(ls.Surface(heights), suffix, tmp_path)
    assert np.array_equal(found.points, heights, equal_nan=True)
    if suffix == ".npy":
        points = plane()
        assert written(ls.Surface(points), suffix, tmp_path).points.tobytes() == points.tobytes()
    else:
        points = plane()
        points[50, 50, 0] = np.inf
        with pytest.warns(ls.FormatWarning, match="those of holes that are off this grid are left out"):
            found = written(ls.Surface(points), suffix, tmp_path)
        points[50, 50] = np.nan
        assert np.array_equal(found.points, points[..., 2], equal_nan=True)


@pytest.mark.filterwarnings("ignore:.* vertices without a face:lodestream.errors.FormatWarning")  # alone among holes
@pytest.mark.parametrize("suffix", [".obj", ".ply", ".glb", ".vts", ".png"])
def test_formats_without_infinities_have_holes_and_say_so(suffix: str, tmp_path: Path) -> None:
    points = lake((20, 31), 3)
    points[9, 9, 0], points[4, 4] = np.inf, np.nan
    if suffix == ".png":
        points = np.floor(terrain((20, 31)))
        points[5:7, 9] = np.inf
    count = int(np.isinf(points).any(axis=2).sum()) if points.ndim == 3 else int(np.isinf(points).sum())
    path = tmp_path / f"surface{suffix}"
    with pytest.warns(ls.FormatWarning) as caught:
        ls.write(ls.Surface(points), path)
    noted = f"{suffix[1:].upper()} is written with holes in place of {count} points that are infinite"
    assert noted in [str(warning.message) for warning in caught]
    if suffix == ".glb":
        content = path.read_bytes()
        length = int.from_bytes(content[12:16], "little")
        json.loads(content[20 : 20 + length], parse_constant=pytest.fail)
        return
    found = ls.read(path)
    assert all(np.isfinite(b.points[b.mask if b.mask is not None else slice(None)]).all() for b in found.blocks)


def test_glb_holds_no_infinite_attributes(tmp_path: Path) -> None:
    values = terrain((9, 11)).astype(np.float32)
    values[3, 3] = np.inf
    with pytest.warns(ls.FormatWarning, match="GLB is written without the infinities of t"):
        ls.write(ls.Surface(torus(9, 11), attributes={"t": values}), tmp_path / "a.glb")


def test_nodata_that_is_infinite_is_no_value(tmp_path: Path) -> None:
    rasterio = pytest.importorskip("rasterio")
    heights = terrain((20, 30)).astype(np.float32)
    heights[3, 4:9], heights[7, 7] = -np.inf, np.inf
    path = tmp_path / "a.tif"
    with (
        warnings.catch_warnings(action="ignore"),
        rasterio.open(path, "w", driver="GTiff", height=20, width=30, count=1, dtype="float32", nodata=-np.inf) as file,
    ):
        file.write(heights, 1)
    heights[3, 4:9] = np.nan
    found = ls.read(path)
    assert np.array_equal(found.points, heights, equal_nan=True)
    back = written(ls.decode(ls.encode(found)), ".tif", tmp_path)
    assert np.array_equal(back.points, heights, equal_nan=True)


@pytest.mark.parametrize("angle", [None, (0, 360.0)])
def test_repeated_lines_with_infinities_are_merged_and_put_back(angle: tuple[int, float] | None) -> None:
    points = torus(24, 18, "float64")
    if angle is not None:
        points[..., 0] = np.arange(18) * 20.0
    points[3, 0, 1], points[5, 0, 2], points[7, 7], points[9, 0, 0] = np.inf, np.nan, -np.inf, np.inf
    last = points[:, :1].copy()
    last[..., 0] += 0 if angle is None else 360
    seam = np.concatenate([points, last], axis=1)
    merged = merge(ls.Surface(seam), angle=angle)
    assert merged.closed == (False, True)
    back = restore(ls.decode(ls.encode(merged)))
    assert back.points.tobytes() == seam.tobytes()
    seam[3, -1, 1] = -np.inf  # repeats all valid points, but not this one
    assert merge(ls.Surface(seam), angle=angle).closed == (False, False)


def test_longitudes_beside_infinities_are_unwrapped_and_wrapped_again() -> None:
    y, x = np.mgrid[:20, :30].astype(float)
    points = np.stack([(x * 7 + y * 3 + 200) % 360 - 180, y, terrain((20, 30))], axis=-1)
    points[3, 4, 0], points[5, 6, 2], points[8, 9, 1], points[9, 9] = np.inf, -np.inf, np.nan, np.nan
    smooth = unwrap(ls.Surface(points), 0, 360.0)
    assert "angles" in smooth.metadata
    assert restore(ls.decode(ls.encode(smooth))).points.tobytes() == points.tobytes()
