"""NetCDF classic has no unsigned integers: ``_Unsigned`` says which are, and fill values are stored like values."""

from __future__ import annotations

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
