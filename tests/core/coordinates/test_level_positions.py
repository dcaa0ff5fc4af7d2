"""Nodes of coarser levels lie where they stand in the finest grid, wherever x and y follow rules or are axes."""

from __future__ import annotations

import warnings
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray

import lodestream as ls
from lodestream.container.model import Header
from lodestream.coordinates.height_fields import coordinates
from lodestream.decoding.level_grids import level_nodes
from lodestream.formats import read, write
from tests.examples import examples

CLOSURES = [(False, False), (False, True), (True, False), (True, True)]


def decoder_of(surface: ls.Surface) -> ls.Decoder:
    decoder = ls.Decoder()
    decoder.feed(ls.encode(surface))
    return decoder


def header_of(decoder: ls.Decoder) -> Header:
    assert decoder.header is not None
    return decoder.header


@st.composite
def placements(draw: st.DrawFn) -> ls.Surface:
    """Heights of any shape and closure, whose metadata place them by one of the rules there are."""
    shape = draw(st.tuples(st.integers(2, 70), st.integers(2, 70)))
    closed = draw(st.sampled_from(CLOSURES))
    rng = np.random.default_rng(draw(st.integers(0, 2**32)))
    heights = np.cumsum(rng.normal(size=shape), axis=0).astype("f4")
    steps = rng.uniform(0.01, 40, 6) * rng.choice([-1, 1], 6)
    kind = draw(st.sampled_from(["none", "raster", "rotated", "even axes", "uneven axes", "ends", "both"]))
    rules = {
        "even axes": [[steps[0], steps[1]], [steps[2], steps[3], False]],
        "ends": [[steps[0], steps[0] + steps[1], True], [int(steps[2] * 9), 3, 1000]],
        "uneven axes": [[*np.cumsum(rng.uniform(0.1, 2, n)).tolist(), "values"] for n in shape[::-1]],
    }
    metadata: dict[str, Any] = {}
    if kind in ("raster", "both"):
        metadata["geotransform"] = [steps[0] * 1e4, steps[1], 0.0, steps[2] * 1e4, 0.0, steps[3]]
    if kind == "rotated":
        metadata["geotransform"] = steps.tolist()
    if kind in rules or kind == "both":
        x, y = rules["uneven axes" if kind == "both" else kind]
        metadata["axes"] = {"x": x, "y": y}
        if draw(st.booleans()):
            metadata["axes"]["dtype"] = "float32"
        if kind == "even axes" and draw(st.booleans()):
            metadata["axes"]["rows"] = "x"
    return ls.Surface(heights, closed, metadata=metadata)


def at_nodes(decoder: ls.Decoder, planes: tuple[NDArray[Any], ...], level: int) -> list[NDArray[Any]]:
    rows, columns = level_nodes(header_of(decoder), level)[0]
    return [plane[np.ix_(rows, columns)] for plane in planes]


@examples(20)
@given(placements())
def test_nodes_of_heights_lie_at_their_places_in_the_finest_grid(surface: ls.Surface) -> None:
    decoder = decoder_of(surface)
    full = coordinates(decoder.surface())
    size = max(float(np.ptp(plane)) for plane in full) + max(float(np.abs(plane).max()) for plane in full)
    for level in range(header_of(decoder).levels):
        found = coordinates(decoder.surface(level))
        for plane, wanted, whole in zip(found, at_nodes(decoder, full, level), full, strict=True):
            np.testing.assert_allclose(plane, wanted, rtol=0, atol=1e-14 * size)
            assert plane.min() >= whole.min() - 1e-14 * size
            assert plane.max() <= whole.max() + 1e-14 * size
            if "axes" in surface.metadata:
                assert plane.tobytes() == wanted.tobytes()


@examples(15)
@given(placements())
def test_levels_of_levels_lie_there_as_well(surface: ls.Surface) -> None:
    first = decoder_of(surface)
    level = header_of(first).levels - 1
    if level < 1:
        return
    coarse = first.surface(level)
    second = decoder_of(coarse)
    full = coordinates(coarse)
    size = max(float(np.abs(plane).max() + np.ptp(plane)) for plane in full)
    for coarser in range(header_of(second).levels + 1):
        wanted = at_nodes(second, full, coarser)
        for plane, own in zip(coordinates(second.surface(coarser)), wanted, strict=True):
            np.testing.assert_allclose(plane, own, rtol=0, atol=1e-14 * size)


@examples(20)
@given(
    st.tuples(st.integers(2, 60), st.integers(2, 60)),
    st.sampled_from(CLOSURES),
    st.sampled_from(["even", "ends", "rotated", "centres"]),
    st.integers(0, 2**32),
)
def test_nodes_of_points_whose_x_and_y_are_rules_have_the_points_of_the_finest_grid(
    shape: tuple[int, int], closed: tuple[bool, bool], kind: str, seed: int
) -> None:
    rng = np.random.default_rng(seed)
    rows, columns = np.mgrid[: shape[0], : shape[1]].astype(float)
    x, y = {
        "even": (columns * 0.25 - 7, rows * 30),
        "ends": (np.broadcast_to(np.linspace(0.1, 7.3, shape[1]), shape), rows * -0.5),
        "rotated": (3 + columns * 0.5 + rows * 0.25, 9 - columns * 0.25 + rows * 0.5),
        "centres": ((columns + 0.5) * 0.1, (rows + 0.5) * 0.3),
    }[kind]
    points = np.stack([x, y, np.rint(rng.normal(size=shape) * 9)], axis=2)
    decoder = decoder_of(ls.Surface(points, closed))
    assert header_of(decoder).plane is not None
    for level in range(header_of(decoder).levels):
        found = decoder.surface(level).points
        places = np.ix_(*level_nodes(header_of(decoder), level)[0])
        assert np.array_equal(found[..., :2], points[places][..., :2])


@pytest.mark.parametrize("closed", [False, True])
@pytest.mark.parametrize("shape", [(40, 46), (33, 47), (65, 129)])
def test_files_of_levels_have_these_places(shape: tuple[int, int], closed: bool, tmp_path: Path) -> None:
    rasterio = pytest.importorskip("rasterio")
    xarray = pytest.importorskip("xarray")
    rows, columns = np.mgrid[: shape[0], : shape[1]]
    heights = (rows * 3 + columns % 7).astype("i2")
    place = [500.0, 4.0, 0.0, 9000.0, 0.0, -2.0]
    decoder = decoder_of(ls.Surface(heights, (False, closed), metadata={"geotransform": place}))
    for level in range(2, header_of(decoder).levels):
        surface, (at_rows, at_columns) = decoder.surface(level), level_nodes(header_of(decoder), level)[0]
        x, y = 502.0 + 4.0 * at_columns, 8999.0 - 2.0 * at_rows
        dataset = surface.to_xarray()
        np.testing.assert_allclose(dataset.x, x, rtol=1e-14)
        np.testing.assert_allclose(dataset.y, y, rtol=1e-14)
        even = len({*np.diff(at_columns)}) == 1 and len({*np.diff(at_rows)}) == 1
        netcdf, raster = tmp_path / "level.nc", tmp_path / "level.tif"
        write(surface, netcdf)
        with xarray.open_dataset(netcdf) as file:
            np.testing.assert_allclose(file.x, x, rtol=1e-14)
            np.testing.assert_allclose(file.y, y, rtol=1e-14)
        with warnings.catch_warnings(record=True) as notes:
            warnings.simplefilter("always")
            write(surface, raster)
        told = [str(note.message) for note in notes if "assumes evenly spaced rows and columns: " in str(note.message)]
        assert bool(told) == (not even)
        with rasterio.open(raster) as file:
            across, down = file.transform.a, file.transform.e
            first = file.transform.c + across / 2, file.transform.f + down / 2
        # Where steps are even they are those of the nodes, also of a closed axis that cannot be halved.
        assert first == pytest.approx((x[0], y[0]))
        last = first[0] + across * (len(x) - 1), first[1] + down * (len(y) - 1)
        assert last == pytest.approx((x[-1], y[-1]))
        assert read(raster).shape == surface.shape


def test_a_map_closes_after_one_turn_at_every_level() -> None:
    pytest.importorskip("pyvista")
    heights = np.add.outer(np.arange(20), np.cos(np.arange(45) * np.pi / 22.5)).astype("f4")
    surface = ls.Surface(heights, (False, True), metadata={"geotransform": [-4.0, 8.0, 0.0, 40.0, 0.0, -2.0]})
    decoder = decoder_of(surface)
    for level in range(header_of(decoder).levels + 1):
        x = np.asarray(decoder.surface(level).to_pyvista().points[:, 0])
        assert (x.min(), x.max()) == pytest.approx((0, 360))


#: How x of W columns, or y of H rows, may be spaced in a file.
SPACINGS: dict[str, Callable[[int], NDArray[Any]]] = {
    "even": lambda n: 3.0 * np.arange(n),
    "growing": lambda n: np.cumsum(1.05 ** np.arange(n)),
    "falling": lambda n: -(np.arange(n, dtype="f4") ** 1.3),
    "to and fro": lambda n: np.arange(n) + 4 * np.sin(np.arange(n) / 5.0),
    "Mercator": lambda n: np.degrees(np.arctan(np.sinh(np.linspace(-2, 2.5, n)))),
    "numbers": lambda n: np.arange(n, dtype="i4") ** 2 - 700,
}

UNCONSOLIDATED: dict[str, dict[str, Any]] = {"nc": {}, "zarr": {"consolidated": False}}


@pytest.mark.sweep(7)
@pytest.mark.parametrize("suffix", ["nc", "zarr"])
@pytest.mark.parametrize("order", [("y", "x"), ("x", "y")])
@pytest.mark.parametrize(
    ("across", "down"),
    [("growing", "even"), ("even", "Mercator"), ("to and fro", "falling"), ("numbers", "growing"), ("falling",) * 2],
)
@pytest.mark.long
def test_uneven_axes_of_files_are_kept_at_every_level(
    across: str, down: str, order: tuple[str, str], suffix: str, tmp_path: Path
) -> None:
    xarray = pytest.importorskip("xarray")
    pytest.importorskip("zarr" if suffix == "zarr" else "h5netcdf")
    sizes = {"y": 53, "x": 78}
    shape = (sizes[order[0]], sizes[order[1]])
    heights = np.cumsum(np.random.default_rng(7).normal(size=shape), axis=1).astype("f4")
    lines = {"x": SPACINGS[across](sizes["x"]), "y": SPACINGS[down](sizes["y"])}
    source = xarray.Dataset({"z": (order, heights)}, lines)
    container, path = tmp_path / "a.lode", tmp_path / f"a.{suffix}"
    if suffix == "zarr":
        source.to_zarr(path, zarr_format=3, consolidated=False)
    else:
        source.to_netcdf(path, engine="h5netcdf")
    surface = read(path)
    assert (surface.points.ndim, surface.dtype.name) == (2, "float32")
    container.write_bytes(ls.encode(surface))
    decoder = decoder_of(surface)
    for level in range(header_of(decoder).levels + 1):
        nodes = dict(zip(order, level_nodes(header_of(decoder), level)[0], strict=True))
        opened = xarray.open_dataset(container, engine="lode", level=level)
        for dataset in (decoder.surface(level).to_xarray(), opened):
            for name, values in lines.items():
                assert dataset[name].dims == (name,)
                assert dataset[name].to_numpy().astype("f8").tobytes() == values[nodes[name]].astype("f8").tobytes()
        opened.close()
    written = tmp_path / f"b.{suffix}"
    write(decoder.surface(), written)
    with xarray.open_dataset(
        written, engine="zarr" if suffix == "zarr" else "h5netcdf", **UNCONSOLIDATED[suffix]
    ) as back:
        variable = back["z"]
        assert variable.values.tobytes() == heights.tobytes()
        for name, values in lines.items():
            wanted = np.broadcast_to(np.expand_dims(values, 1 - order.index(name)), shape)
            own = back[name].broadcast_like(variable).transpose(*variable.dims)
            assert back[name].dims == (name,)
            assert own.values.astype("f8").tobytes() == wanted.astype("f8").tobytes()
            # One type for both axes, and where they have one that is it.
            assert back[name].dtype == np.result_type(*lines.values())


@st.composite
def longitudes(draw: st.DrawFn) -> tuple[NDArray[Any], bool]:
    """Uneven longitudes as files have them, and whether they go around the Earth."""
    count, around = draw(st.integers(8, 70)), draw(st.booleans())
    rng = np.random.default_rng(draw(st.integers(0, 2**32)))
    steps = rng.uniform(1, 1.4, count)
    line = draw(st.floats(-180, 180)) + np.cumsum(steps) * (360 if around else draw(st.floats(1, 330))) / steps.sum()
    low = draw(st.sampled_from([None, 0.0, -180.0]))
    line = line if low is None else low + (line - low) % 360
    return (line[::-1] if draw(st.booleans()) else line).astype(draw(st.sampled_from(["f4", "f8"]))), around


@examples(20)
@given(longitudes(), st.integers(2, 40), st.integers(0, 2**32), st.booleans())
def test_nodes_over_uneven_longitudes_lie_at_places_of_the_source(
    line: tuple[NDArray[Any], bool], rows: int, seed: int, turned: bool
) -> None:
    xarray = pytest.importorskip("xarray")
    lon, around = line
    rng = np.random.default_rng(seed)
    lat = np.sort(rng.uniform(-80, 80, rows)).astype(lon.dtype)
    dims = ("lon", "lat") if turned else ("lat", "lon")
    heights = np.cumsum(rng.normal(size=(len(lon), rows) if turned else (rows, len(lon))), axis=0).astype("f4")
    east = ("lon", lon, {"units": "degrees_east", "standard_name": "longitude"})
    north = ("lat", lat, {"units": "degrees_north", "standard_name": "latitude"})
    surface = ls.Surface.from_xarray(xarray.Dataset({"z": (dims, heights)}, {"lon": east, "lat": north}).z)
    assert surface.points.ndim == 2
    assert any(surface.closed) == around
    decoder = decoder_of(surface)
    for level in range(header_of(decoder).levels + 1):
        at = dict(zip(dims, level_nodes(header_of(decoder), level)[0], strict=True))
        found = decoder.surface(level).to_xarray()
        assert found.x.values.tobytes() == lon[at["lon"]].astype(found.x.dtype).tobytes()
        assert found.y.values.tobytes() == lat[at["lat"]].astype(found.y.dtype).tobytes()


@pytest.mark.parametrize("turned", [False, True])
@pytest.mark.parametrize("start", [0, 1, 13, 35])
def test_a_window_of_a_whole_uneven_closed_axis_knows_the_step_across_its_seam(start: int, turned: bool) -> None:
    xarray = pytest.importorskip("xarray")
    lon = 10 * np.arange(36.0) + 3 * np.sin(np.arange(36) / 36 * 2 * np.pi)
    dims = ("lon", "lat") if turned else ("lat", "lon")
    heights = np.arange(36 * 9).reshape((36, 9) if turned else (9, 36)).astype("i4") * 7 % 101
    east = ("lon", lon, {"units": "degrees_east"})
    data = xarray.Dataset({"z": (dims, heights)}, {"lon": east, "lat": ("lat", np.arange(9.0) ** 2)})
    around, across = (start, start + 36), (0, 9)

    def part(decoder: ls.Decoder, columns: tuple[int, int]) -> ls.Surface:
        return decoder.view().window((columns, across) if turned else (across, columns))

    window = part(decoder_of(ls.Surface.from_xarray(data.z)), around)
    assert window.closed == (turned, not turned)
    assert len(window.metadata["axes"]["x"]) == 36 + 1 + 1  # a turn further, and what rule it is
    again = decoder_of(window)
    for columns in ((0, 36), (30, 40), (35, 71)):
        found = coordinates(part(again, columns))[0]
        places = start + np.arange(*columns)
        np.testing.assert_allclose(found[:, 0] if turned else found[0], lon[places % 36] + 360 * (places // 36))
