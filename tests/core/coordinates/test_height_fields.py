"""Height fields: x and y that are a rule are found, left out, and made again bit for bit."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

import msgpack
import numpy as np
import pytest
from hypothesis import assume, given
from hypothesis import strategies as st
from numpy.typing import NDArray

from lodestream import Decoder, encode
from lodestream.coordinates.coordinate_rules import fit_axis
from lodestream.coordinates.height_fields import axes_at, coordinates, level_metadata, to_heights, to_xyz
from lodestream.errors import InputError
from lodestream.surface import Block, Surface

Array = NDArray[Any]

AXES: dict[str, Callable[[int], Array]] = {
    "indices": lambda n: np.arange(n, dtype=np.int32),
    "metres": lambda n: 500000.0 + 30.0 * np.arange(n),
    "downwards": lambda n: 4100000.0 - 30.0 * np.arange(n),
    "arange": lambda n: np.arange(n) * 0.1,
    "arange from": lambda n: np.arange(3.7, 3.7 + 0.3 * (n - 0.5), 0.3),
    "linspace": lambda n: np.linspace(-1.1, 2.7, n),
    "linspace float32": lambda n: np.linspace(-1.1, 2.7, n, dtype=np.float32),
    "centres": lambda n: 12.3 + (np.arange(n) + 0.5) * (1 / 1200),
    "decimals": lambda n: np.array([float(f"{234.0167 + 0.0333 * k:.4f}") for k in range(n)]),
    "parts of a degree": lambda n: (-21600 + np.arange(n)) / 120,
    "float32 of metres": lambda n: (431712.3 + 1.7 * np.arange(n)).astype(np.float32),
    "float32 of anything": lambda n: (math.pi + math.e / 7 * np.arange(n)).astype(np.float32),
    "one half": lambda n: np.arange(n) + 0.5,
}


def heights(shape: tuple[int, int], dtype: Any) -> Array:
    rng = np.random.default_rng(1)
    return (rng.normal(size=shape) * 100).astype(dtype)


def xyz(x: Array, y: Array, dtype: Any = None) -> Array:
    """Points over two axes."""
    x, y = np.meshgrid(x, y)
    dtype = dtype or np.result_type(x, y)
    return np.stack((x, y, heights(x.shape, dtype)), axis=-1).astype(dtype)


@pytest.mark.parametrize("x", AXES)
@pytest.mark.parametrize("y", ["downwards", "linspace", "float32 of anything", "centres"])
@pytest.mark.parametrize("n", [2, 3, 41, 300])
def test_even_axes_are_left_out_and_made_again(x: str, y: str, n: int) -> None:
    across, down = AXES[x](n), AXES[y](17)
    if across.dtype != down.dtype:
        across, down = (axis.astype(np.float32) for axis in (across, down))
    points = xyz(across, down)
    found = to_heights(Surface(points, metadata={"name": "a"}))
    assert found is not None
    assert (found.points.shape, found.dtype) == (points.shape[:2], points.dtype)
    assert found.points.tobytes() == points[..., 2].tobytes()
    added = len(msgpack.packb(found.metadata)) - len(msgpack.packb({"name": "a"}))
    assert added <= 50
    back = to_xyz(found)
    assert back.points.tobytes() == points.tobytes()
    assert (back.dtype, back.metadata) == (points.dtype, {"name": "a"})


@pytest.mark.parametrize("dtype", ["float64", "float32", "int32"])
def test_turned_lattices_are_found(dtype: str) -> None:
    column, row = np.meshgrid(np.arange(40.0), np.arange(30.0))
    x, y = column * 30 + row * 4 + 500000, column * 4 + row * -30 + 900000
    points = np.stack((x, y, heights(x.shape, np.float64)), axis=-1).astype(dtype)
    found = to_heights(Surface(points))
    assert found is not None
    assert len(msgpack.packb(found.metadata)) <= 64
    assert to_xyz(found).points.tobytes() == points.tobytes()


@pytest.mark.parametrize("x", ["arange", "metres", "decimals", "centres"])
def test_columns_may_run_along_y(x: str) -> None:
    points = xyz(AXES[x](31), AXES["downwards"](20)).transpose(1, 0, 2)
    found = to_heights(Surface(points))
    if x == "decimals":  # such a rule runs along its own axis only
        assert found is None
        return
    assert found is not None
    assert to_xyz(found).points.tobytes() == points.tobytes()


def test_holes_need_no_coordinates() -> None:
    points = xyz(AXES["linspace"](30), AXES["metres"](20))
    full = points.copy()
    points[:3, :5] = np.nan
    points[:, 7] = np.nan
    points[4] = np.nan
    points[9, 9, 2] = np.inf
    surface = Surface(points, attributes={"scan": np.arange(600).reshape(20, 30)})
    found = to_heights(surface)
    assert found is not None
    back = to_xyz(found)
    assert surface.mask is not None
    assert back.mask is not None
    assert np.array_equal(back.mask, surface.mask)
    assert back.points[surface.mask].tobytes() == full[surface.mask].tobytes()
    assert back.points[9, 9].tobytes() == points[9, 9].tobytes()  # an infinite height has a place
    surface.mask[9, 9] = True
    assert np.isnan(back.points[~surface.mask]).all()
    assert np.array_equal(back.attributes["scan"], surface.attributes["scan"])


def test_closed_heights_stay_closed() -> None:
    found = to_heights(Surface(xyz(np.arange(0.0, 360, 10), np.linspace(-80, 80, 17)), (False, True)))
    assert found is not None
    assert found.closed == (False, True)
    assert to_xyz(found).closed == (False, True)


def crooked() -> dict[str, Surface]:
    points = xyz(AXES["metres"](20), AXES["downwards"](10))
    moved = points.copy()
    moved[3, 4, 0] = np.nextafter(moved[3, 4, 0], np.inf)
    zero = xyz(np.arange(-5.0, 5), np.arange(10.0))
    zero[2, 5, 0] = -0.0
    uneven = xyz(np.arange(12.0) ** 2, np.arange(7.0))
    flat = xyz(np.full(12, 3.0), np.arange(7.0))
    return {
        "one bit": Surface(moved),
        "negative zero": Surface(zero),
        "uneven": Surface(uneven),
        "all the same": Surface(flat),
        "curve": Surface(points[:, :1]),
        "heights": Surface(points[..., 2]),
        "planar": Surface(points[..., :2]),
        "colours": Surface(np.concatenate((points, points), axis=2)),
        "blocks": Surface(blocks=[Block(points), Block(points)]),
    }


@pytest.mark.parametrize("name", list(crooked()))
def test_what_is_no_height_field_stays_as_it_is(name: str) -> None:
    surface = crooked()[name]
    assert to_heights(surface) is None
    if name != "heights":
        assert to_xyz(surface) is surface


@given(
    origin=st.floats(-1e7, 1e7),
    step=st.floats(1e-4, 1e4),
    count=st.integers(2, 400),
    down=st.booleans(),
)
def test_float32_axes_of_any_rule_are_found(origin: float, step: float, count: int, down: bool) -> None:
    step = max(step, abs(origin) * 2.0**-20) * (-1 if down else 1)
    axis = (origin + step * np.arange(count)).astype(np.float32) + np.float32(0)
    assume((axis[1:] != 0).all())  # nearly no line passes within the rounding of 0
    rule = fit_axis(axis)
    assert rule is not None, (origin, step, count)
    assert len(msgpack.packb(rule)) <= 20


@given(values=st.lists(st.floats(-1e300, 1e300), min_size=2, max_size=20))
def test_any_numbers_are_a_rule_or_none(values: list[float]) -> None:
    axis = np.array(values)
    rule = fit_axis(axis)
    if rule is not None:
        points = np.stack((*np.broadcast_arrays(axis, np.arange(2.0)[:, None]), np.zeros((2, len(axis)))), axis=-1)
        found = Surface(points[..., 2], metadata={"grid": [rule, [0, 1]]})
        assert to_xyz(found).points.tobytes() == points.tobytes(), (axis.tolist(), rule)


def test_heights_lie_at_the_centres_of_their_cells_or_at_their_indices() -> None:
    values = np.zeros((3, 4), np.int16)
    x, y = coordinates(Surface(values))
    assert (x.dtype.kind, y.dtype.kind) == ("i", "i")
    assert (x[2].tolist(), y[:, 1].tolist()) == ([0, 1, 2, 3], [0, 1, 2])
    x, y = coordinates(Surface(values, metadata={"geotransform": [100, 10, 0, 500, 0, -20]}))
    assert (x[0].tolist(), y[:, 0].tolist()) == ([105, 115, 125, 135], [490, 470, 450])
    axes: dict[str, Any] = {"x": [0.1, 0.1], "y": [7.0, 8.5, 11.0, "values"]}
    x, y = coordinates(Surface(values, metadata={"geotransform": [100, 10, 0, 500, 0, -20], "axes": axes}))
    assert x[0].tolist() == (np.arange(4) * 0.1 + 0.1).tolist()
    assert y[:, 3].tolist() == [7.0, 8.5, 11.0]
    turned = {"x": [1, 0.25], "y": [0.5, 8.5, 8.0, 7.5, "values"], "rows": "x", "dtype": "float32"}
    x, y = coordinates(Surface(values, metadata={"axes": turned}))
    assert (x.dtype.name, x[:, 2].tolist(), y[1].tolist()) == ("float32", [1, 1.25, 1.5], [0.5, 8.5, 8, 7.5])
    points = to_xyz(Surface(values, metadata={"axes": axes, "crs": "here"}))
    assert (points.dtype.name, points.metadata) == ("float64", {"crs": "here"})
    for metadata in (
        {"geotransform": [1, 2, 3]},
        {"grid": [[1], [2]]},
        {"axes": "none"},
        {"axes": [["a", "b"], [0, 1]]},
    ):
        with pytest.raises(InputError, match="expected"):
            coordinates(Surface(values, metadata=metadata))


@pytest.mark.parametrize("rows", ["y", "x"])
@pytest.mark.parametrize("rule", ["linspace", "decimals", "centres", "metres"])
def test_axes_of_windows_are_those_of_the_surface(rows: str, rule: str) -> None:
    x, y = AXES[rule](12), AXES[rule](9)
    axes: dict[str, Any] = {"x": [*x.tolist(), "values"], "y": fit_axis(y)}
    shape = (9, 12)
    if rows == "x":
        axes, shape = {"x": fit_axis(x), "y": [*y.tolist(), "values"], "rows": "x"}, (12, 9)
    window = axes_at(axes, shape, [np.arange(2, 7), np.arange(1, 6)])
    whole = coordinates(Surface(np.zeros(shape), metadata={"axes": axes}))
    for plane, part in zip(whole, coordinates(Surface(np.zeros((5, 5)), metadata={"axes": window})), strict=True):
        assert np.ascontiguousarray(plane[2:7, 1:6]).tobytes() == part.tobytes()


def test_metadata_of_levels_keep_the_rest_and_drop_the_seam() -> None:
    metadata = {
        "name": "a",
        "seam": "cols",
        "crs": "here",
        "axes": {"x": [0.0, 1.0, 4.0, 9.0, 16.0, "values"], "y": [0, 1, 0, 0.5]},
    }
    open_axes, columns = (False, False), np.array([0, 2, 4])
    level = level_metadata(metadata, (7, 5), open_axes, [np.array([0, 2, 4, 6]), columns])
    assert level["axes"]["x"] == [0.0, 4.0, 16.0, "values"]
    assert level["axes"]["y"] == [0, 2, 0, 0.25]
    assert not level.keys() & {"nodes", "geotransform", "seam"}
    assert (level["name"], level["crs"]) == ("a", "here")
    gapped = level_metadata({}, (6, 5), open_axes, [np.array([0, 2, 4, 5]), columns])
    assert gapped["nodes"] == [pytest.approx([0.0, 1.2, 2.4, 3.0]), None]
    x, y = coordinates(Surface(np.zeros((4, 3)), metadata=gapped))
    assert (x[0].tolist(), y[:, 0].tolist()) == ([0, 2, 4], pytest.approx([0, 2, 4, 5]))


def test_a_level_of_points_in_space_has_no_geotransform_of_its_indices() -> None:
    y, x = np.mgrid[0:97, 0:70].astype(np.float64)
    points = np.stack([500 + 2 * x, 1000 - 3 * y, np.hypot(x, y)], axis=-1)
    for metadata in ({"unit": "m"}, {"unit": "m", "geotransform": [499.0, 2.0, 0.0, 1001.5, 0.0, -3.0]}):
        decoder = Decoder()
        decoder.feed(encode(Surface(points, metadata=metadata)))
        for level in range(decoder.view().level):
            found = decoder.surface(level).metadata
            assert set(found) == set(metadata), level
    decoder = Decoder()
    decoder.feed(encode(Surface(points[..., 2])))
    assert decoder.surface(2).metadata["geotransform"][1] == pytest.approx(69 / 3)
