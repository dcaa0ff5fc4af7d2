"""Units, directions, longitudes, poles and the rest: a place of each, and the height that is expected there."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import pyproj
import pytest

import lodestream as ls
from lodestream.errors import InputError, OptionError
from lodestream.maps import HeightField, crs_wkt, layer_json, mesh_tile, tile_json, web_tile
from lodestream.maps.tile_grids import box_of_mesh, box_of_web

from .fields import at, decoded, degrees, field_of, image, on_earth, pixel_of, utm
from .mesh_reader import read_mesh

ROWS, COLUMNS = np.mgrid[0:21.0, 0:40.0]
HILL = 100 * ROWS + COLUMNS  # each node has a height of its own


@dataclass(frozen=True)
class Case:
    """A field, and what is expected at places: longitude, latitude, metres; NaN for none."""

    name: str
    make: Callable[[], HeightField]
    places: tuple[tuple[float, float, float], ...]
    levels: tuple[int, ...] = (-1,)  # from the finest down; all of them give these heights
    within: float = field(default=1e-3)


def _global(first: float, rows: int = 181) -> HeightField:
    """Whole degrees around the Earth with nodes at both poles: the height is the longitude, and 1000 x the latitude."""
    longitudes = first + np.arange(360.0)
    latitudes = 90 - 180 / (rows - 1) * np.arange(rows)
    heights = 1000 * latitudes[:, None] + longitudes[None, :] % 360
    surface = ls.Surface(heights, (False, True))
    return field_of(surface, degrees(first, 90, 1))


def _cells_at_the_poles() -> HeightField:
    """Thirds of a degree, of which rounded numbers leave 5e-8 degrees at each pole, from the south, from 20 to 380."""
    south_up = [20.00000005, 0.3333333, 0.0, -89.99999995, 0.0, 0.3333333]
    latitudes, longitudes = np.mgrid[0:540, 0:1080] / 3 + np.array([-90 + 1 / 6, 20 + 1 / 6])[:, None, None]
    heights = (1000 * latitudes + longitudes % 360).astype(np.float32)
    return field_of(ls.Surface(heights, (False, True)), {"crs": crs_wkt("EPSG:4326"), "geotransform": south_up})


def _across_the_dateline() -> HeightField:
    return field_of(HILL, degrees(170, 10, 0.5))


def _uneven_latitudes() -> HeightField:
    """Latitudes as of a Gaussian grid, listed."""
    latitudes = np.degrees(np.arcsin(np.linspace(0.9, -0.9, 21)))
    axes = {"x": [float(x) for x in range(40)] + ["values"], "y": [*latitudes.tolist(), "values"]}
    return field_of(HILL, {"crs": crs_wkt("EPSG:4326"), "axes": axes})


def _slope(shape: tuple[int, int], metadata: dict[str, Any]) -> HeightField:
    """A plane, which every level has exactly, so that nodes that are taken for even show."""
    rows, columns = np.mgrid[0 : shape[0], 0 : shape[1]]
    return field_of((5.0 * rows + 3.0 * columns).astype(np.float32), metadata)


def _polar() -> HeightField:
    """Around the north pole, 50 km, in the polar stereographic projection: the height is the colatitude x 1000."""
    steps = 50000.0 * np.arange(-40, 41)
    y, x = np.meshgrid(-steps, steps, indexing="ij")
    latitudes = np.vectorize(lambda x, y: on_earth("EPSG:3413", x, y)[1])(x, y)
    return field_of((1000 * (90 - latitudes)).astype(np.float32), utm("EPSG:3413", -2e6, 2e6, 50000))


def _by_latitude(code: str, x: float, y: float, step: float, shape: tuple[int, int]) -> HeightField:
    """A grid in another projection, with 100 m for each degree of latitude, and holes where there is no Earth."""
    projection = pyproj.Transformer.from_crs(code, "EPSG:4326", always_xy=True)
    columns, rows = np.meshgrid(x + step * np.arange(shape[1]), y - step * np.arange(shape[0]))
    heights = 100 * projection.transform(columns, rows, errcheck=False)[1]
    heights[~np.isfinite(heights)] = np.nan
    place = [x - step / 2, step, 0, y + step / 2, 0, -step]
    return field_of(heights.astype(np.float32), {"crs": pyproj.CRS(code).to_wkt(), "geotransform": place})


def _level_of_another(metadata: dict[str, Any], closed: bool) -> ls.Surface:
    """A coarser level of a slope as a surface of its own, whose nodes are not even."""
    rows, columns = np.mgrid[0:43, 0:75]
    slope = ls.Surface((5.0 * rows + 3.0 * columns).astype(np.float32), (False, closed), metadata=dict(metadata))
    decoder = ls.Decoder()
    decoder.feed(ls.encode(slope))
    assert decoder.header is not None
    coarse = decoder.surface(decoder.header.levels - 2)
    assert "nodes" in coarse.metadata
    return coarse


def _rotated() -> HeightField:
    """Columns run to the north-east, rows to the south-east."""
    return field_of(HILL, {"crs": crs_wkt("EPSG:32633"), "geotransform": [5e5, 70, 70, 5e6, 70, -70]})


def _points() -> HeightField:
    points = np.stack((10 + COLUMNS / 8, 50 - ROWS / 8, HILL), axis=-1)
    return field_of(ls.Surface(points), {"crs": crs_wkt("EPSG:4326")})


def _sideways() -> HeightField:
    """x runs along the rows."""
    axes = {"x": [10.0, 0.125], "y": [50.0, 0.125], "rows": "x"}
    return field_of(HILL, {"crs": crs_wkt("EPSG:4326"), "axes": axes})


def _with_hole() -> HeightField:
    heights = HILL.copy()
    heights[5:12, 10:20] = np.nan
    return field_of(heights, degrees(10, 50, 0.125))


HERE = degrees(10, 50, 0.125)
FAR_UTM = utm("EPSG:32633", 500000, 5000000, 90)
WEST_UTM = utm("EPSG:32601", 140000, 1000000, 1000)  # begins west of the dateline


def _utm_place(metadata: dict[str, Any], code: str, row: float, column: float) -> tuple[float, float]:
    x, step, _, y, _, down = metadata["geotransform"]
    return on_earth(code, x + (column + 0.5) * step, y + (row + 0.5) * down)


CASES = (
    Case("metres are what is meant where nothing is said", lambda: field_of(HILL, HERE), ((10.25, 49.5, 402.0),)),
    Case("between nodes it is bilinear", lambda: field_of(HILL, HERE), ((10.3125, 49.4375, 452.5),)),
    Case("feet by the unit", lambda: field_of(HILL, HERE | {"unit": "ft"}), ((10.25, 49.5, 402 * 0.3048),)),
    Case(
        "feet by a compound CRS, whatever the unit says",
        lambda: field_of(HILL, degrees(10, 50, 0.125, "EPSG:4326+6360") | {"unit": "m"}),
        ((10.25, 49.5, 402 * 1200 / 3937),),
    ),
    Case(
        "depths downwards by a compound CRS",
        lambda: field_of(HILL, degrees(10, 50, 0.125, "EPSG:4326+5715")),
        ((10.25, 49.5, -402.0),),
    ),
    Case("depths downwards by scale=", lambda: field_of(HILL, HERE, scale=-1), ((10.25, 49.5, -402.0),)),
    Case(
        "numbers as a GeoTIFF stores them",
        lambda: field_of(HILL.astype(np.int16), HERE | {"scale": 0.5, "offset": -7.0, "unit": "cm"}),
        ((10.25, 49.5, (402 * 0.5 - 7) / 100),),
    ),
    Case(
        "0 to 360 degrees",
        lambda: _global(0),
        ((-10, 20, 20350.0), (350, 20, 20350.0), (-0.5, 20, 20179.5), (-180, -20, -19820.0), (180, -20, -19820.0)),
    ),
    Case("20 to 380 degrees, and nodes at the poles", lambda: _global(20), ((10, 90, 90010.0), (19.0, -90, -89981.0))),
    Case(
        "cells at the poles, a geotransform that ends before them, from the south",
        _cells_at_the_poles,
        ((20 + 1 / 6, 90, 89833.333 + 20.167), (0.5, -90, -89833.333 + 0.5), (-179.5, 0.5, 500 + 180.5)),
        within=0.2,  # of degrees in which the geotransform is rounded, times 1000
    ),
    Case(
        "across the dateline",
        _across_the_dateline,
        (
            (175, 5, 1010.0),
            (180, 5, 1020.0),
            (-180, 5, 1020.0),
            (-175, 5, 1030.0),
            (0, 5, math.nan),
            (165, 5, math.nan),
        ),
    ),
    Case(
        "UTM",
        lambda: field_of(HILL, FAR_UTM),
        ((*_utm_place(FAR_UTM, "EPSG:32633", 7, 31), 731.0), (15, 50, math.nan), (-165, 0, math.nan)),
    ),
    Case(
        "UTM across the dateline",
        lambda: field_of(HILL, WEST_UTM),
        tuple((*_utm_place(WEST_UTM, "EPSG:32601", 7, column), 700.0 + column) for column in (0, 20, 39)),
    ),
    Case(
        "uneven nodes of coarser levels: neither 42 rows nor 74 columns can be halved often",
        lambda: _slope((43, 75), FAR_UTM),
        tuple(
            (*_utm_place(FAR_UTM, "EPSG:32633", row, column), 5.0 * row + 3.0 * column)
            for row, column in ((0, 0), (42, 74), (41, 73), (37.5, 66.25), (21, 30), (2, 70))
        ),
        levels=(-1, -2, -3, -4),
    ),
    Case(
        "a level that was decoded and encoded as a surface, with uneven nodes",
        lambda: field_of(_level_of_another(FAR_UTM, False)),
        tuple(
            (*_utm_place(FAR_UTM, "EPSG:32633", row, column), 5.0 * row + 3.0 * column)
            for row, column in ((0, 0), (42, 74), (41, 73), (37.5, 66.25), (21, 30), (2, 70))
        ),
    ),
    Case("uneven latitudes, listed", _uneven_latitudes, ((7, math.degrees(math.asin(0.36)), 607.0), (0, 70, math.nan))),
    Case("a projection around the pole", _polar, ((0, 90, 0.0), (-45, 89, 1000.0), (135, 75.5, 14500.0)), within=30),
    Case(
        "a disk seen from space, with corners beside the Earth",
        lambda: _by_latitude("+proj=geos +h=35786023 +lon_0=-75 +sweep=x", -5.5e6, 5.5e6, 1e5, (111, 111)),
        ((-75, 0, 0.0), (-80, 30.5, 3050.0), (-40, -20, -2000.0), (105, 0, math.nan), (-75, 86, math.nan)),
        within=3,
    ),
    Case(
        "a projection of the whole Earth whose edge is at 150 degrees west",
        lambda: _by_latitude("+proj=eqearth +lon_0=30", -1.73e7, 8.4e6, 1e5, (169, 347)),
        ((30, 0, 0.0), (-149, 10, 1000.0), (-151, 10, 1000.0), (180, -45, -4500.0), (-180, 60, 6000.0)),
        within=3,
    ),
    Case(
        "Mercator around 150 degrees east, across the dateline",
        lambda: _by_latitude("EPSG:3832", 2.8e6, 1e6, 1e4, (100, 120)),
        ((175.5, 8, 800.0), (180, 2, 200.0), (-178, 5, 500.0), (-4, 5, math.nan), (150, 5, math.nan)),
        within=0.5,
    ),
    Case(
        "a rotated pole, with the Earth's pole inside",
        lambda: _by_latitude(
            "+proj=ob_tran +o_proj=longlat +o_lon_p=0 +o_lat_p=39.25 +lon_0=18", -60, 55, 1, (90, 120)
        ),
        ((18, 50.75, 5075.0), (18, 90, 9000.0), (-100, 88.5, 8850.0), (60, 70, 7000.0)),
        within=50,
    ),
    Case("a rotated grid", _rotated, ((*on_earth("EPSG:32633", 5e5 + 70 * 13, 5e6), 606.0),)),
    Case("points whose x and y follow a rule", _points, ((10.25, 49.5, 402.0),)),
    Case("x along the rows", _sideways, ((10.5, 50.25, 402.0),)),
    Case(
        "holes, and beside them what has values",
        _with_hole,
        ((10 + 15 / 8, 49, math.nan), (10 + 9.3 / 8, 49, 809.3), (10 + 9.7 / 8, 49, math.nan), (10 + 9 / 8, 49, 809.0)),
        within=0.4,
    ),
    Case(
        "half a cell beyond the outer nodes, and no further",
        lambda: field_of(HILL, HERE),
        ((9.94, 50.06, 0.0), (9.93, 50, math.nan), (10, 50.07, math.nan), (14.93, 47.44, 2039.0)),
    ),
)


@pytest.mark.parametrize("case", CASES, ids=lambda case: case.name)
@pytest.mark.long
def test_the_height_at_a_place(case: Case) -> None:
    made = case.make()
    for level in case.levels:
        found = [at(made, x, y, level=made.levels + 1 + level) for x, y, _ in case.places]
        np.testing.assert_allclose(found, [height for *_, height in case.places], rtol=0, atol=case.within)


def test_a_level_around_the_earth_as_a_surface_has_a_shorter_step_over_the_seam() -> None:
    coarse = _level_of_another({"crs": HERE["crs"], "geotransform": [7.6, 4.8, 0, 50.5, 0, -1]}, True)
    made = field_of(coarse)
    columns = [*range(0, 73, 4)]
    assert coarse.shape[1] == len(columns)
    for number, column in enumerate(columns):
        assert at(made, 10 + 4.8 * column, 30) == pytest.approx(float(coarse.points[5, number]))
    over = (float(coarse.points[5, -1]) + float(coarse.points[5, 0])) / 2
    assert at(made, 10 + 4.8 * 73.5, 30) == pytest.approx(over)


@pytest.mark.parametrize("case", CASES, ids=lambda case: case.name)
@pytest.mark.long
def test_a_tile_has_the_height_too_and_the_bounds_have_the_place(case: Case) -> None:
    made = case.make()
    z = made.placement.web_zoom() + 1
    west, south, east, north = made.bounds
    for longitude, latitude, height in case.places:
        if math.isnan(height) or abs(latitude) > 85:
            continue
        assert (longitude - west) % 360 <= east - west + 1e-9
        assert south <= latitude <= north
        column, row = (int(place % (256 << z)) for place in np.rint(pixel_of(longitude, latitude, z)))
        tile = decoded(web_tile(made, z, column // 256, row // 256, encoding="terrarium"), "terrarium")
        centre = at(made, (column + 0.5) / (256 << z) * 360 - 180, _latitude(row, z))
        beside = [tile[np.clip(row % 256 + i, 0, 255), np.clip(column % 256 + j, 0, 255)] for i, j in _AROUND]
        # Positions of a tile are exact to a hundredth of a pixel.
        assert abs(tile[row % 256, column % 256] - centre) < 0.01 + 0.01 * np.ptp(beside)


_AROUND = [(i, j) for i in (-1, 0, 1) for j in (-1, 0, 1)]


def _latitude(row: int, z: int) -> float:
    return math.degrees(math.atan(math.sinh(math.pi * (1 - 2 * (row + 0.5) / (256 << z)))))


@pytest.mark.long
def test_whole_tiles_of_the_first_zooms_around_the_earth() -> None:
    for made in (_global(0), _global(20), _cells_at_the_poles()):
        for z in range(made.placement.web_zoom() + 2):
            for x in range(1 << z):
                for y in range(1 << z):
                    pixels = image(web_tile(made, z, x, y, encoding="shade"))
                    assert (pixels[..., 1] == 255).all(), (z, x, y)


def test_holes_have_the_height_that_is_asked_for_and_never_the_lowest() -> None:
    made = _with_hole()
    z = made.placement.web_zoom() + 1
    column, row = (int(place) for place in pixel_of(10 + 15 / 8, 49, z))
    for nodata in (0.0, -12.5, 4000.0):
        for encoding in ("terrain-rgb", "terrarium"):
            tile = decoded(web_tile(made, z, column // 256, row // 256, encoding=encoding, nodata=nodata), encoding)
            assert abs(tile[row % 256, column % 256] - nodata) < 1e-6
    lowest = image(web_tile(made, z, column // 256, row // 256, encoding="terrarium", nodata=-32768))
    assert lowest[row % 256, column % 256].tolist() == [0, 0, 1]
    with pytest.raises(OptionError, match="expected a height for holes"):
        web_tile(made, 0, 0, 0, nodata=math.nan)


def test_the_offset_of_a_geoid_is_added_to_meshes() -> None:
    made = _with_hole()
    z = made.placement.mesh_zoom()
    x, y = int((12 + 180) / 180 * 2**z), int((48 + 90) / 180 * 2**z)
    plain = read_mesh(mesh_tile(made, z, x, y)).heights
    higher = read_mesh(mesh_tile(made, z, x, y, offset=47.25)).heights
    np.testing.assert_allclose(higher, plain + 47.25, rtol=0, atol=0.04)
    assert np.ptp(plain) > 1
    with pytest.raises(OptionError, match="an offset in metres"):
        mesh_tile(made, z, x, y, offset=math.inf)


@pytest.mark.parametrize(
    ("surface", "metadata", "words"),
    [
        (HILL, {"geotransform": HERE["geotransform"]}, "got none: encode with --crs"),
        (HILL, {"crs": HERE["crs"]}, "expected heights with a position"),
        (HILL, HERE | {"unit": "K"}, "got the unit 'K': say what it is by scale="),
        (HILL, HERE | {"scale": "twice"}, "expected numbers as scale and offset"),
        (HILL, HERE | {"crs": "PROJCS[nothing]"}, "expected a CRS that PROJ understands"),
        (HILL, HERE | {"crs": 'LOCAL_CS["mine",UNIT["metre",1]]'}, "can place on the Earth"),
        (HILL, HERE | {"geotransform": [0, 0, 0, 0, 0, 0]}, "coordinates that differ from node to node"),
        (HILL, HERE | {"crs": crs_wkt("EPSG:4978")}, "is of type Geocentric CRS"),
        (HILL, HERE | {"crs": crs_wkt("EPSG:5773")}, "is of type Vertical CRS"),
        (HILL, HERE | {"nodes": [[0, 1], None]}, "ascend or descend along each axis"),
        (HILL, HERE | {"nodes": "even"}, "expected nodes of rows and of columns"),
        (HILL, utm("EPSG:32611", 1e12, 1e12, 30), "expected a position on the Earth in the CRS"),
        (HILL, HERE | {"geotransform": ["a", 1, 0, 0, 0, 1]}, "expected two rules of coordinates"),
        (HILL, {"crs": HERE["crs"], "axes": {"x": [1, "values"], "y": [0, 1]}}, "ascend or descend along each axis"),
        (HILL, {"crs": HERE["crs"], "axes": {"x": [0, 1]}}, "expected two rules of coordinates"),
        (np.zeros((4, 4, 3)) + np.random.default_rng(0).random((4, 4, 3)), HERE, "got points with an x and a y"),
    ],
)
def test_what_has_no_place_on_a_map(surface: object, metadata: dict[str, object], words: str) -> None:
    with pytest.raises(InputError, match=words):
        field_of(surface, metadata)


def test_a_scale_that_is_none_and_a_unit_that_is_said() -> None:
    assert at(field_of(HILL, HERE | {"unit": "K"}, scale=2.0), 10.25, 49.5) == 804
    with pytest.raises(OptionError, match="expected a scale that is not 0"):
        field_of(HILL, HERE, scale=0)


def test_tiles_outside_are_flat_or_transparent() -> None:
    made = field_of(HILL, FAR_UTM)
    inside = tuple(int(place) // 256 for place in pixel_of(15.02, 45.14, 9))
    for z, x, y in ((9, *inside), (6, 3, 40), (9, 0, 511)):
        outside = (x, y) != inside
        assert made.placement.meets(box_of_web(z, x, y)) != outside
        shade = image(web_tile(made, z, x, y, encoding="shade"))
        assert (shade[..., 1] == 0).all() == outside
        if outside:
            heights = decoded(web_tile(made, z, x, y), "terrain-rgb")
            assert (np.abs(heights) < 1e-6).all()
            assert len(web_tile(made, z, x, y)) < 2000
    assert not made.placement.meets(box_of_mesh(3, 2, 2))
    assert (read_mesh(mesh_tile(made, 3, 2, 2)).heights == 0).all()


def test_tiles_that_no_scheme_has_are_refused() -> None:
    made = field_of(HILL, HERE)
    for z, x, y in ((0, 1, 0), (0, 0, -1), (3, 8, 0), (-1, 0, 0)):
        with pytest.raises(OptionError, match=r"expected a (tile|zoom)"):
            web_tile(made, z, x, y)
    for z, x, y in ((0, 2, 0), (2, 0, 4), (-1, 0, 0)):
        with pytest.raises(OptionError, match=r"expected a (tile|zoom)"):
            mesh_tile(made, z, x, y)


def test_one_zoom_beyond_the_data_is_made_and_no_more() -> None:
    made = field_of(HILL, HERE)
    z = made.placement.web_zoom() + 1
    column, row = (int(place) for place in pixel_of(10.3125, 49.4375, z))
    with pytest.raises(OptionError, match=f"expected a zoom of 0 to {z} for these heights, got {z + 1}"):
        web_tile(made, z + 1, column // 128, row // 128)
    assert len(web_tile(made, z, column // 256, row // 256)) > 1000
    with pytest.raises(OptionError, match=f"expected a zoom of 0 to {z - 1} for these heights"):
        web_tile(made, z, column // 512, row // 512, size=512)
    mesh = made.placement.mesh_zoom() + 1
    with pytest.raises(OptionError, match=f"expected a zoom of 0 to {mesh} for these heights"):
        mesh_tile(made, mesh + 1, 0, 0)
    assert tile_json(made, "")["maxzoom"] == z - 1
    assert layer_json(made, "")["maxzoom"] == mesh - 1
