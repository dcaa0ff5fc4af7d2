"""Rasters that GDAL reads, each by one driver; GeoTIFFs that other programs read."""

from __future__ import annotations

import io
import warnings
from pathlib import Path
from typing import Any

import msgpack
import numpy as np
import pytest
from numpy.typing import NDArray

from lodestream import formats
from lodestream.coordinates.height_fields import coordinates, to_xyz
from lodestream.errors import FormatError, FormatWarning, OptionError
from lodestream.surface import Block, Surface

from .test_formats import DTYPES, write_tiff

rasterio = pytest.importorskip("rasterio")

Array = NDArray[Any]

PLACE = [500000.0, 30.0, 0.0, 4100000.0, 0.0, -30.0]


def utm() -> str:
    return str(rasterio.crs.CRS.from_epsg(32611).to_wkt())


def hills(dtype: Any = np.int16, shape: tuple[int, int] = (6, 9)) -> Array:
    return (np.arange(shape[0] * shape[1]).reshape(shape) * 7 % 101 + 1).astype(dtype)


def opened(path: Path) -> Any:
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", rasterio.errors.NotGeoreferencedWarning)
        return rasterio.open(path)


@pytest.mark.parametrize(
    ("dtype", "nodata"),
    [("int16", 32767), ("int16", -1), ("uint8", 0), ("float32", -9999), ("float32", "nan"), ("float32", 3.4e38)],
)
def test_nodata_of_any_value_are_holes(tmp_path: Path, dtype: str, nodata: Any) -> None:
    heights = hills(dtype)
    heights[2, 3:5] = heights[5, 8] = np.dtype(dtype).type(float(nodata))
    write_tiff(tmp_path / "a.tif", heights[None], nodata=float(nodata))
    surface = formats.read(tmp_path / "a.tif")
    assert surface.mask is not None
    assert np.argwhere(~surface.mask).tolist() == [[2, 3], [2, 4], [5, 8]]
    formats.write(surface, tmp_path / "b.tif")
    with opened(tmp_path / "b.tif") as dataset:
        np.testing.assert_array_equal(dataset.read(1), heights)
        np.testing.assert_array_equal(dataset.read_masks(1) > 0, surface.mask)
        assert str(dataset.nodata) == str(
            float(np.dtype(dtype).type(float(nodata))) if dtype == "float32" else float(nodata)
        )


def test_a_mask_inside_the_file_is_one_of_holes(tmp_path: Path) -> None:
    heights = hills()
    mask = heights % 3 > 0
    with rasterio.Env(GDAL_TIFF_INTERNAL_MASK=True), warnings.catch_warnings():
        warnings.simplefilter("ignore", rasterio.errors.NotGeoreferencedWarning)
        profile = {"driver": "GTiff", "height": 6, "width": 9, "count": 1, "dtype": "int16"}
        with rasterio.open(tmp_path / "a.tif", "w", **profile) as dataset:
            dataset.write(heights, 1)
            dataset.write_mask(mask)
    surface = formats.read(tmp_path / "a.tif")
    np.testing.assert_array_equal(surface.mask, mask)
    formats.write(surface, tmp_path / "b.tif")
    assert not (tmp_path / "b.tif.msk").exists()
    with opened(tmp_path / "b.tif") as dataset:
        assert dataset.nodata is None
        np.testing.assert_array_equal(dataset.read_masks(1) > 0, mask)
        np.testing.assert_array_equal(dataset.read(1)[mask], heights[mask])


def test_transparency_is_one_of_holes(tmp_path: Path) -> None:
    alpha = np.where(hills(np.uint8) % 2 == 1, 255, 0).astype(np.uint8)
    write_tiff(tmp_path / "a.tif", np.stack((hills(np.uint8), alpha)), alpha="yes")
    surface = formats.read(tmp_path / "a.tif")
    np.testing.assert_array_equal(surface.mask, alpha > 0)
    assert surface.attributes == {}


@pytest.mark.parametrize("dtype", DTYPES)
def test_every_type_comes_back(tmp_path: Path, dtype: str) -> None:
    heights = hills(dtype, (300, 280))
    metadata = {"crs": utm(), "geotransform": PLACE, "unit": "ft", "scale": 0.1, "offset": -5.0, "name": "b"}
    metadata["area_or_point"] = "Area"  # as GDAL says of what does not say otherwise
    formats.write(Surface(heights, metadata=metadata), tmp_path / "b.tif")
    surface = formats.read(tmp_path / "b.tif")
    assert (surface.dtype, surface.points.tobytes()) == (heights.dtype, heights.tobytes())
    assert surface.metadata == metadata | {"format": "geotiff"}
    with opened(tmp_path / "b.tif") as dataset:
        assert dataset.crs == rasterio.crs.CRS.from_epsg(32611)
        assert list(dataset.transform.to_gdal()) == PLACE


def test_attributes_are_bands(tmp_path: Path) -> None:
    heights, colour = hills(), np.random.default_rng(1).integers(0, 256, (6, 9, 3)).astype(np.uint8)
    depth = np.linspace(0, 1, 54).reshape(6, 9).astype(np.float32)
    surface = Surface(heights, attributes={"colour": colour, "depth": depth})
    formats.write(surface, tmp_path / "a.tif")
    with opened(tmp_path / "a.tif") as dataset:
        assert dataset.descriptions == (None, "colour_0", "colour_1", "colour_2", "depth")
        assert set(dataset.dtypes) == {"float32"}
    back = formats.read(tmp_path / "a.tif")
    np.testing.assert_array_equal(back.points, heights)
    np.testing.assert_array_equal(back.attributes["colour_1"], colour[..., 1])
    np.testing.assert_array_equal(back.attributes["depth"], depth)
    wide = Surface(heights, attributes={"id": np.full((6, 9), 2**60 + 1), "depth": depth})
    with pytest.warns(FormatWarning, match="one type for all bands: id are rounded to float64"):
        formats.write(wide, tmp_path / "b.tif")


def test_holes_without_a_value_for_them_are_nan_or_a_mask(tmp_path: Path) -> None:
    mask = hills() % 4 > 0
    for dtype, nodata, expected in (("float64", None, "nan"), ("int32", None, "None"), ("uint8", -9999, "None")):
        metadata = {} if nodata is None else {"nodata": nodata}
        formats.write(Surface(hills(dtype), mask=mask, metadata=metadata), tmp_path / "a.tif")
        with opened(tmp_path / "a.tif") as dataset:
            assert str(dataset.nodata) == expected
            np.testing.assert_array_equal(dataset.read_masks(1) > 0, mask)
    taken = Surface(hills(), mask=mask, metadata={"nodata": int(hills()[mask][0])})
    formats.write(taken, tmp_path / "a.tif")
    np.testing.assert_array_equal(formats.read(tmp_path / "a.tif").mask, mask)


def test_xyz_over_an_even_lattice_is_written_as_heights(tmp_path: Path) -> None:
    points = to_xyz(Surface(hills(np.float64), metadata={"geotransform": PLACE})).points
    formats.write(Surface(points, metadata={"crs": utm()}), tmp_path / "a.tif")
    surface = formats.read(tmp_path / "a.tif")
    assert surface.metadata["geotransform"] == PLACE
    np.testing.assert_array_equal(surface.points, points[..., 2])
    points[2, 2, 0] += 1
    for surface, message in (
        (Surface(points), "heights on an even grid for GeoTIFF, got x, y, z that are not"),
        (Surface(points[..., :2]), "got planar points that are not"),
        (Surface(blocks=[Block(hills()), Block(hills())]), "one block for geotiff, got 2"),
    ):
        with pytest.raises(FormatError, match=message):
            formats.write(surface, tmp_path / "b.tif")
    assert not (tmp_path / "b.tif").exists()


def test_what_a_geotiff_cannot_say_is_said(tmp_path: Path) -> None:
    with pytest.warns(FormatWarning, match="GeoTIFF cannot express closed axes"):
        formats.write(Surface(hills(), (False, True)), tmp_path / "a.tif")
    with pytest.warns(FormatWarning, match=r"evenly spaced rows and columns: x changes by up to 2\.62"):
        formats.write(Surface(hills(), metadata={"nodes": [None, [*range(8), 11]]}), tmp_path / "a.tif")
    with pytest.warns(FormatWarning, match="the CRS is left out, which GDAL does not know"):
        formats.write(Surface(hills(), metadata={"crs": "somewhere"}), tmp_path / "a.tif")


def test_a_raster_of_the_whole_earth_is_closed_and_its_seam_comes_back(tmp_path: Path) -> None:
    heights = hills(np.int16, (9, 36))
    world = {"crs": "EPSG:4326", "transform": rasterio.Affine(10.0, 0.0, -180.0, 0.0, -20.0, 90.0)}
    write_tiff(tmp_path / "cells.tif", heights[None], **world)
    assert formats.read(tmp_path / "cells.tif").closed == (False, True)
    assert formats.read(tmp_path / "cells.tif", closed="none").closed == (False, False)
    around = np.concatenate((heights, heights[:, :1]), axis=1)
    write_tiff(tmp_path / "points.tif", around[None], **world)
    surface = formats.read(tmp_path / "points.tif")
    assert (surface.shape, surface.closed, surface.metadata["seam"]) == ((9, 36), (False, True), "cols")
    formats.write(surface, tmp_path / "back.tif")
    with opened(tmp_path / "back.tif") as dataset:
        np.testing.assert_array_equal(dataset.read(1), around)
    write_tiff(tmp_path / "part.tif", heights[None, :, :30], **world)
    assert formats.read(tmp_path / "part.tif").closed == (False, False)
    write_tiff(tmp_path / "metres.tif", heights[None], **(world | {"crs": "EPSG:32611"}))
    assert formats.read(tmp_path / "metres.tif").closed == (False, False)


GRID = "NCOLS 3\nnrows 2\n{corner}cellsize 10\nNODATA_value {nodata}\n1.5 2 {nodata}\n-4 1e2 0.1\n"


@pytest.mark.parametrize("nodata", ["-9999", "7", "1e38"])
@pytest.mark.parametrize("word", ["corner", "center"])
def test_ascii_grids(tmp_path: Path, nodata: str, word: str) -> None:
    corner = f"xll{word} 100\nyll{word} 200\n"
    (tmp_path / "a.asc").write_text(GRID.format(corner=corner, nodata=nodata))
    surface = formats.read(tmp_path / "a.asc")
    assert surface.mask is not None
    assert surface.mask.tolist() == [[True, True, False], [True, True, True]]
    assert surface.points[surface.mask].tolist() == [1.5, 2.0, -4.0, 100.0, 0.1]
    half = 0 if word == "corner" else 5
    assert surface.metadata["geotransform"] == [100.0 - half, 10.0, 0.0, 220.0 - half, 0.0, -10.0]
    assert surface.metadata["format"] == "esri-ascii"
    assert msgpack.unpackb(msgpack.packb(surface.metadata)) == surface.metadata


def test_ascii_grids_know_nothing_of_files_beside_them(tmp_path: Path) -> None:
    (tmp_path / "a.asc").write_text(GRID.format(corner="xllcorner 0\nyllcorner 0\n", nodata="-1"))
    (tmp_path / "a.prj").write_text("Projection UTM\nZone 11\nDatum WGS84\nUnits METERS\n")
    (tmp_path / "a.asc.aux.xml").write_text("<PAMDataset><SRS>EPSG:32611</SRS></PAMDataset>")
    assert "crs" not in formats.read(tmp_path / "a.asc").metadata


def tile(folder: Path, name: str) -> Array:
    heights = (np.add.outer(np.arange(1201), np.arange(1201)) % 3000).astype(">i2")
    heights[:3, 4:9] = -32768
    heights.tofile(folder / name)
    return heights


def test_an_srtm_tile_lies_where_its_name_says(tmp_path: Path) -> None:
    heights = tile(tmp_path, "s07w122.hgt")
    surface = formats.read(tmp_path / "s07w122.hgt")
    assert surface.mask is not None
    np.testing.assert_array_equal(surface.mask, heights != -32768)
    np.testing.assert_array_equal(surface.points[surface.mask], heights[surface.mask])
    x, y = coordinates(surface)
    assert (x[0, 0], x[0, -1]) == pytest.approx((-122, -121))
    assert (y[0, 0], y[-1, 0]) == pytest.approx((-6, -7))
    assert "WGS 84" in surface.metadata["crs"]
    elsewhere = formats.read(tmp_path / "s07w122.hgt", tile="N10E020")
    assert elsewhere.metadata["geotransform"][0] == pytest.approx(20, abs=1e-3)
    (tmp_path / "s07w122.hgt").rename(tmp_path / "upload")
    assert formats.read(tmp_path / "upload", filename="S07W122.SRTMGL3.hgt").metadata == surface.metadata | {
        "name": "S07W122.SRTMGL3"
    }
    with pytest.warns(FormatWarning, match="the name of an SRTM tile gives its position, but this one does not"):
        nowhere = formats.read(tmp_path / "upload", filename="hill.hgt")
    assert not {"geotransform", "crs"} & set(nowhere.metadata)
    np.testing.assert_array_equal(nowhere.points, surface.points)
    with pytest.raises(OptionError, match="tile= a corner such as N37W122, got 'home'"):
        formats.read(tmp_path / "upload", filename="hill.hgt", tile="home")


def test_what_a_name_tells_counts_as_an_option() -> None:
    named = {row.name: row.named for row in formats.formats() if row.named}
    assert named["srtm-hgt"]("n37w122.SRTMGL1.hgt") == {"tile": "N37W122"}
    assert named["srtm-hgt"]("hill.hgt") == {}
    assert named["png"]("my_terrarium-12.png") == {"encoding": "terrarium"}
    assert named["png"]("tile.terrainrgb.png") == {"encoding": "terrain-rgb"}
    assert named["png"]("fuji.png") == {}


def test_geotiff_goes_through_a_pipe() -> None:
    class Pipe(io.RawIOBase):
        def __init__(self) -> None:
            self.content = bytearray()

        def writable(self) -> bool:
            return True

        def write(self, data: Any) -> int:
            self.content += data
            return len(data)

    pipe: Any = Pipe()
    for name in ("geotiff", "png"):
        pipe.content.clear()
        formats.write_stream(Surface(hills(np.uint16)), name, pipe)
        assert len(pipe.content) > 100
