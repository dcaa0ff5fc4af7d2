"""The gridded files of ../shared/data: read as their README says, streamed bit for bit, written for others to read."""

from __future__ import annotations

import functools
import warnings
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import msgpack
import numpy as np
import pytest
from numpy.typing import NDArray

import lodestream as ls
from lodestream import formats
from lodestream.coordinates.height_fields import coordinates, to_xyz
from lodestream.coordinates.seams import restore
from lodestream.encoding.lattice_coordinates import lattice_coordinates
from lodestream.encoding.prepared import prepare
from lodestream.errors import FormatError, FormatWarning
from lodestream.surface import Surface

DATA = Path(__file__).parents[3] / "shared" / "data"

#: Some of these files have more variables than the one that is read.
pytestmark = pytest.mark.filterwarnings("ignore:left out:lodestream.errors.FormatWarning")

Array = NDArray[Any]


@dataclass(frozen=True)
class Row:
    """What the README says of a file, and what follows from it.

    Attributes
    ----------
    shape : (rows, columns)
        README has columns x rows. Of the stored grid: a merged seam counts once.
    channels : int
        1 for heights.
    span : (float, float)
        Least and greatest height, or last coordinate.
    """

    files: tuple[str, ...]
    shape: tuple[int, int]
    dtype: str
    channels: int = 1
    closed: tuple[bool, bool] = (False, False)
    holes: int = 0
    options: dict[str, Any] = field(default_factory=dict)
    metadata: dict[str, Any] = field(default_factory=dict)
    span: tuple[float, float] | None = None


NCSX = tuple(f"NCSX_surface_{letter}.dat" for letter in "XYZ")
BIJOU = "bijou_gully_subset_5m_edit_dx_filled.asc"

ROWS = [
    Row(("bigtujunga.tif",), (643, 1197), "int16", metadata={"nodata": 32767}, span=(315, 2295)),
    Row(("SainteHelens.dem",), (468, 327), "int16", holes=4151, metadata={"nodata": -32767, "unit": "m"}),
    Row(("lidar_dsm_2m.tif",), (259, 283), "float32", metadata={"nodata": -9999}),
    Row((BIJOU,), (77, 105), "float64"),
    Row(("jacksboro_fault_dem.npz",), (344, 403), "int16"),
    Row(("topobathy.npz",), (91, 120), "float32", 1),
    Row(("fuji.png",), (512, 512), "float64", options={"encoding": "terrain-rgb"}, span=(13.7, 3751.0)),
    Row(("terrarium_tile.png",), (256, 256), "float32", span=(715, 2489)),
    Row(("gcanyon_elev_crop.bw.png",), (1200, 1200), "uint8"),
    Row(("etopo20.cdf",), (540, 1080), "float32", closed=(False, True), metadata={"seam": "cols"}, span=(-9026, 6229)),
    Row(("orca2_votemper.nc",), (148, 180), "float64", 3, (False, True), 10209, metadata={"dtype": "float32"}),
    Row(("ccsm_popgrid.nc",), (116, 100), "float64", 3, (False, True), 3697, metadata={"dtype": "float32"}),
    Row(
        ("cbm18_dens8.grid_nx68ny64.nc",),
        (68, 64),
        "float64",
        2,
        (False, True),
        options={"x": "Rxy", "y": "Zxy", "attributes": "psixy,pressure"},
    ),
    Row(NCSX, (33, 21), "float64", 3, (True, True), options={"closed": "both"}),
    Row(("wout_li383_low_res_reference.nc",), (64, 256), "float64", 3, (True, True)),
]
names = [row.files[0] for row in ROWS]
rows = pytest.mark.parametrize("row", ROWS, ids=names)


def needed(row: Row) -> None:
    """Skip the test where the files are not there."""
    for name in row.files:
        if not (DATA / name).exists():
            pytest.skip(f"the real file {name} is not beside this project")


def read(row: Row, **options: Any) -> Surface:
    needed(row)
    for suffix, library in ((".tif", "rasterio"), (".dem", "rasterio"), (".asc", "rasterio"), (".png", "PIL")):
        if row.files[0].endswith(suffix):
            pytest.importorskip(library)
    if row.files[0].endswith((".nc", ".cdf")):
        pytest.importorskip("xarray")
    return formats.read(*(DATA / name for name in row.files), **(row.options | options))


def of(name: str) -> Row:
    return next(row for row in ROWS if row.files[0] == name)


@functools.cache
def streamed(name: str) -> tuple[Surface, bytes]:
    """A file's surface, which some tests look at, and its container."""
    surface = read(of(name))
    return surface, ls.encode(surface)


def valid_of(surface: Surface) -> NDArray[np.bool_]:
    return np.ones(surface.shape, np.bool_) if surface.mask is None else surface.mask


@rows
def test_a_real_surface_is_read_as_its_readme_says(row: Row) -> None:
    surface = read(row)
    assert (surface.shape, surface.closed, surface.blocks[0].holes) == (row.shape, row.closed, row.holes)
    assert surface.dtype.name == row.dtype
    assert surface.points.ndim == (2 if row.channels == 1 else 3)
    assert row.channels == (1 if surface.points.ndim == 2 else surface.points.shape[2])
    assert {key: surface.metadata[key] for key in row.metadata} == row.metadata
    assert msgpack.unpackb(msgpack.packb(surface.metadata)) == surface.metadata
    if row.span is not None:
        heights = surface.points[valid_of(surface)]
        assert (float(heights.min()), float(heights.max())) == pytest.approx(row.span, abs=1)


@pytest.mark.sweep(5)
@rows
@pytest.mark.long
def test_a_real_surface_streams_bit_for_bit(row: Row) -> None:
    surface, container = streamed(row.files[0])
    back = ls.decode(container)
    valid = valid_of(surface)
    assert (back.shape, back.closed, back.dtype) == (surface.shape, surface.closed, surface.dtype)
    np.testing.assert_array_equal(valid_of(back), valid)
    assert back.points[valid].tobytes() == surface.points[valid].tobytes()
    assert back.attributes.keys() == surface.attributes.keys()
    for name, values in surface.attributes.items():
        assert back.attributes[name][valid].tobytes() == values[valid].tobytes()
    assert {key: back.metadata[key] for key in surface.metadata} == surface.metadata
    given, got = restore(surface), restore(back)
    assert (got.shape, got.dtype) == (given.shape, given.dtype)
    assert got.points[valid_of(got)].tobytes() == given.points[valid_of(given)].tobytes()


@pytest.mark.parametrize("name", ["topobathy.npz", BIJOU, "ccsm_popgrid.nc", NCSX[0], "SainteHelens.dem"])
def test_levels_of_small_surfaces_are_within_the_lattice_of_the_optimum_of_the_filled_grid(name: str) -> None:
    surface, container = streamed(name)
    decoder = ls.Decoder()
    decoder.feed(container)
    decoder.finish()
    prepared = prepare(surface, ls.Quality())
    assert decoder.header is not None
    for channel, lattice in enumerate(decoder.header.lattices):
        filled = lattice_coordinates(prepared, channel, lattice)[0]
        for number, optimum in enumerate(ls.hierarchy(filled, surface.closed)):
            level = decoder.surface(number)
            if level.mask is None and surface.mask is not None:
                continue  # no node of so coarse a level stands for a valid one
            values = level.points if level.points.ndim == 2 else level.points[..., channel]
            known = np.where(valid_of(level), values, values[valid_of(level)][0])
            away = np.abs(lattice.coordinates(known) - optimum)[valid_of(level)]
            assert values.shape == optimum.shape
            assert away.max() <= 5  # four steps, and one where values are rounded to their type


def test_the_seam_of_etopo_is_the_one_in_the_file(tmp_path: Path) -> None:
    xarray = pytest.importorskip("xarray")
    surface, container = streamed("etopo20.cdf")
    with xarray.open_dataset(DATA / "etopo20.cdf", engine="scipy", decode_cf=False) as dataset:
        heights, x, y = (dataset[name].values for name in ("ROSE", "ETOPO20X1_1081", "ETOPO20Y"))
    back = restore(ls.decode(container))
    assert (back.shape, back.closed) == ((540, 1081), (False, False))
    np.testing.assert_array_equal(back.points, heights)
    made = coordinates(back)
    np.testing.assert_array_equal(made[0], np.broadcast_to(x, heights.shape))
    np.testing.assert_array_equal(made[1], np.broadcast_to(y[:, None], heights.shape))
    with pytest.warns(
        FormatWarning, match="NPY is written without tags, unit, geotransform, axes, which it cannot hold"
    ):
        formats.write(surface, tmp_path / "a.npy")
    np.testing.assert_array_equal(np.load(tmp_path / "a.npy"), heights)


@pytest.mark.parametrize(
    ("name", "variables", "engine"),
    [
        ("orca2_votemper.nc", ("nav_lon", "nav_lat", "votemper"), "h5netcdf"),
        ("ccsm_popgrid.nc", ("TLONG", "TLAT", "TEMP"), "scipy"),
    ],
)
def test_longitudes_of_ocean_grids_come_back(name: str, variables: tuple[str, ...], engine: str) -> None:
    xarray = pytest.importorskip("xarray")
    surface, container = streamed(name)
    jumps = np.abs(np.diff(np.where(valid_of(surface), surface.points[..., 0], np.nan), axis=1)) > 180
    assert not jumps.any()
    back = restore(ls.decode(container))
    valid = valid_of(back)
    with xarray.open_dataset(DATA / name, engine=engine, decode_cf=False) as dataset:
        for channel, variable in enumerate(variables):
            values = dataset[variable].values
            np.testing.assert_array_equal(back.points[..., channel][valid], values[valid])
            assert back.dtype == values.dtype
    assert "angles" not in back.metadata


def test_coordinates_of_topobathy_are_the_vectors_in_the_file() -> None:
    surface = to_xyz(read(of("topobathy.npz")))
    with np.load(DATA / "topobathy.npz") as arrays:
        np.testing.assert_array_equal(surface.points[..., 0], np.broadcast_to(arrays["longitude"], (91, 120)))
        np.testing.assert_array_equal(surface.points[..., 1], np.broadcast_to(arrays["latitude"][:, None], (91, 120)))
        np.testing.assert_array_equal(surface.points[..., 2], arrays["topo"])


@pytest.mark.parametrize("name", ["bigtujunga.tif", "SainteHelens.dem", "lidar_dsm_2m.tif", BIJOU, "etopo20.cdf"])
@pytest.mark.filterwarnings("ignore:GeoTIFF is written without tag x#modulo:lodestream.errors.FormatWarning")
def test_another_library_finds_heights_holes_and_place(tmp_path: Path, name: str) -> None:
    rasterio = pytest.importorskip("rasterio")
    surface, container = streamed(name)
    formats.write(ls.decode(container), tmp_path / "a.tif")
    given = restore(surface)
    with rasterio.open(tmp_path / "a.tif") as dataset:
        heights = dataset.read(1)
        assert heights.dtype == given.dtype
        np.testing.assert_array_equal(dataset.read_masks(1) > 0, valid_of(given))
        np.testing.assert_array_equal(heights[valid_of(given)], given.points[valid_of(given)])
        assert list(dataset.transform.to_gdal()) == given.metadata["geotransform"]
        assert dataset.nodata == given.metadata.get("nodata")
        if "crs" in given.metadata:
            assert dataset.crs == rasterio.crs.CRS.from_wkt(given.metadata["crs"])
    if name.endswith((".tif", ".dem")):
        with rasterio.open(DATA / name) as dataset:
            np.testing.assert_array_equal(heights, dataset.read(1))


@pytest.mark.sweep(3)
@pytest.mark.parametrize("name", ["SainteHelens.dem", "lidar_dsm_2m.tif", BIJOU])
@pytest.mark.parametrize("dtype", ["float32", "float64"])
def test_heights_given_as_xyz_take_hardly_more_bytes(name: str, dtype: str) -> None:
    surface = read(of(name))
    heights = np.where(valid_of(surface), surface.points, np.nan).astype(dtype)
    points = to_xyz(Surface(heights, metadata=surface.metadata)).points.astype(dtype)
    plain, placed = (ls.encode(Surface(array)) for array in (heights, points))
    # The rules of x and y, and a layer more or less: errors are relative to another extent.
    assert len(placed) <= len(plain) + 160
    back = ls.decode(placed)
    assert back.dtype == points.dtype
    np.testing.assert_array_equal(back.points, points)


def test_a_level_of_real_heights_lies_where_the_surface_lies(tmp_path: Path) -> None:
    rasterio = pytest.importorskip("rasterio")
    decoder = ls.Decoder()
    decoder.feed(streamed("bigtujunga.tif")[1])
    decoder.finish()
    level = decoder.surface(5)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", FormatWarning)
        formats.write(level, tmp_path / "a.tif")
    with rasterio.open(tmp_path / "a.tif") as dataset, rasterio.open(DATA / "bigtujunga.tif") as whole:
        assert dataset.crs == whole.crs
        ends = [[image.xy(0, 0), image.xy(image.height - 1, image.width - 1)] for image in (dataset, whole)]
        np.testing.assert_allclose(ends[0], ends[1])


def test_colours_ask_what_they_stand_for() -> None:
    for name in ("fuji.png", "gcanyon_color.1024.png"):
        if not (DATA / name).exists():
            pytest.skip(f"the real file {name} is not beside this project")
        with pytest.raises(FormatError, match="give their meaning with encoding=terrain-rgb or encoding=terrarium"):
            formats.read(DATA / name)
