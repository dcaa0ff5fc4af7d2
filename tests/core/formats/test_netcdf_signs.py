"""NetCDF classic has no unsigned integers: ``_Unsigned`` says which are, and fill values are stored like values."""

from __future__ import annotations

import warnings
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import lodestream as ls

h5netcdf = pytest.importorskip("h5netcdf")
xarray = pytest.importorskip("xarray")


@pytest.mark.parametrize(
    ("stored", "said", "values"),
    [
        ("i2", "true", [[1, 2, 0], [30000, 65534, 35536]]),
        ("i1", "true", [[1, 2, 0], [127, 254, 128]]),
        ("u1", "false", [[1, 2, 0], [127, -2, -128]]),
        ("u2", "false", [[1, 2, 0], [30000, -2, -30000]]),
    ],
)
@pytest.mark.parametrize("scaled", [False, True])
def test_fill_values_are_stored_like_values(
    tmp_path: Path, stored: str, said: str, values: list[list[int]], scaled: bool
) -> None:
    bits = np.array(values).astype(stored)
    bits[0, 2] = np.array(-1).astype(stored)
    path = tmp_path / "goes.nc"
    with h5netcdf.File(path, "w") as file:
        file.dimensions = {"y": 2, "x": 3}
        variable = file.create_variable("c", ("y", "x"), stored, data=bits, fillvalue=bits[0, 2])
        variable.attrs["_Unsigned"] = said
        if scaled:
            variable.attrs["scale_factor"], variable.attrs["add_offset"] = np.float64(0.5), np.float64(-3)
    surface = ls.read(path)
    expected = np.array(values) * 0.5 - 3 if scaled else np.array(values)
    assert surface.mask is not None
    assert surface.mask.tolist() == [[True, True, False], [True, True, True]]
    assert np.array_equal(surface.points[surface.mask], expected[surface.mask])
    own: Any = xarray.open_dataset(path, engine="h5netcdf").c.values
    assert np.array_equal(np.isnan(own), ~surface.mask)
    assert np.array_equal(own[surface.mask], surface.points[surface.mask])


@pytest.mark.parametrize(
    ("stored", "unsigned", "limits", "missing"),
    [
        ("i1", True, {"valid_max": np.int16(-1)}, [False] * 4),
        ("i1", True, {"valid_min": np.int16(-1)}, [True, True, True, False]),
        ("i1", True, {"valid_min": np.int16(0), "valid_max": np.int16(-1)}, [False] * 4),
        ("i1", True, {"valid_range": np.array([0, -2], "i2")}, [False, False, False, True]),
        ("u1", False, {"valid_max": np.int16(-1)}, [False] * 4),
        ("u1", False, {"valid_min": np.int16(300)}, [False] * 4),
        ("u1", False, {"valid_range": np.array([-1, 254], "i2")}, [False, False, False, True]),
        ("u1", False, {"valid_max": np.float32(-1)}, [False] * 4),
        ("i1", False, {"valid_max": np.int16(-1)}, [True, True, False, False]),
    ],
)
def test_limits_of_another_type_mask_what_netcdf4_masks(
    tmp_path: Path, stored: str, unsigned: bool, limits: dict[str, Any], missing: list[bool]
) -> None:
    """The expected values are those of netCDF4 1.7.5."""
    with h5netcdf.File(tmp_path / "a.nc", "w") as file:
        file.dimensions = {"y": 2, "x": 4}
        values = np.array([[0, 1, -2, -1]] * 2).astype(stored)
        variable = file.create_variable("c", ("y", "x"), stored, data=values)
        variable.attrs.update(limits | ({"_Unsigned": "true"} if unsigned else {}))
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        surfaces = [ls.read(tmp_path / "a.nc")]
        with xarray.open_dataset(tmp_path / "a.nc", engine="h5netcdf") as data:
            surfaces.append(ls.Surface.from_xarray(data))
    for surface in surfaces:
        hidden = np.zeros((2, 4), np.bool_) if surface.mask is None else ~surface.mask
        assert hidden.tolist() == [missing] * 2


#: Attributes beside int16 that are unsigned, and which of 65533, 65534, 65535 and 0 are missing.
MISSING: dict[str, tuple[dict[str, Any], list[bool]]] = {
    "another type that holds the stored number": ({"_FillValue": np.int32(-1)}, [False, False, True, False]),
    "another type that holds the value": ({"_FillValue": np.int32(65535)}, [False, False, True, False]),
    "a float": ({"_FillValue": np.float64(-1)}, [False, False, True, False]),
    "a float of the value": ({"_FillValue": np.float64(65535)}, [False, False, True, False]),
    "no integer": ({"_FillValue": np.float64(0.5)}, [False] * 4),
    "beyond all integers": ({"_FillValue": np.float64(1e20)}, [False] * 4),
    "a missing value": ({"missing_value": np.int16(-2)}, [False, True, False, False]),
    "missing values": ({"missing_value": np.array([-2, -1], "i2")}, [False, True, True, False]),
    "both": ({"_FillValue": np.int16(-1), "missing_value": np.int16(-2)}, [False, True, True, False]),
    "several": ({"_FillValue": np.array([-1, -2], "i2")}, [False, True, True, False]),
    "a limit": ({"valid_max": np.int16(-2)}, [False, False, True, False]),
}

#: Those that xarray itself decodes otherwise, or not at all.
NOT_DECODED = ("no integer", "beyond all integers", "several")


@pytest.mark.parametrize("scaled", [False, True])
@pytest.mark.parametrize("case", MISSING)
def test_fill_values_of_any_number_and_type(tmp_path: Path, case: str, scaled: bool) -> None:
    said, missing = MISSING[case]
    path = tmp_path / "goes.nc"
    scale = {"scale_factor": np.float64(0.5)} if scaled else {}
    with h5netcdf.File(path, "w") as file:
        file.dimensions = {"y": 2, "x": 2}
        variable = file.create_variable("c", ("y", "x"), "i2", data=np.array([[-3, -2], [-1, 0]], "i2"))
        variable.attrs.update({"_Unsigned": "true", **said, **scale})
    values = np.array([65533, 65534, 65535, 0]) * (0.5 if scaled else 1)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # of xarray about several fill values, of ours about what is outside limits
        surfaces = {"file": ls.read(path)}
        surfaces["raw"] = ls.Surface.from_xarray(xarray.open_dataset(path, engine="h5netcdf", decode_cf=False))
        if case not in NOT_DECODED and not scaled:  # what was not masked before unpacking is no stored number any more
            surfaces["decoded"] = ls.Surface.from_xarray(xarray.open_dataset(path, engine="h5netcdf"))
    for surface in surfaces.values():
        mask = np.ones(4, np.bool_) if surface.mask is None else surface.mask.ravel()
        assert mask.tolist() == [not hole for hole in missing]
        assert np.array_equal(surface.points.ravel()[mask], values[mask])
        assert surface.dtype == (np.float64 if scaled else np.uint16)
