"""Formats for height fields that GIS and numpy read: what is written comes back, and what is left out is said."""

from __future__ import annotations

import io
import re
import tempfile
import warnings
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from lodestream import formats
from lodestream.errors import FormatError, FormatWarning, InputError, TooLargeError
from lodestream.formats.raster import cog, geotiff
from lodestream.surface import Block, Surface

rasterio = pytest.importorskip("rasterio")

PLACE = [500000.0, 30.0, 0.0, 4100000.0, 0.0, -30.0]


def hills(dtype: Any = np.float32, shape: tuple[int, int] = (6, 9)) -> NDArray[Any]:
    return (np.arange(shape[0] * shape[1]).reshape(shape) * 7 % 101 + 1).astype(dtype)


def with_hole(dtype: Any, shape: tuple[int, int] = (6, 9), **metadata: Any) -> Surface:
    mask = np.ones(shape, np.bool_)
    mask[2, 3:5] = False
    return Surface(hills(dtype, shape), mask=mask, metadata={"geotransform": PLACE, **metadata})


def utm() -> str:
    return str(rasterio.crs.CRS.from_epsg(32611).to_wkt())


@pytest.mark.parametrize("dtype", ["uint8", "int16", "int32", "int64", "float32", "float64"])
@pytest.mark.long
def test_a_cog_is_a_geotiff_with_overviews(tmp_path: Path, dtype: str) -> None:
    surface = with_hole(dtype, (700, 600), crs=utm(), unit="m", tags={"": {"SURVEY": "1996"}})
    surface.blocks[0].attributes["depth"] = hills(dtype, (700, 600)) // 2
    for name in ("a.cog.tif", "a.COG.TIFF", "a.tif"):
        formats.write(surface, tmp_path / name)
        with rasterio.open(tmp_path / name) as dataset:
            assert (dataset.tags(ns="IMAGE_STRUCTURE").get("LAYOUT") == "COG") == (name != "a.tif")
            assert [dataset.overviews(band) for band in (1, 2)] == ([[2]] * 2 if name != "a.tif" else [[], []])
    one, other = formats.read(tmp_path / "a.cog.tif"), formats.read(tmp_path / "a.tif")
    assert one.mask is not None
    np.testing.assert_array_equal(one.mask, surface.mask)
    np.testing.assert_array_equal(one.points[one.mask], surface.points[one.mask])
    np.testing.assert_array_equal(one.attributes["depth"], surface.attributes["depth"])
    assert {**one.metadata, "name": ""} == {**other.metadata, "name": ""}
    assert sorted(path.name for path in tmp_path.iterdir()) == ["a.COG.TIFF", "a.cog.tif", "a.tif"]


def test_overviews_are_means_without_holes(tmp_path: Path) -> None:
    heights = np.full((600, 600), 10.0, np.float32)
    heights[1::2] = 20
    mask = np.ones(heights.shape, np.bool_)
    mask[:100] = False
    formats.write(
        Surface(heights, mask=mask, metadata={"nodata": -9999, "geotransform": PLACE}), tmp_path / "a.cog.tif"
    )
    with rasterio.open(tmp_path / "a.cog.tif", overview_level=0) as dataset:
        coarse, valid = dataset.read(1), dataset.read_masks(1) > 0
    np.testing.assert_array_equal(valid, mask[::2, ::2])
    assert (coarse[valid] == 15).all()


def test_a_format_has_the_names_of_its_suffixes() -> None:
    assert formats.written("tif") is formats.written("tiff") is formats.written("geotiff")
    assert formats.for_writing("a.b.cog.tif").name == "cog"
    assert formats.for_writing("cog.tif").name == "geotiff"


def read_back(surface: Surface, path: Path, **options: Any) -> Surface:
    formats.write(surface, path)
    return formats.read(path, **options)


def same(back: Surface, surface: Surface) -> None:
    """The points that are no holes are equal, and so are the holes."""
    assert (back.mask is None) == (surface.mask is None)
    valid = np.ones(surface.shape, np.bool_) if surface.mask is None else surface.mask
    if back.mask is not None:
        np.testing.assert_array_equal(back.mask, valid)
    np.testing.assert_array_equal(back.points[valid].astype(surface.dtype), surface.points[valid])


@pytest.mark.parametrize("dtype", ["uint8", "int16", "int64", "float32", "float64"])
@pytest.mark.parametrize("suffix", ["asc", "npz", "nc"])
def test_heights_come_back_with_place_and_holes(tmp_path: Path, suffix: str, dtype: str) -> None:
    surface = with_hole(dtype)
    if surface.dtype.kind == "f":
        surface.points[:] = surface.points / 7
    back = read_back(surface, tmp_path / f"a.{suffix}")
    same(back, surface)
    assert back.metadata["geotransform"] == PLACE
    if suffix != "asc":  # text has no type
        assert back.dtype == surface.dtype


def test_other_programs_read_an_ascii_grid_where_it_lies(tmp_path: Path) -> None:
    mask = np.ones((6, 9), np.bool_)
    mask[0, 0] = False
    # Rows from south to north and columns from east to west, as a grid may have them.
    heights = hills(np.int32)
    heights[5, 5] = -9999  # which is taken, so that holes need another number
    surface = Surface(heights, mask=mask, metadata={"geotransform": [770.0, -30.0, 0.0, 100.0, 0.0, 30.0]})
    formats.write(surface, tmp_path / "a.asc")
    with rasterio.open(tmp_path / "a.asc") as dataset:
        assert list(dataset.transform.to_gdal()) == [500.0, 30.0, 0.0, 280.0, 0.0, -30.0]
        assert dataset.nodata == -99999
        np.testing.assert_array_equal(dataset.read(1)[::-1, ::-1][mask], heights[mask])
    assert (tmp_path / "a.asc").read_text().splitlines()[:5] == [
        *("ncols 9", "nrows 6", "xllcorner 500.0", "yllcorner 100.0", "cellsize 30.0")
    ]


@pytest.mark.parametrize(
    ("transform", "note"),
    [
        ([0, 30, 1, 0, 1, -30], "without its place, since the grid is rotated"),
        ([0, 30, 0, 0, 0, -20], "with dx and dy"),
    ],
)
def test_what_an_ascii_grid_cannot_say_is_said(tmp_path: Path, transform: list[float], note: str) -> None:
    surface = Surface(hills(), metadata={"geotransform": transform})
    with pytest.warns(FormatWarning, match=note):
        back = read_back(surface, tmp_path / "a.asc")
    # Without a place y is the row, and text goes from north to south.
    np.testing.assert_array_equal(back.points[:: -1 if "rotated" in note else 1].astype(np.float32), surface.points)
    with pytest.warns(FormatWarning, match="without depth, closure, unit"):
        formats.write(
            Surface(hills(), (True, False), attributes={"depth": hills()}, metadata={"unit": "m"}), tmp_path / "b.asc"
        )


def test_numpy_reads_each_array_of_an_npz(tmp_path: Path) -> None:
    surface = with_hole(np.float32, unit="m", crs=utm())
    surface.blocks[0].attributes.update({"flow": np.ones((6, 9, 2)), "x": hills(), "../up": hills()})
    with pytest.warns(FormatWarning, match="attribute x as x_, ../up as __up"):
        formats.write(surface, tmp_path / "a.npz")
    with np.load(tmp_path / "a.npz") as arrays:
        assert set(arrays) == {"heights", "mask", "x", "y", "crs", "unit", "flow", "x_", "__up"}
        np.testing.assert_array_equal(arrays["x"], 500015 + 30.0 * np.arange(9))
        np.testing.assert_array_equal(arrays["mask"], surface.mask)
        assert np.isnan(arrays["heights"][2, 3])
        assert str(arrays["unit"]) == "m"
    back = formats.read(tmp_path / "a.npz")
    same(back, surface)
    assert {key: back.metadata[key] for key in ("unit", "crs")} == {"unit": "m", "crs": utm()}
    assert set(back.attributes) == {"flow", "x_", "__up"}
    np.testing.assert_array_equal(back.attributes["flow"], np.ones((6, 9, 2)))


def test_arrays_beside_ours_are_attributes_and_beside_others_are_not(tmp_path: Path) -> None:
    arrays: dict[str, Any] = {"slope": hills(), "kind": np.ones((6, 9), "u1"), "other": np.ones((9, 6))}
    np.savez(tmp_path / "ours.npz", heights=hills(), **arrays)
    with pytest.warns(FormatWarning, match="left out arrays of the archive: other"):
        assert set(formats.read(tmp_path / "ours.npz").attributes) == {"slope", "kind"}
    np.savez(tmp_path / "theirs.npz", z=hills(), **arrays)
    with pytest.warns(FormatWarning, match="left out arrays of the archive: slope, kind, other"):
        assert formats.read(tmp_path / "theirs.npz", array="z").attributes == {}


def test_attributes_of_an_npz_together_are_limited(tmp_path: Path) -> None:
    arrays: dict[str, Any] = {f"a{number}": np.zeros((6, 9, 1000), "u1") for number in range(70)}
    np.savez_compressed(tmp_path / "a.npz", heights=hills(), **arrays)
    with pytest.raises(TooLargeError, match="values for each vertex"):
        formats.read(tmp_path / "a.npz", max_vertices=54)


@pytest.mark.parametrize("channels", [2, 3, 4])
@pytest.mark.parametrize("suffix", ["npz", "nc"])
def test_points_that_are_no_heights_come_back(tmp_path: Path, suffix: str, channels: int) -> None:
    x, y = np.meshgrid(np.arange(9.0) ** 1.5, np.arange(6.0) ** 1.2)
    points = np.stack((x + y, y - x, hills(np.float64), x * y)[:channels], axis=-1)
    mask = np.ones((6, 9), np.bool_)
    mask[2, 3] = False
    surface = Surface(points, mask=mask)
    options = {"attributes": "attribute_0"} if (suffix, channels) == ("nc", 4) else {}
    back = read_back(surface, tmp_path / f"a.{suffix}", **options)
    kept = back.points.shape[2]
    same(back, Surface(points[..., :kept], mask=mask))
    if kept < channels:
        np.testing.assert_array_equal(back.attributes["attribute_0"][mask], points[..., 3][mask])


def test_gdal_and_xarray_read_a_netcdf_by_the_conventions(tmp_path: Path) -> None:
    xarray = pytest.importorskip("xarray")
    place = [10.0, 0.01, 0.0, 45.0, 0.0, -0.01]
    wkt = rasterio.crs.CRS.from_epsg(4326).to_wkt()
    tags = {"": {"NC_GLOBAL#history": "made", "depth#long_name": "depth of the sea", "NAMELESS": "x"}}
    surface = with_hole(np.float32, crs=wkt, unit="m", variable="depth", tags=tags)
    surface.metadata["geotransform"] = place
    surface.blocks[0].attributes["quality flag"] = hills(np.int8)
    with pytest.warns(FormatWarning) as notes:
        formats.write(surface, tmp_path / "a.nc")
    assert [str(note.message) for note in notes] == ["NetCDF is written with quality flag as quality_flag"]
    with xarray.open_dataset(tmp_path / "a.nc", engine="h5netcdf", decode_coords="all") as dataset:
        assert dataset.attrs["history"] == "made"
        depth = dataset["depth"]
        assert (depth.dims, depth.attrs["units"], depth.attrs["long_name"]) == (("y", "x"), "m", "depth of the sea")
        assert set(depth.coords) == {"y", "x", "spatial_ref"}
        assert dataset["x"].attrs["standard_name"] == "longitude"
        np.testing.assert_array_equal(np.isnan(depth.values), ~np.asarray(surface.mask))
        assert dataset["quality_flag"].dtype == np.int8
    with rasterio.open(f"netcdf:{tmp_path / 'a.nc'}:depth") as dataset:
        np.testing.assert_allclose(dataset.transform.to_gdal(), place, rtol=1e-12)
        assert dataset.crs.to_epsg() == 4326
        np.testing.assert_array_equal(dataset.read_masks(1) > 0, surface.mask)
    back = formats.read(tmp_path / "a.nc")
    same(back, surface)
    assert back.metadata["tags"][""] == tags[""]
    np.testing.assert_array_equal(back.attributes["quality flag"], hills(np.int8))


def test_integers_that_are_every_number_keep_their_holes(tmp_path: Path) -> None:
    mask = np.ones((16, 17), np.bool_)
    mask[:, 16] = False
    full = np.zeros((16, 17), np.uint8)
    full[:, :16] = np.arange(256).reshape(16, 16)
    for suffix in ("npz", "nc"):  # of which the latter has them as floating-point numbers
        back = read_back(Surface(full, mask=mask), tmp_path / f"a.{suffix}")
        np.testing.assert_array_equal(back.mask, mask)
        np.testing.assert_array_equal(back.points[mask], full[mask])


@pytest.mark.parametrize("suffix", ["asc", "npz", "nc", "cog.tif"])
def test_what_is_in_the_way_leaves_no_file(tmp_path: Path, suffix: str) -> None:
    blocks = [Block(hills()), Block(hills())]
    with pytest.raises(FormatError, match="expected one block"):
        formats.write(Surface(blocks=blocks), tmp_path / f"a.{suffix}")
    if suffix in ("asc", "cog.tif"):
        with pytest.raises(FormatError, match="expected heights on an even grid"):
            formats.write(Surface(np.random.default_rng(1).normal(size=(6, 9, 3))), tmp_path / f"a.{suffix}")
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize(
    "metadata",
    [
        {"grid": [["a", "b"], [1, 2]]},
        {"grid": 1.5},
        {"grid": [[0, 1], [0, 1]], "nodes": [None, ["x"] * 9]},
        {"grid": [[0, 1], [0, 1]], "nodes": [None]},
        {"grid": [[0, 1], [0, 1]], "angles": [{"channel": 0}]},
        {"axes": {"x": [0, 1], "y": [0, 1], "dtype": "no type"}},
    ],
)
@pytest.mark.parametrize("kind", ["npz", "cog", "netcdf", "esri-ascii", "plot3d", "vtm"])
@pytest.mark.filterwarnings("ignore:.*assumes evenly spaced:lodestream.errors.FormatWarning")
def test_metadata_that_are_no_rules_are_refused(kind: str, metadata: dict[str, Any]) -> None:
    with pytest.raises(InputError, match=r"expected .* in the metadata, got"):
        formats.write_stream(Surface(hills(), metadata=metadata), kind, io.BytesIO())


@pytest.mark.parametrize(
    ("dtype", "nodata", "written"),
    [
        ("int16", -32768, "-32768"),
        ("int16", -32768.0, "-32768"),
        ("int16", -0.5, None),  # it would make floats of all
        ("float32", -9999.5, "-9999.5"),
        ("int16", 8, None),  # a height
        ("int16", True, None),
    ],
)
def test_an_ascii_grid_without_holes_has_its_nodata(
    tmp_path: Path, dtype: str, nodata: Any, written: str | None
) -> None:
    surface = Surface(hills(dtype), metadata={"geotransform": PLACE, "nodata": nodata})
    formats.write(surface, tmp_path / "a.asc")
    found = re.findall(r"NODATA_value (\S+)", (tmp_path / "a.asc").read_text())
    assert found == ([] if written is None else [written])
    back = formats.read(tmp_path / "a.asc")
    assert back.metadata.get("nodata") == (None if written is None else nodata)
    np.testing.assert_array_equal(back.points, surface.points)


@pytest.mark.parametrize("nodata", ["none", b"-9999", [1], True, float("inf")])
@pytest.mark.parametrize("kind", ["cog", "netcdf", "esri-ascii"])
@pytest.mark.filterwarnings("ignore:NetCDF is written without nodata, which JSON cannot hold:lodestream.FormatWarning")
def test_nodata_that_is_no_number_is_passed_over(tmp_path: Path, kind: str, nodata: Any) -> None:
    surface = with_hole(np.int32, nodata=nodata)
    with (tmp_path / "a").open("wb") as file:
        formats.write_stream(surface, kind, file)
    same(formats.read(tmp_path / "a"), surface)


def test_single_numbers_that_are_left_out_are_not_taken_for_an_attribute(tmp_path: Path) -> None:
    surface = Surface(hills(), attributes={"scalars": hills()}, metadata={"scalars": {"mach": 0.5, "alpha": 2.0}})
    with pytest.warns(FormatWarning, match="without single numbers .scalars: mach, alpha., which"):
        formats.write(surface, tmp_path / "a.npz")
    assert set(formats.read(tmp_path / "a.npz").attributes) == {"scalars"}


@pytest.mark.parametrize("suffix", ["cog.tif", "tif"])
def test_a_south_up_raster_stays_one_with_each_value_at_its_place(tmp_path: Path, suffix: str) -> None:
    surface = Surface(hills(shape=(600, 700)), metadata={"geotransform": [*PLACE[:5], 30.0], "crs": utm()})
    formats.write(surface, tmp_path / f"a.{suffix}")
    with rasterio.open(tmp_path / f"a.{suffix}") as dataset:
        assert list(dataset.transform.to_gdal()) == [*PLACE[:5], 30.0]
        np.testing.assert_array_equal(dataset.read(1), surface.points)
        x, y = PLACE[0] + 30 * 3.5, PLACE[3] + 30 * 500.5
        assert next(dataset.sample([(x, y)])).tolist() == [surface.points[500, 3]]
    back = formats.read(tmp_path / f"a.{suffix}")
    assert back.metadata["geotransform"] == [*PLACE[:5], 30.0]
    np.testing.assert_array_equal(back.points, surface.points)


@pytest.mark.parametrize("names", [("x", "y"), ("lon", "Latitude"), ("heights", "points")])
@pytest.mark.parametrize("width", [0, 3])
def test_attributes_with_the_names_of_coordinates_stay_attributes_in_npz(
    tmp_path: Path, names: tuple[str, str], width: int
) -> None:
    rows, columns = np.mgrid[0:5.0, 0:6.0]
    heights = rows * columns
    points = np.stack((columns, rows, heights), axis=-1) if width else heights
    attributes = {name: (heights + number).astype("f4") for number, name in enumerate(names)}
    with pytest.warns(FormatWarning, match="with the attribute"):
        formats.write(Surface(points, attributes=attributes), tmp_path / "a.npz")
    again = formats.read(tmp_path / "a.npz")
    assert np.array_equal(again.points, points)
    assert list(again.attributes) == [f"{name}_" for name in names]
    for name, values in attributes.items():
        assert np.array_equal(again.attributes[f"{name}_"], values)


@pytest.mark.parametrize("shown", ["values", "mask", "nothing"])
def test_what_gdal_has_not_written_is_told_and_what_was_there_is_kept(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, shown: str
) -> None:
    """GDAL's threads tell nobody that a disk is full, so the file is read again."""

    def spoilt(path: Path, predictor: int) -> Path:
        if shown == "nothing":
            path.write_bytes(path.read_bytes()[:100])
            return path
        with rasterio.Env(GDAL_TIFF_INTERNAL_MASK=True), rasterio.open(path, "r+") as dataset:
            if shown == "values":
                dataset.write(dataset.read(1, window=((0, 1), (0, 9))) + np.uint8(1), 1, window=((0, 1), (0, 9)))
            else:
                dataset.write_mask(np.ones((30, 9), np.bool_))
        return path

    # Every number of its type, so that a mask says where holes are.
    points = np.arange(270).reshape(30, 9).astype(np.uint8)
    surface = Surface(points, mask=points != 7)
    monkeypatch.setattr(cog, "_optimised", spoilt)
    path = tmp_path / "a.cog.tif"
    path.write_bytes(b"of yesterday")
    with pytest.raises(OSError, match="GDAL has not written the whole file: "):
        formats.write(surface, path)
    assert path.read_bytes() == b"of yesterday"
    assert [found.name for found in tmp_path.iterdir()] == [path.name]


@pytest.mark.parametrize("suffix", [".tif", ".cog.tif", ".nc"])
def test_what_is_made_first_lies_on_the_disk_of_the_file(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, suffix: str
) -> None:
    made: list[str] = []
    folder = tempfile.TemporaryDirectory

    def noted(**options: Any) -> Any:
        made.append(str(options.get("dir")))
        return folder(**options)

    monkeypatch.setattr(tempfile, "TemporaryDirectory", noted)
    formats.write(Surface(hills()), tmp_path / f"a{suffix}")
    assert made == [str(tmp_path)]
    made.clear()
    formats.write_stream(Surface(hills()), suffix[1:], io.BytesIO())
    assert made == ["None"]
    assert [found.name for found in tmp_path.iterdir()] == [f"a{suffix}"]


@pytest.mark.parametrize("suffix", [".tif", ".cog.tif"])
@pytest.mark.parametrize(
    ("dtype", "nodata"), [("int64", 2**63 - 1), ("int64", -(2**63)), ("uint64", 2**64 - 1), ("int64", 2**53 + 1)]
)
def test_nodata_that_gdal_is_not_told_exactly_is_a_mask(tmp_path: Path, dtype: str, nodata: int, suffix: str) -> None:
    surface = with_hole(dtype, nodata=nodata)
    formats.write(surface, tmp_path / f"a{suffix}")
    found = formats.read(tmp_path / f"a{suffix}")
    assert surface.mask is not None
    assert found.mask is not None
    assert np.array_equal(found.mask, surface.mask)
    assert np.array_equal(found.points[surface.mask], surface.points[surface.mask])


def test_bands_of_several_types_are_joined_strip_by_strip(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(geotiff, "_AT_ONCE", 256 * 40)
    heights, far = hills(np.int16, (700, 40)), np.full((700, 40), 2**53, np.int64)
    surface = Surface(heights, mask=heights != 5, attributes={"far": far, "part": hills(np.float32, (700, 40)) / 3})
    formats.write(surface, tmp_path / "a.tif")
    found = formats.read(tmp_path / "a.tif")
    assert found.mask is not None
    assert np.array_equal(found.mask, heights != 5)
    assert np.array_equal(found.points[found.mask], heights[found.mask])
    assert np.array_equal(found.attributes["far"], far)
    assert np.array_equal(found.attributes["part"], surface.attributes["part"])
    far[699, 3] += 1
    with pytest.warns(FormatWarning, match="one type for all bands: far are rounded to float64"):
        formats.write(surface, tmp_path / "a.tif")


@pytest.mark.parametrize(
    ("crs", "notes"),
    [
        (4326, []),
        (32611, []),
        # Longitudes first, which GDAL turns round for all rasters.
        ("OGC:CRS84", ["GeoTIFF has the CRS as GDAL spells it, with other names or axes, and the same parameters"]),
        ("+proj=stere +lat_0=90 +lat_ts=70 +lon_0=-45 +a=6378273 +rf=298.28 +units=m", None),
    ],
)
def test_a_crs_that_gdal_spells_otherwise_is_written_with_a_note_that_says_so(
    tmp_path: Path, crs: int | str, notes: list[str] | None
) -> None:
    pyproj = pytest.importorskip("pyproj")
    system = pyproj.CRS.from_user_input(crs)
    wkt = system.to_wkt().replace("WGS 84 (CRS84)", "undefined").replace('ID["OGC","CRS84"]', 'ID["X","1"]')
    surface = Surface(hills(np.float32), metadata={"crs": wkt, "geotransform": [10.0, 0.5, 0.0, 45.0, 0.0, -0.5]})
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        formats.write(surface, tmp_path / "a.tif")
    words = [str(note.message) for note in caught]
    assert words == notes if notes is not None else all("as GDAL spells it" in text for text in words)
    with rasterio.open(tmp_path / "a.tif") as raster:
        assert raster.crs.to_dict() == rasterio.crs.CRS.from_wkt(wkt).to_dict()
