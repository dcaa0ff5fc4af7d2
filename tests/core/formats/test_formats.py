"""Files in and out: NPY, NPZ, GeoTIFF, and what all formats share."""

from __future__ import annotations

import io
import os
import subprocess
import sys
import tempfile
import warnings
from pathlib import Path
from typing import Any

import hypothesis.extra.numpy as npst
import msgpack
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray

from lodestream import encode, formats
from lodestream.errors import (
    Choice,
    ChoiceError,
    FormatError,
    FormatWarning,
    InputError,
    OptionError,
    SwitchedOffError,
    TooLargeError,
    UnavailableError,
)
from lodestream.surface import Surface

DATA = Path(__file__).parents[4] / "shared" / "data"
DTYPES = ["int8", "int16", "int32", "int64", "uint8", "uint16", "uint32", "uint64", "float32", "float64"]

shapes = st.tuples(st.integers(1, 9), st.integers(2, 9)).flatmap(
    lambda grid: st.sampled_from((grid, (*grid, 2), (*grid, 3), (*grid, 5)))
)
dtypes = st.builds(
    lambda name, order: np.dtype(name).newbyteorder(order), st.sampled_from(DTYPES), st.sampled_from("<>")
)
arrays = st.builds(lambda dtype, shape: (dtype, shape), dtypes, shapes).flatmap(
    lambda pair: npst.arrays(
        pair[0], pair[1], elements=npst.from_dtype(pair[0], allow_nan=False, allow_infinity=False, allow_subnormal=True)
    )
)


def data(name: str) -> Path:
    path = DATA / name
    if not path.exists():
        pytest.skip(f"the real file {name} is not beside this project")
    return path


def write_tiff(path: Path, bands: NDArray[Any], **profile: Any) -> None:
    """Write an array of shape (bands, H, W)."""
    rasterio = pytest.importorskip("rasterio")
    profile.setdefault("transform", rasterio.Affine(30.0, 0.0, 500.0, 0.0, -30.0, 900.0))
    profile |= {"count": bands.shape[0], "height": bands.shape[1], "width": bands.shape[2], "dtype": bands.dtype}
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", rasterio.errors.NotGeoreferencedWarning)
        with rasterio.open(path, "w", driver="GTiff", **profile) as dataset:
            dataset.write(bands)


@given(points=arrays, fortran=st.booleans())
def test_npy_of_numpy_is_read_as_it_is(points: NDArray[Any], fortran: bool) -> None:
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "grid.npy"
        np.save(path, np.asfortranarray(points) if fortran else points)
        surface = formats.read(path)
    assert surface.points.dtype == points.dtype.newbyteorder("=")
    np.testing.assert_array_equal(surface.points, points)
    assert surface.metadata == {"name": "grid", "format": "npy"}


@given(points=arrays)
def test_npy_that_is_written_is_read_by_numpy(points: NDArray[Any]) -> None:
    file = io.BytesIO()
    formats.write_stream(Surface(points), "npy", file)
    file.seek(0)
    read = np.load(file, allow_pickle=False)
    assert read.dtype == points.dtype.newbyteorder("=")
    np.testing.assert_array_equal(read, points)


@pytest.mark.parametrize("save", [np.savez, np.savez_compressed])
def test_npz_gives_its_only_surface_and_keeps_numbers_beside_it(tmp_path: Path, save: Any) -> None:
    heights = np.arange(12, dtype=np.int16).reshape(3, 4)
    save(tmp_path / "a.npz", x=np.arange(4.0), heights=heights, dx=0.5, zone=np.array([17]), note=np.array("metres"))
    with pytest.warns(FormatWarning, match="^left out arrays of the archive: x, note$"):
        surface = formats.read(tmp_path / "a.npz")
    np.testing.assert_array_equal(surface.points, heights)
    assert surface.points.dtype == np.int16
    assert surface.metadata == {"name": "a", "format": "npz", "scalars": {"dx": 0.5, "zone": 17}}


@pytest.mark.filterwarnings("ignore::lodestream.errors.FormatWarning")  # of what is left out
def test_npz_gives_heights_their_coordinates(tmp_path: Path) -> None:
    heights = np.arange(12.0).reshape(3, 4)
    x, y = np.array([1.5, 2.0, 2.5, 3.0]), np.array([8.0, 6.0, 4.0])
    np.savez(tmp_path / "even.npz", depth=heights, lon=x, lat=y)
    surface = formats.read(tmp_path / "even.npz")
    np.testing.assert_array_equal(surface.points, heights)
    assert surface.metadata["geotransform"] == [1.25, 0.5, 0.0, 9.0, 0.0, -2.0]
    np.savez(tmp_path / "uneven.npz", depth=heights, lon=x**2, lat=y, u=y, v=np.ones((3, 4)))
    surface = formats.read(tmp_path / "uneven.npz", array="depth")
    np.testing.assert_array_equal(surface.points, heights)
    assert surface.metadata["axes"] == {"x": [*(x**2).tolist(), "values"], "y": [8, -2]}
    np.savez(tmp_path / "arrays.npz", z=heights, x=heights + 1, y=heights * 2)
    surface = formats.read(tmp_path / "arrays.npz")
    np.testing.assert_array_equal(surface.points, np.dstack((heights + 1, heights * 2, heights)))
    surface = formats.read(tmp_path / "uneven.npz", array="depth", x="v", y="u")
    np.testing.assert_array_equal(surface.points[1], np.column_stack((np.ones(4), np.full(4, 6.0), heights[1])))
    refusals: list[tuple[dict[str, Any], type[InputError], str]] = [
        ({"x": "nothing"}, OptionError, r"no array 'nothing' for x=, only depth \(3 x 4 float64\), lon"),
        ({"y": "lon"}, FormatError, r"4 float64 in lon, which is no y of depth: .* \(3, 4\), or a vector of 3$"),
    ]
    for options, error, message in refusals:
        with pytest.raises(error, match=message):
            formats.read(tmp_path / "uneven.npz", array="depth", **options)


@pytest.mark.parametrize(
    ("extent", "expected"),
    [
        ((18.0, 17.0), [10.0, 2.0, 0.0, 20.0, 0.0, -1.0]),  # of cells
        ((16.0, 22.0), [9.0, 2.0, 0.0, 19.5, 0.0, 1.0]),  # of points
        ((18.0, 9.0), None),
    ],
)
def test_npz_with_an_extent_says_where_its_cells_or_points_lie(
    tmp_path: Path, extent: tuple[float, float], expected: list[float] | None
) -> None:
    scalars = {"dx": 2.0, "xmin": 10.0, "xmax": extent[0], "dy": 1.0, "ymin": 20.0, "ymax": extent[1]}
    arrays: dict[str, Any] = {"z": np.zeros((3, 4)), **{name: np.array(value) for name, value in scalars.items()}}
    np.savez(tmp_path / "a.npz", **arrays)
    metadata = formats.read(tmp_path / "a.npz").metadata
    assert metadata["scalars"] == scalars
    assert metadata.get("geotransform") == expected


def test_npz_of_two_surfaces_asks_which(tmp_path: Path) -> None:
    path = tmp_path / "two.npz"
    np.savez(path, bed=np.zeros((3, 4)), ice=np.ones((3, 4), np.float32, order="F"))
    words = "2 arrays that are surfaces: choose one with array= bed or ice"
    with pytest.raises(ChoiceError, match=words) as raised:
        formats.read(path)
    assert raised.value.choices == tuple(Choice({"array": name}, (3, 4)) for name in ("bed", "ice"))
    with pytest.warns(FormatWarning, match="^left out arrays of the archive: bed$"):
        assert formats.read(path, array="ice").points.tolist() == np.ones((3, 4)).tolist()
    with pytest.raises(OptionError, match=r"no array 'snow': choose with array= one of bed \(3 x 4 float64\), ice"):
        formats.read(path, array="snow")


def test_geotiff_keeps_place_and_nodata(tmp_path: Path) -> None:
    pytest.importorskip("rasterio")
    heights = np.arange(20, dtype=np.float32).reshape(4, 5)
    path = tmp_path / "dem.tif"
    write_tiff(path, heights[None], crs="EPSG:32611", nodata=-9999)
    surface = formats.read(path)
    assert surface.points.dtype == np.float32
    np.testing.assert_array_equal(surface.points, heights)
    assert surface.metadata["geotransform"] == [500.0, 30.0, 0.0, 900.0, 0.0, -30.0]
    assert surface.metadata["nodata"] == -9999
    assert "UTM zone 11N" in surface.metadata["crs"]
    assert surface.metadata["format"] == "geotiff"
    assert msgpack.unpackb(msgpack.packb(surface.metadata)) == surface.metadata


@pytest.mark.parametrize("dtype", DTYPES)
def test_geotiff_of_every_type(tmp_path: Path, dtype: str) -> None:
    rasterio = pytest.importorskip("rasterio")
    info: Any = np.finfo(dtype) if dtype.startswith("f") else np.iinfo(dtype)
    heights = np.array([[info.min, 0, 1], [2, 3, info.max]], dtype)
    write_tiff(tmp_path / "t.tif", heights[None], transform=rasterio.Affine.identity())
    surface = formats.read(tmp_path / "t.tif")
    assert surface.points.dtype == heights.dtype
    np.testing.assert_array_equal(surface.points, heights)
    assert surface.metadata == {"name": "t", "format": "geotiff"}


def test_geotiff_keeps_unit_scale_and_a_nodata_that_json_lacks(tmp_path: Path) -> None:
    rasterio = pytest.importorskip("rasterio")
    path = tmp_path / "t.tif"
    write_tiff(path, np.ones((1, 2, 3), np.float32), nodata=float("nan"))
    with rasterio.open(path, "r+") as dataset:
        dataset.units, dataset.scales, dataset.offsets = ("m",), (0.1,), (-5.0,)
    metadata = formats.read(path).metadata
    assert {key: metadata[key] for key in ("unit", "scale", "offset", "nodata")} == {
        "unit": "m",
        "scale": 0.1,
        "offset": -5.0,
        "nodata": "nan",
    }


def test_geotiff_of_several_bands_takes_the_one_named(tmp_path: Path) -> None:
    pytest.importorskip("rasterio")
    bands = np.arange(24, dtype=np.uint16).reshape(2, 3, 4)
    write_tiff(tmp_path / "two.tif", bands)
    for band in (1, 2):
        surface = formats.read(tmp_path / "two.tif", band=str(band)) if band > 1 else formats.read(tmp_path / "two.tif")
        np.testing.assert_array_equal(surface.points, bands[band - 1])
        assert list(surface.attributes) == [f"band_{3 - band}"]
        np.testing.assert_array_equal(surface.attributes[f"band_{3 - band}"], bands[2 - band])
    for name, message in (("3", "band= from 1 to 2, got 3"), ("red", "band= a whole number, got 'red'")):
        with pytest.raises(OptionError, match=message):
            formats.read(tmp_path / "two.tif", band=name)


def test_geotiff_looks_for_nothing_beside_it(tmp_path: Path) -> None:
    rasterio = pytest.importorskip("rasterio")
    path = tmp_path / "a.tif"
    heights = np.ones((1, 4, 5), np.float32)
    write_tiff(path, heights, transform=rasterio.Affine.identity())
    (tmp_path / "a.tif.aux.xml").write_text(
        "<PAMDataset><PAMRasterBand band='1'><NoDataValue>1</NoDataValue><UnitType>ft</UnitType></PAMRasterBand>"
        "<GeoTransform>1,2,3,4,5,6</GeoTransform></PAMDataset>"
    )
    (tmp_path / "a.tfw").write_text("2\n0\n0\n-2\n100\n200\n")
    write_tiff(tmp_path / "a.tif.msk", np.zeros((1, 4, 5), np.uint8))
    write_tiff(tmp_path / "a.tif.ovr", np.zeros((1, 2, 3), np.float32))
    surface = formats.read(path)
    assert surface.metadata == {"name": "a", "format": "geotiff"}
    np.testing.assert_array_equal(surface.points, heights[0])


def test_geotiff_without_its_library_says_what_to_install(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "a.tif").write_bytes(b"II*\0" + bytes(100))
    monkeypatch.setitem(sys.modules, "rasterio", None)
    with pytest.raises(UnavailableError, match=r"pip install 'lodestream\[formats\]'"):
        formats.read(tmp_path / "a.tif")


@pytest.mark.parametrize(
    ("name", "shape", "dtype"),
    [
        ("bigtujunga.tif", (643, 1197), "int16"),
        ("lidar_dsm_2m.tif", (259, 283), "float32"),
        ("jacksboro_fault_dem.npz", (344, 403), "int16"),
        ("topobathy.npz", (91, 120), "float32"),
    ],
)
def test_real_files(name: str, shape: tuple[int, int], dtype: str) -> None:
    path = data(name)
    if path.suffix == ".tif":
        pytest.importorskip("rasterio")
    surface = formats.read(path)
    assert (surface.shape, surface.points.dtype.name, surface.closed) == (shape, dtype, (False, False))
    assert surface.metadata["name"] == path.stem
    assert msgpack.unpackb(msgpack.packb(surface.metadata)) == surface.metadata


def test_real_heights_lie_where_their_description_says() -> None:
    pytest.importorskip("rasterio")
    surface = formats.read(data("bigtujunga.tif"))
    assert (int(surface.points.min()), int(surface.points.max())) == (315, 2295)
    assert surface.metadata["nodata"] == 32767
    scalars = formats.read(data("jacksboro_fault_dem.npz")).metadata["scalars"]
    assert scalars["xmin"] + 403 * scalars["dx"] == pytest.approx(scalars["xmax"])


def test_content_decides_and_the_name_is_that_of_the_owner(tmp_path: Path) -> None:
    path = tmp_path / "upload-17.tif"
    np.save(tmp_path / "a.npy", np.eye(3))
    (tmp_path / "a.npy").rename(path)
    assert formats.sniff(path).name == "npy"
    assert formats.read(path, filename="My hill.npy").metadata["name"] == "My hill"
    with pytest.raises(TooLargeError, match=r"^My hill.npy: expected at most 8 vertices, got an array of 3 x 3$"):
        formats.read(path, filename="My hill.npy", max_vertices=8)
    with pytest.raises(FormatError, match=r"^evil\\nname: ") as caught:
        formats.read(tmp_path, filename="evil\nname")
    assert "\n" not in str(caught.value)


def test_the_limit_counts_vertices_before_values_are_read(tmp_path: Path) -> None:
    pytest.importorskip("rasterio")
    np.save(tmp_path / "a.npy", np.zeros((10, 10, 3)))
    np.savez(tmp_path / "a.npz", np.zeros((10, 10)))
    write_tiff(tmp_path / "a.tif", np.zeros((1, 10, 10), np.int16))
    formats.write(Surface(np.zeros((10, 10))), tmp_path / "a.obj")
    for suffix in ("npy", "npz", "tif", "obj"):
        assert formats.read(tmp_path / f"a.{suffix}", max_vertices=100).shape == (10, 10)
        with pytest.raises(TooLargeError, match=f"a.{suffix}: expected at most 99 vertices"):
            formats.read(tmp_path / f"a.{suffix}", max_vertices=99)


def test_a_format_is_asked_for_where_no_name_tells(tmp_path: Path) -> None:
    (tmp_path / "numbers").write_text("4 3\n5 6\n")
    for name in ("text", "csv", ".TXT"):
        np.testing.assert_array_equal(formats.read(tmp_path / "numbers", format_name=name).points, [[4, 3], [5, 6]])
    with pytest.raises(FormatError, match="this is text that begins with '4 3 5 6', not a file of format pcd"):
        formats.read(tmp_path / "numbers", format_name="pcd")
    np.save(tmp_path / "a.npy", np.eye(3))
    (tmp_path / "a.npy").rename(tmp_path / "a.hgt")
    with pytest.raises(FormatError, match="expected an SRTM tile"):  # any bytes are one, whatever they are
        formats.read(tmp_path / "a.hgt", format_name="hgt")
    with pytest.raises(
        FormatError, match=r"this is a file that begins with the bytes 93 4e .*, not a file of format geotiff"
    ):
        formats.read(tmp_path / "a.hgt", format_name="tif")
    with pytest.raises(OptionError, match=r"format to be one of npy, .*plot3d, got 'docx'"):
        formats.read(tmp_path / "a.hgt", format_name="docx")
    with pytest.raises(OptionError, match="got 'vtm'"):
        formats.sniff(tmp_path / "a.hgt", format_name="vtm")
    (tmp_path / "empty").touch()
    with pytest.raises(FormatError, match="this is an empty file, not a file of format npy"):
        formats.read(tmp_path / "empty", format_name="npy")
    with pytest.raises(SwitchedOffError):
        formats.read(tmp_path / "numbers", format_name="text", allowed=("npy",))


@pytest.mark.parametrize("size", [1201])
def test_a_tile_without_a_name_is_read_by_its_format(tmp_path: Path, size: int) -> None:
    pytest.importorskip("rasterio")
    heights = (np.arange(size * size) % 3000).reshape(size, size).astype(">i2")
    heights.tofile(tmp_path / "standard-input")
    surface = formats.read(tmp_path / "standard-input", format_name="hgt", tile="N37W122")
    np.testing.assert_array_equal(surface.points, heights)
    assert surface.metadata["geotransform"][0] == pytest.approx(-122, abs=1e-3)


def test_a_container_is_refused_with_the_function_that_takes_it(tmp_path: Path) -> None:
    (tmp_path / "x.lode").write_bytes(encode(np.arange(12.0).reshape(3, 4)))
    with pytest.raises(FormatError, match=r"x\.lode: this is a container of Lodestream already: lodestream\.open"):
        formats.read(tmp_path / "x.lode")


def test_options_that_do_not_exist_are_named(tmp_path: Path) -> None:
    np.save(tmp_path / "a.npy", np.eye(3))
    np.savez(tmp_path / "a.npz", np.eye(3))
    with pytest.raises(OptionError, match=r"an option of format npy \(none\), got 'band'"):
        formats.read(tmp_path / "a.npy", band=1)
    with pytest.raises(OptionError, match=r"an option of format npz \(array, x, y\), got 'band'"):
        formats.read(tmp_path / "a.npz", band=1)
    with pytest.raises(OptionError, match="expected max_vertices as a whole number, got '9'"):
        formats.read(tmp_path / "a.npy", max_vertices="9")  # type: ignore[arg-type]
    with pytest.raises(OptionError, match="expected one file of format npy, got 3"):
        formats.read(tmp_path / "a.npy", tmp_path / "b.npy", tmp_path / "c.npy")


def test_only_formats_that_are_allowed_are_read(tmp_path: Path) -> None:
    path = tmp_path / "a.npy"
    np.save(path, np.zeros((3, 4)))
    for allowed in (None, ["npy"], ("text", "npy")):
        assert formats.read(path, allowed=allowed).shape == (3, 4)
    for nothing in ([], ["text"], {"vmec", "netcdf"}):
        with pytest.raises(SwitchedOffError, match=r"a\.npy: .* got npy, which is switched off"):
            formats.read(path, allowed=nothing)


def test_a_missing_file_is_an_error_of_the_system(tmp_path: Path) -> None:
    with pytest.raises(FileNotFoundError, match=r"nothing\.npy"):
        formats.read(tmp_path / "nothing.npy")
    with pytest.raises(FileNotFoundError, match=r"nowhere/a\.npy'$"):
        formats.write(Surface(np.eye(3)), tmp_path / "nowhere" / "a.npy")


def test_write_leaves_the_old_file_or_the_new_one(tmp_path: Path) -> None:
    path = tmp_path / "a.ply"
    path.write_text("old")
    with pytest.raises(FormatError, match=r"a\.ply: expected integers that a double of PLY holds"):
        formats.write(Surface(np.array([[0, 2**53 + 1]])), path)
    assert path.read_text() == "old"
    link = tmp_path / "link.ply"
    link.symlink_to(path)
    formats.write(Surface(np.zeros((2, 2))), link)
    assert link.is_symlink()
    assert path.read_bytes().startswith(b"ply\n")
    assert sorted(entry.name for entry in tmp_path.iterdir()) == ["a.ply", "link.ply"]
    umask = os.umask(0)
    os.umask(umask)
    assert path.stat().st_mode & 0o777 == 0o666 & ~umask


def test_write_goes_through_what_is_no_file(tmp_path: Path) -> None:
    os.mkfifo(tmp_path / "pipe.npy")
    reader = os.open(tmp_path / "pipe.npy", os.O_RDONLY | os.O_NONBLOCK)
    try:
        formats.write(Surface(np.eye(3)), tmp_path / "pipe.npy")
        received = os.read(reader, 1 << 16)
    finally:
        os.close(reader)
    np.testing.assert_array_equal(np.load(io.BytesIO(received)), np.eye(3))


def test_formats_that_are_not_written_are_refused(tmp_path: Path) -> None:
    with pytest.raises(OptionError, match=r"ends in one of \.npy, .*\.ply, \.obj, \.vts, .*\.glb"):
        formats.write(Surface(np.eye(3)), tmp_path / "a.docx")
    with pytest.raises(OptionError, match=r"one of npy, .*ply, obj, vts, vtm, glb.*, got 'pcd'"):
        formats.write_stream(Surface(np.eye(3)), "pcd", io.BytesIO())
    assert list(tmp_path.iterdir()) == []


def test_every_row_of_the_table_is_complete() -> None:
    table = formats.formats()
    assert len({row.name for row in table}) == len(table)
    for row in table:
        assert row.read or row.suffixes_out
        assert all(suffix.startswith(".") and suffix == suffix.lower() for suffix in row.suffixes)
        assert all(text for text in row.options.values())


def test_importing_formats_loads_no_library_of_a_format() -> None:
    libraries = ("rasterio", "trimesh", "xarray", "zarr", "PIL", "h5py", "scipy", "vtkmodules")
    code = f"import sys, lodestream.formats; print([m for m in {libraries} if m in sys.modules])"
    path = os.pathsep.join(entry for entry in sys.path if entry)
    done = subprocess.run(
        [sys.executable, "-c", code], env={**os.environ, "PYTHONPATH": path}, capture_output=True, text=True, check=True
    )
    assert done.stdout.strip() == "[]"


def test_values_that_are_not_finite_are_holes(tmp_path: Path) -> None:
    np.save(tmp_path / "a.npy", np.array([[1.0, np.nan], [np.inf, 2.0]]))
    mask = formats.read(tmp_path / "a.npy").mask
    assert mask is not None
    assert mask.tolist() == [[True, False], [False, True]]
    np.save(tmp_path / "b.npy", np.full((2, 3), np.nan))
    with pytest.raises(InputError, match=r"b\.npy: expected at least one valid point, got 2 x 3 holes"):
        formats.read(tmp_path / "b.npy")
