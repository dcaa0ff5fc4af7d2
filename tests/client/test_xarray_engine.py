"""``xarray.open_dataset(..., engine="lode")`` of files, of web servers and of a Lodestream server."""

from __future__ import annotations

import pickle
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import xarray as xr
from numpy.typing import NDArray

import lodestream as ls
from lodestream.interop import lazy_xarray
from lodestream_client import Client
from lodestream_client.xarray_engine import LodeBackend
from tests.client import files
from tests.core.surfaces import terrain, torus

ROWS, COLUMNS = 700, 900


def holed() -> ls.Surface:
    """Heights with a place, holes, and attributes of both shapes, larger than several tiles."""
    rng = np.random.default_rng(4)
    y, x = np.mgrid[:ROWS, :COLUMNS]
    values = (200 * np.sin(x / 40) * np.cos(y / 60) + rng.normal(0, 2, x.shape)).astype("i2")
    mask = (x - 300) ** 2 + (y - 250) ** 2 > 200**2
    speed = np.where(mask, x * 0.5, np.nan).astype("f4")
    wind = np.where(mask[..., None], np.stack([x, y], axis=2), 0).astype("i4")
    metadata = {"geotransform": [10.0, 2.0, 0.0, 5.0, 0.0, -2.0], "unit": "m", "crs": 'LOCAL_CS["x"]', "name": "hill"}
    return ls.Surface(values, mask=mask, attributes={"speed": speed, "wind": wind}, metadata=metadata)


@pytest.fixture(scope="module")
def original() -> ls.Surface:
    return holed()


@pytest.fixture(scope="module")
def path(original: ls.Surface, tmp_path_factory: pytest.TempPathFactory) -> Path:
    found = tmp_path_factory.mktemp("engine") / "hill.lode"
    found.write_bytes(ls.encode(original))
    return found


def opened(place: Any, **options: Any) -> xr.Dataset:
    """As xarray does by the entry point, which tests/client/test_entry_points.py goes through."""
    return xr.open_dataset(place, engine=LodeBackend, **options)


def test_a_file_is_the_dataset_of_its_surface(path: Path, original: ls.Surface) -> None:
    with opened(path) as found:
        wanted = original.to_xarray()
        xr.testing.assert_equal(found, wanted)
        assert found.z.attrs == {"units": "m"}
        assert found.z.encoding["grid_mapping"] == "spatial_ref"
        assert ls.Surface.from_xarray(found).metadata["crs"] == original.metadata["crs"]


KEYS: list[Any] = [
    (slice(400, 460), slice(700, 790)),
    (slice(None, None, 97), slice(800, 3, -31)),
    (slice(240, 260), slice(290, 310)),  # all of it holes
    (5, slice(0, 50)),
    (699, 899),
    (-1, -900),
    (slice(7, 7), slice(None)),
    ([3, 650, 2], slice(0, 900, 300)),
    ([1, 2, 699], [5, 6, 7]),
]


@pytest.mark.parametrize("key", KEYS)
@pytest.mark.long
def test_whatever_is_indexed_is_exact(path: Path, original: ls.Surface, key: Any) -> None:
    wanted = original.to_xarray()
    assert isinstance(wanted, xr.Dataset)
    with opened(path) as found:
        for name in ("z", "speed", "wind"):
            xr.testing.assert_equal(found[name][key], wanted[name][key])
        rows, columns = (xr.DataArray([3, 699, 50], dims="place"), xr.DataArray([1, 2, 898], dims="place"))
        xr.testing.assert_equal(found.z[rows, columns], wanted.z[rows, columns])
        assert found.wind[3, 4, 1] == 3


def test_integers_with_holes_are_integers_again_where_the_surface_has_a_value_for_holes(
    original: ls.Surface, tmp_path: Path
) -> None:
    metadata = original.metadata | {"nodata": -9999}
    surface = ls.Surface(original.points, mask=original.mask, metadata=metadata)
    (tmp_path / "exact.lode").write_bytes(ls.encode(surface))
    (tmp_path / "near.lode").write_bytes(ls.encode(surface, precision=1.0))
    with opened(tmp_path / "exact.lode") as found:
        assert found.z.dtype == np.float32
        back = ls.Surface.from_xarray(found)
        assert back.dtype == np.int16
        assert np.array_equal(back.points[surface.mask], surface.points[surface.mask])
        found.to_netcdf(tmp_path / "a.nc", engine="h5netcdf")
    with xr.open_dataset(tmp_path / "a.nc", engine="h5netcdf", mask_and_scale=False) as stored:
        assert stored.z.dtype == np.int16
        assert stored.z.attrs["_FillValue"] == -9999
    for other in (opened(tmp_path / "exact.lode", level=1), opened(tmp_path / "near.lode")):
        assert "_FillValue" not in other.z.encoding


@pytest.mark.long
def test_a_window_reads_a_part_of_the_file(original: ls.Surface, tmp_path: Path) -> None:
    x = np.mgrid[:2048, :2048][1]
    rough = np.random.default_rng(1).normal(0, 30, x.shape) + x
    metadata = {"geotransform": [-0.5, 1.0, 0.0, 0.5, 0.0, -1.0]}
    (tmp_path / "large.lode").write_bytes(ls.encode(ls.Surface(rough.round().astype("i2"), metadata=metadata)))
    size = (tmp_path / "large.lode").stat().st_size
    with files.ranged(tmp_path) as server:
        found = opened(f"{server.url}/large.lode")
        window = found.z[1000:1100, 300:420].values
        assert np.array_equal(window, rough.round().astype("i2")[1000:1100, 300:420])
        asked = [told for method, told in server.requests if method == "GET" and told]
        taken = sum(int(last) - int(first) + 1 for first, last in (told[6:].split("-") for told in asked))
        assert taken < size / 4
        before = len(server.requests)
        assert found.x.values[3] == 3
        assert len(server.requests) == before


@pytest.mark.long
def test_a_window_of_a_level_reads_what_it_needs_alone(tmp_path: Path) -> None:
    x = np.mgrid[:2048, :2048][1]
    rough = (np.random.default_rng(1).normal(0, 30, x.shape) + x).round().astype("i2")
    data = ls.encode(rough)
    (tmp_path / "large.lode").write_bytes(data)
    decoder = ls.Decoder()
    decoder.feed(data)
    assert decoder.header is not None
    level = decoder.header.levels - 1
    whole = decoder.points_at(level)
    with files.ranged(tmp_path) as server:

        def read(rows: slice, columns: slice, **options: Any) -> tuple[NDArray[Any], int]:
            """What is indexed, and the bytes of the file that were read for it after opening."""
            found, before = opened(f"{server.url}/large.lode", **options), len(server.requests)
            values = found.z.isel(y=rows, x=columns).values
            asked = [told for method, told in server.requests[before:] if method == "GET" and told]
            return values, sum(int(last) - int(first) + 1 for first, last in (told[6:].split("-") for told in asked))

        window, size = read(slice(500, 550), slice(150, 210), level=level)
        assert np.array_equal(window, whole[500:550, 150:210])
        everything, size_of_level = read(slice(None), slice(None), level=level)
        assert np.array_equal(everything, whole)
        _, size_of_finest = read(slice(1000, 1100), slice(300, 420))
        assert 0 < size < size_of_level / 3
        assert size < 0.8 * size_of_finest
        # The same place by the full grid's rows and columns.
        same, size_of_region = read(slice(None), slice(None), level=level, region=((1000, 1100), (300, 420)))
        assert np.array_equal(same, window)
        assert size_of_region == size


def test_a_level_of_few_points_is_read_once_and_large_ones_by_windows(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    heights = (terrain((360, 360), 3) * 8).round().astype("i2")
    surface = ls.Surface(heights, (False, True), attributes={"kind": heights % 5})
    (tmp_path / "a.lode").write_bytes(ls.encode(surface))
    decoder = ls.Decoder()
    decoder.feed((tmp_path / "a.lode").read_bytes())
    assert decoder.header is not None
    level, decodings = decoder.header.levels - 3, 0
    decoded = ls.Container._end

    def counted(*args: Any, **options: Any) -> Any:
        nonlocal decodings
        decodings += 1
        return decoded(*args, **options)

    monkeypatch.setattr(ls.Container, "_end", counted)
    for region in (None, ((40, 200), (300, 420))):  # which goes on across the seam
        wanted = decoder.surface(level) if region is None else decoder.view().window(region, level)
        decodings = 0
        with opened(tmp_path / "a.lode", level=level, region=region) as found:
            (rows, columns), points = found.z.shape, wanted.points.squeeze()
            for row in range(0, rows, 7):
                for column in range(0, columns, 3):
                    assert found.z[row, column].values == points[row, column]
                    assert found.kind[row, column].values == wanted.attributes["kind"][row, column]
        assert decodings == 2, "once for the heights, once for the attribute"
    with opened(tmp_path / "a.lode", level=level, region=((40, 41), (0, 1))) as found:
        assert found.z.values == decoder.points_at(level)[5, 0], "an array may have one point"
    monkeypatch.setattr(lazy_xarray, "_WHOLE_POINTS", 100)
    decodings = 0
    with opened(tmp_path / "a.lode", level=level) as found:
        for row in range(5):
            assert np.array_equal(found.z[row, 3:9].values, decoder.points_at(level)[row, 3:9])
    assert decodings == 5


@pytest.mark.parametrize("level", [5, 7])
@pytest.mark.parametrize("key", [*KEYS[:3], (5, slice(0, 50)), (slice(None), -1)])
@pytest.mark.long
def test_whatever_is_indexed_of_a_level_is_the_levels_own(path: Path, level: int, key: Any) -> None:
    decoder = ls.Decoder()
    decoder.feed(path.read_bytes())
    wanted = decoder.surface(level).to_xarray()
    assert isinstance(wanted, xr.Dataset)
    with opened(path, level=level) as found:
        for name in ("z", "speed", "wind"):
            xr.testing.assert_equal(found[name][key], wanted[name][key])
        region = (40, 300), (100, 500)
    with opened(path, level=level, region=region) as found:
        xr.testing.assert_allclose(found.load(), decoder.view().window(region, level).to_xarray())


def test_a_served_surface_with_and_without_a_level(server: str, original: ls.Surface, path: Path) -> None:
    url = Client(server).upload(path).url
    wanted = original.to_xarray()
    assert isinstance(wanted, xr.Dataset)
    found = opened(url)
    xr.testing.assert_equal(found.z[600:, 800:], wanted.z[600:, 800:])
    assert "engine" not in found.encoding
    decoder = ls.Decoder()
    decoder.feed(path.read_bytes())
    coarse = decoder.surface(2)
    xr.testing.assert_equal(opened(url, level=2).load(), coarse.to_xarray())
    with pytest.raises(ls.NotFoundError):
        opened(url[:-3] + "000")


def test_dask_computes_windows_in_threads_and_copies_go_to_other_processes(path: Path, original: ls.Surface) -> None:
    found = opened(path, chunks={})
    assert found.z.chunks == ((512, 188), (512, 388))
    lines = opened(path, chunks={"y": 512})
    valid: NDArray[Any] = original.points[original.mask]
    assert float(lines.z.astype("f8").sum()) == valid.sum(dtype="i8")
    assert float(lines.z.max()) == valid.max()
    copy = pickle.loads(pickle.dumps(found))
    xr.testing.assert_equal(copy.z[:40, :50], original.to_xarray().z[:40, :50])
    again = pickle.loads(pickle.dumps(ls.open(path)))
    assert again.header.shape == (ROWS, COLUMNS)


def test_a_copy_of_a_file_that_has_changed_is_refused(tmp_path: Path) -> None:
    file = tmp_path / "a.lode"
    file.write_bytes(ls.encode(np.arange(900.0).reshape(30, 30) ** 2))
    copy = pickle.dumps(opened(file))
    assert pickle.loads(copy).z.shape == (30, 30)
    file.write_bytes(ls.encode(np.arange(900.0).reshape(30, 30) ** 3))
    with pytest.raises(ls.LodestreamError, match="as it was when it was opened first"):
        pickle.loads(copy)


def test_points_in_space_are_lazy_too(tmp_path: Path) -> None:
    surface = ls.Surface(torus(90, 120), (True, True), metadata={"unit": "mm"})
    (tmp_path / "a.lode").write_bytes(ls.encode(surface))
    found = opened(tmp_path / "a.lode")
    wanted: Any = surface.to_xarray()
    xr.testing.assert_equal(found[["z"]].isel(row=slice(3, 9)), wanted[["z"]].isel(row=slice(3, 9)))
    back = ls.Surface.from_xarray(found)
    assert back.closed == (True, True)
    assert np.array_equal(back.points, surface.points)
    coarse = opened(tmp_path / "a.lode", level=1)
    decoder = ls.Decoder()
    decoder.feed((tmp_path / "a.lode").read_bytes())
    assert np.array_equal(coarse.x.values, decoder.points_at(1)[..., 0])


def test_points_over_a_regular_lattice_have_their_coordinates(tmp_path: Path) -> None:
    y, x = np.mgrid[:60, :70]
    points = np.stack([3.0 + 2 * x, 7.0 - y, np.sin(x / 9.0)], axis=2)
    (tmp_path / "a.lode").write_bytes(ls.encode(ls.Surface(points)))
    for level in (None, 1):
        found = opened(tmp_path / "a.lode", level=level)
        decoder = ls.Decoder()
        decoder.feed((tmp_path / "a.lode").read_bytes())
        wanted = decoder.surface(level).points
        for channel, name in enumerate("xyz"):
            assert np.array_equal(found[name].values, wanted[..., channel])


def test_several_blocks_are_opened_one_by_one_or_as_a_tree(tmp_path: Path) -> None:
    blocks = [ls.Block(torus(40, 60)), ls.Block(torus(30, 20) + 9, attributes=None)]
    (tmp_path / "a.lode").write_bytes(ls.encode(ls.Surface(blocks=blocks)))
    with pytest.raises(ls.OptionError, match="block= of 0 to 1"):
        opened(tmp_path / "a.lode")
    assert np.array_equal(opened(tmp_path / "a.lode", block=1).z.values, blocks[1].points[..., 2])
    tree: Any = xr.open_datatree(tmp_path / "a.lode", engine=LodeBackend)
    assert np.array_equal(tree["block_0"]["x"].values, blocks[0].points[..., 0])
    assert xr.open_datatree(tmp_path / "a.lode", engine=LodeBackend, level=1)["block_0"].sizes["row"] < 40
    with pytest.raises(ls.OptionError, match="got 2"):
        opened(tmp_path / "a.lode", block=2)
    with pytest.raises(ls.OptionError, match="got 'nothing'"):
        xr.open_datatree(tmp_path / "a.lode", engine=LodeBackend, nothing=1)


@pytest.mark.parametrize("wrong", ["2", 1.5, True, np.bool_(True), [1]])
def test_levels_and_blocks_are_integers(path: Path, wrong: Any) -> None:
    with pytest.raises(ls.OptionError, match="expected a level as an integer such as 1, got "):
        opened(path, level=wrong)
    with pytest.raises(ls.OptionError, match="expected a block as an integer such as 1, got "):
        opened(path, block=wrong)
    assert opened(path, level=np.int64(2)).z.shape == opened(path, level=2).z.shape


def test_what_cannot_be_opened_is_refused(path: Path, tmp_path: Path) -> None:
    with pytest.raises(ls.OptionError, match="expected a level of 0 to"):
        opened(path, level=50)
    with pytest.raises(ls.TooLargeError):
        opened(path, max_vertices=1000).z.load()
    (tmp_path / "cut.lode").write_bytes(path.read_bytes()[:-7])
    with pytest.raises(ls.TruncatedStreamError) as cut:
        opened(tmp_path / "cut.lode")
    assert cut.value.__notes__ == [f"in {tmp_path / 'cut.lode'}"]
    with pytest.raises(FileNotFoundError):
        opened(tmp_path / "none.lode")
    with pytest.raises(ls.InputError, match="expected a file's name or a URL"):
        LodeBackend().open_dataset(3)  # type: ignore[arg-type]
    assert "z" not in opened(path, drop_variables="z")


def test_it_offers_itself_for_containers_and_surfaces_only() -> None:
    guess = LodeBackend().guess_can_open
    assert all(map(guess, ["a.lode", Path("a.lode"), "https://h/a.lode?x=1", "http://h/v1/surfaces/12"]))
    assert not any(map(guess, ["a.nc", "https://h/a.nc", b"a.lode", 3]))


#: What xarray.open_dataset hands to an engine.
DECODERS: tuple[dict[str, Any], ...] = (
    {"decode_times": False},
    {"decode_times": True},
    {"mask_and_scale": False},
    {"mask_and_scale": True, "decode_timedelta": True},
    {"decode_cf": False},
    {"decode_cf": True},
    {"decode_coords": "all", "concat_characters": True},
    {"decode_times": xr.coders.CFDatetimeCoder(time_unit="s")},
)


@pytest.mark.parametrize("options", DECODERS)
@pytest.mark.long
def test_arguments_of_every_engine_are_taken(path: Path, original: ls.Surface, options: dict[str, Any]) -> None:
    with opened(path, **options) as found:
        xr.testing.assert_equal(found, original.to_xarray())
    with opened(path) as plain, opened(path, **options) as found:
        for name, variable in plain.variables.items():
            assert variable.encoding.items() <= found.variables[name].encoding.items()
    (tree,) = (
        LodeBackend().open_groups_as_dict(path, **{k: it for k, it in options.items() if k != "decode_cf"}).values()
    )
    xr.testing.assert_equal(tree, original.to_xarray())


def test_what_is_decoded_is_as_xarray_decodes_it(tmp_path: Path) -> None:
    values = np.arange(12, dtype="i2").reshape(3, 4)
    surface = ls.Surface(values, metadata={"scale": 0.5, "offset": 3.0, "scalars": {"time": 36.5}})
    surface.metadata["tags"] = {"": {"time#units": "hours since 2001-01-01"}}
    (tmp_path / "a.lode").write_bytes(ls.encode(surface))
    with opened(tmp_path / "a.lode") as found:
        np.testing.assert_array_equal(found.z.values, values)
        assert (found.z.attrs["scale_factor"], found.time.values) == (0.5, 36.5)
    with opened(tmp_path / "a.lode", mask_and_scale=True, decode_times=True) as found:
        assert not found.z.variable._in_memory
        np.testing.assert_array_equal(found.z.values, values * 0.5 + 3)
        np.testing.assert_array_equal(found.z[1:, 2].values, values[1:, 2] * 0.5 + 3)
        assert found.time.values == np.datetime64("2001-01-02T12:30")
    with opened(tmp_path / "a.lode", mask_and_scale=True) as found:
        assert found.time.values == 36.5
