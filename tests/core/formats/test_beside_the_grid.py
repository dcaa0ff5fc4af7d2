"""What a Dataset has beside the grid: single numbers are kept, and one note names what is left out."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
import xarray as xr

import lodestream as ls

from .openers import Opener, by_netcdf, by_xarray, by_zarr, noted

EAST, NORTH = {"units": "degrees_east"}, {"units": "degrees_north"}

every_opener = pytest.mark.parametrize("opener", [by_netcdf, by_zarr, by_xarray])


def field(**more: Any) -> xr.Dataset:
    """Heights of 6 latitudes and 8 longitudes, and further variables."""
    values = np.arange(48, dtype="f4").reshape(6, 8)
    data = xr.Dataset(
        {"h": (("lat", "lon"), values)}, {"lat": ("lat", np.arange(6.0), NORTH), "lon": ("lon", np.arange(8.0), EAST)}
    )
    return data.assign(more)


def read(opener: Opener, data: xr.Dataset, folder: Path, **options: Any) -> tuple[ls.Surface, list[str]]:
    """Read as a user does who has chosen nothing but these options."""
    usual: dict[str, Any] = {"attributes": None} if opener is by_xarray else {}
    return noted(lambda: opener(data, folder, **usual | options))


@every_opener
def test_single_numbers_are_kept_and_go_back(tmp_path: Path, opener: Opener) -> None:
    more = {
        "nx": ((), np.int32(5)),
        "P0": ((), np.float32(1e5), {"units": "Pa", "long_name": "reference pressure", "levels": np.int16(3)}),
        "period": (("other",), np.array([0.25])),
        "ready": ((), np.int8(1), {"flag_values": np.array([0, 1], "i1")}),
    }
    surface, notes = read(opener, field(**more), tmp_path)
    assert notes == []
    assert surface.metadata["scalars"] == {"nx": 5, "P0": 1e5, "period": 0.25, "ready": 1}
    assert surface.metadata["tags"][""]["P0#units"] == "Pa"
    assert type(surface.metadata["scalars"]["nx"]) is int
    back = ls.decode(ls.encode(surface))
    for name in ("b.nc", "b.zarr"):
        ls.write(back, tmp_path / name)
        with xr.open_dataset(tmp_path / name) as written:
            assert written.P0.item() == 1e5
            assert written.P0.attrs == {"units": "Pa", "long_name": "reference pressure", "levels": 3}
            assert written.nx.item() == 5
        again = ls.read(tmp_path / name).metadata
        assert again["scalars"] == surface.metadata["scalars"]
        assert again["tags"] == surface.metadata["tags"]
    assert ls.Surface.from_xarray(back.to_xarray()).metadata["scalars"] == surface.metadata["scalars"]


@every_opener
def test_numbers_of_the_chosen_place_are_kept(tmp_path: Path, opener: Opener) -> None:
    values = np.arange(3 * 48.0).reshape(3, 6, 8)
    data = field(t=(("time", "lat", "lon"), values), co2=(("time",), np.array([280.0, 300.0, 420.0]), {"units": "ppm"}))
    data = data.drop_vars("h").assign_coords(time=("time", [0.0, 1.0, 2.0], {"units": "days since 2001-01-01"}))
    surface, notes = read(opener, data, tmp_path, time="2")
    assert notes == []
    assert surface.metadata["scalars"] == {"time": 2.0, "co2": 420.0}


@every_opener
def test_one_note_names_what_lies_elsewhere(tmp_path: Path, opener: Opener) -> None:
    more = {
        "lon_u": (("x_u",), np.arange(9.0) - 0.5, EAST),
        "profile": (("depth", "other"), np.zeros((3, 1))),
        "rows": (("lat",), np.arange(6.0) ** 2),
        "never": ((), np.float32(np.nan)),
        "depth": (("depth",), np.array([0.0, 10.0, 20.0])),
    }
    surface, notes = read(opener, field(**more), tmp_path)
    (note,) = notes
    head, names = note.split(": ", 1)
    assert head == "left out"
    assert set(names.split(", ")) == set(more)
    assert "scalars" not in surface.metadata


@every_opener
def test_the_note_is_short_however_much_there_is(tmp_path: Path, opener: Opener) -> None:
    more = {f"station_series_{k:02}": (("station",), np.zeros(4)) for k in range(39)}
    _, notes = read(opener, field(**more), tmp_path)
    (note,) = notes
    assert note.startswith("left out: station_series_00, ")
    assert note.endswith(" and 27 more")


@every_opener
@pytest.mark.parametrize("options", [{"variable": "h"}, {"attributes": "w"}, {"variable": "h", "attributes": "w"}])
def test_what_a_user_has_not_chosen_is_in_no_note(tmp_path: Path, opener: Opener, options: dict[str, str]) -> None:
    more = {"w": (("lat", "lon"), np.ones((6, 8))), "profile": (("depth",), np.zeros(3)), "nx": ((), 5)}
    data = field(**more) if "attributes" in options else field(**more).drop_vars("w")
    surface, notes = read(opener, data, tmp_path, **{"variable": "h", **options})
    assert notes == []
    assert surface.metadata["scalars"] == {"nx": 5}


@every_opener
def test_what_is_taken_up_otherwise_is_not_left_out(tmp_path: Path, opener: Opener) -> None:
    crs = {"grid_mapping_name": "latitude_longitude", "semi_major_axis": 6371229.0, "inverse_flattening": 0.0}
    data = field(crs=((), 0, crs), depth=((), 2.5, {"units": "m"}))
    data.h.attrs |= {"grid_mapping": "crs"}
    surface, notes = read(opener, data, tmp_path)
    assert notes == []
    assert surface.metadata["scalars"] == {"depth": 2.5}
    assert surface.metadata["crs"].startswith("GEOG")


@every_opener
def test_terms_of_a_formula_are_chosen_where_there_is_nothing_else(tmp_path: Path, opener: Opener) -> None:
    terms = {"standard_name": "ocean_s_coordinate_g2", "formula_terms": "s: s_rho eta: zeta depth: deep"}
    data = field(s_rho=(("s_rho",), np.linspace(-1, 0, 5), terms)).rename(h="zeta")
    surface, notes = read(opener, data, tmp_path)
    np.testing.assert_array_equal(surface.points, data.zeta.values)
    assert notes == ["left out: s_rho"]
    with pytest.raises(ls.FormatError, match=r"got (zeta, deep|deep, zeta): choose"):
        opener(data.assign(deep=data.zeta * 2), tmp_path)


def test_a_file_of_lodestream_says_nothing_of_itself(tmp_path: Path) -> None:
    surface, _ = read(by_xarray, field(nx=((), 5)), tmp_path)
    ls.write(surface, tmp_path / "a.nc")
    assert noted(lambda: ls.read(tmp_path / "a.nc"))[1] == []
    with xr.open_dataset(tmp_path / "a.nc") as data:
        data.load().assign(profile=(("depth",), np.zeros(3))).to_netcdf(tmp_path / "b.nc")
    assert noted(lambda: ls.read(tmp_path / "b.nc"))[1] == ["left out: profile"]


def many(count: int, **attributes: str) -> dict[str, Any]:
    """Single numbers with the same attributes."""
    return {f"constant_{k:03}": ((), 0.5 + k, attributes) for k in range(count)}


@every_opener
@pytest.mark.long
def test_single_numbers_give_way_to_coordinates(tmp_path: Path, opener: Opener) -> None:
    lon = np.linspace(0, 13, 6080) ** 2
    place = {"lat": ("lat", [0.0, 1.0, 3.0], NORTH), "lon": ("lon", lon, EAST)}
    more = many(80, long_name="a constant of the model", units="m s-1")
    data = xr.Dataset({"h": (("lat", "lon"), np.zeros((3, 6080), "f4")), **more}, place)
    surface, notes = read(opener, data, tmp_path)
    assert surface.points.shape == (3, 6080)
    assert surface.metadata["axes"]["x"][:-1] == lon.tolist()
    (note,) = notes
    assert note.startswith("metadata are limited to 65,536 bytes; left out: tags constant_000#long_name (47 bytes), ")
    assert len(surface.metadata["scalars"]) == 80
    assert ls.decode(ls.encode(surface)).metadata["axes"] == surface.metadata["axes"]


@every_opener
@pytest.mark.long
def test_a_dataset_of_very_many_numbers_keeps_the_first_and_its_crs(tmp_path: Path, opener: Opener) -> None:
    crs = {"grid_mapping_name": "latitude_longitude", "semi_major_axis": 6371229.0, "inverse_flattening": 0.0}
    data = field(crs=((), 0, crs), **many(100, long_name="a constant of a model, with a name", units="m s-1"))
    data.h.attrs |= {"grid_mapping": "crs"}
    surface, notes = read(opener, data, tmp_path, variable="h")
    kept = surface.metadata["scalars"]
    assert [*kept] == [f"constant_{k:03}" for k in range(len(kept))]
    assert 40 < len(kept) < 80
    (note,) = notes
    assert note.startswith(f"left out: constant_{len(kept):03}, ")
    assert note.endswith(f" and {100 - len(kept) - 12} more")
    back = ls.decode(ls.encode(surface)).metadata
    assert back["crs"].startswith("GEOG")
    assert back["scalars"] == kept


@every_opener
def test_a_limit_that_is_no_whole_number_is_noted(tmp_path: Path, opener: Opener) -> None:
    data = field()
    values = np.arange(48, dtype="i2").reshape(6, 8)
    data["h"] = (("lat", "lon"), values, {"valid_max": 20.5, "valid_min": -1e9})
    surface, notes = read(opener, data, tmp_path)
    assert notes == ["valid_max of h masks nothing, since it is no whole number of int16: '20.5'"]
    np.testing.assert_array_equal(surface.points, values)


@pytest.mark.parametrize("opener", [by_netcdf, by_xarray])  # Zarr has other rules for names
def test_numbers_whose_tags_would_be_taken_for_others_are_named(tmp_path: Path, opener: Opener) -> None:
    crs = {"grid_mapping_name": "latitude_longitude", "semi_major_axis": 6371229.0, "inverse_flattening": 0.0}
    more = {"p": ((), 1.0, {"q": "of p"}), "p#q": ((), 2.0, {"units": "m"}), "spatial_ref": ((), 3.0, {"units": "s"})}
    data = field(crs=((), 0, crs), **more)
    data.h.attrs |= {"grid_mapping": "crs"}
    for options in ({}, {"variable": "h"}):
        surface, (note,) = read(opener, data, tmp_path, **options)
        head, names = note.split(": ")
        assert (head, {*names.split(", ")}) == ("left out", {"p#q", "spatial_ref"})
        assert surface.metadata["scalars"] == {"p": 1.0}
        assert {key for key in surface.metadata["tags"][""] if key[0] in "ps"} == {"p#q"}


def test_blocks_keep_the_numbers_on_which_all_agree() -> None:
    first = field(nx=((), 5, {"units": "1"}), t=((), 1.0, {"units": "s"}), only=((), 3), same=((), 4, {"units": "m"}))
    second = field(nx=((), 5, {"units": "1"}), t=((), 2.0, {"units": "s"}), more=((), 3), same=((), 4, {"units": "km"}))
    tree = xr.DataTree.from_dict({"a": first, "b": second})
    surface, notes = noted(lambda: ls.Surface.from_xarray(tree))
    assert notes == ["left out, since they are not the same in all blocks: t, only, same, more"]
    assert surface.metadata["scalars"] == {"nx": 5}
    assert {key for key in surface.metadata["tags"][""] if key[0] in "nts"} == {"nx#units"}
    again, notes = noted(lambda: ls.Surface.from_xarray(surface.to_xarray()))
    assert notes == []
    assert again.metadata["scalars"] == {"nx": 5}
    bare, notes = noted(
        lambda: ls.Surface.from_xarray(xr.DataTree.from_dict({"a": field(t=((), 1, {"a": 1})), "b": field(t=((), 2))}))
    )
    assert not {"scalars", "types"} & set(bare.metadata)
    assert len(notes) == 1


@pytest.mark.parametrize("encoding", [{}, {"dtype": "i2", "_FillValue": -1}])
def test_a_number_that_cannot_be_computed_is_noted(encoding: dict[str, Any]) -> None:
    array = pytest.importorskip("dask.array")
    delayed = pytest.importorskip("dask").delayed

    def fail() -> None:
        raise OSError("the disk is gone")

    number = xr.Variable((), array.from_delayed(delayed(fail)(), (), "f8"))
    number.encoding = encoding
    surface, notes = noted(lambda: ls.Surface.from_xarray(field(bad=number, nx=((), 5))))
    assert notes == ["left out, since they cannot be read: bad (the disk is gone)"]
    assert surface.metadata["scalars"] == {"nx": 5}


def test_a_dataset_in_memory_with_700_numbers_is_encoded() -> None:
    data = field(**many(700, long_name="a constant of a model, with a name", units="m s-1"))
    surface, (note,) = noted(lambda: ls.Surface.from_xarray(data))
    assert note.endswith(f" and {700 - len(surface.metadata['scalars']) - 12} more")
    assert ls.decode(ls.encode(surface)).metadata["scalars"] == surface.metadata["scalars"]
