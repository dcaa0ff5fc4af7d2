"""``--each`` of `encode` and `push`: a surface for each step or variable of a file, as a series."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import xarray
from numpy.typing import NDArray

import lodestream as ls
from lodestream_client import Client

from ..conftest import Run

STEPS, ROWS, COLUMNS = 3, 12, 17
DATES = ["2001-01-31T00:00", "2001-02-28T06:00", "2001-03-31T12:00"]


def values(of: int) -> NDArray[np.float32]:
    """Heights (step, row, column)."""
    return np.random.default_rng(of).normal(size=(STEPS, ROWS, COLUMNS)).astype("f4")


@pytest.fixture
def dataset() -> xarray.Dataset:
    dims = ("time", "lat", "lon")
    return xarray.Dataset(
        {"air": (dims, values(1), {"units": "K"}), "wind": (dims, values(2), {"units": "m s-1"})},
        coords={
            "time": ("time", np.array(DATES, "M8[ns]")),
            "lat": ("lat", np.linspace(-30.0, 30.0, ROWS), {"units": "degrees_north"}),
            "lon": ("lon", np.linspace(0.0, 60.0, COLUMNS), {"units": "degrees_east"}),
        },
    )


def decoded(folder: Path) -> list[ls.Surface]:
    """The surfaces of the containers of a folder, by their index."""
    surfaces = [ls.decode(path.read_bytes()) for path in folder.iterdir()]
    return sorted(surfaces, key=lambda surface: int(surface.metadata["series"]["index"]))


def heights(surface: ls.Surface) -> NDArray[Any]:
    points = surface.points
    return points if points.ndim == 2 else points[..., 2]


@pytest.mark.parametrize("suffix", ["nc", "zarr"])
@pytest.mark.filterwarnings("ignore::zarr.errors.ZarrUserWarning")
def test_each_step_is_a_container_with_its_place(
    run: Run, dataset: xarray.Dataset, tmp_path: Path, suffix: str
) -> None:
    file, folder = tmp_path / f"day.{suffix}", tmp_path / "steps"
    encoding = {"time": {"units": "hours since 2001-01-01", "dtype": "f8"}}
    if suffix == "nc":
        dataset.to_netcdf(file, encoding=encoding)
    else:
        dataset.to_zarr(file, encoding=encoding, consolidated=False)
    code, stdout, stderr = run("encode", file, "--each", f"time={folder}", "-o", "variable=air")
    assert (code, stdout) == (0, "")
    assert stderr.count(" points, ") == STEPS
    names = [date.replace(":", "-") for date in DATES]
    assert sorted(path.name for path in folder.iterdir()) == [f"{name}.lode" for name in names]
    for index, surface in enumerate(decoded(folder)):
        np.testing.assert_array_equal(heights(surface), values(1)[index])
        hours = (np.datetime64(DATES[index]) - np.datetime64("2001-01-01")) / np.timedelta64(1, "h")
        assert surface.metadata["series"] == {
            "name": "day air",
            "along": "time",
            "index": index,
            "value": hours,
            "unit": "hours since 2001-01-01",
        }
        assert surface.metadata["name"] == f"day air {DATES[index]}"


def test_each_variable_is_a_container_and_options_hold_for_all(
    run: Run, dataset: xarray.Dataset, tmp_path: Path
) -> None:
    file, folder = tmp_path / "day.nc", tmp_path / "variables"
    dataset.to_netcdf(file)
    code, stdout, _ = run("encode", "--each", f"variable={folder}", file, "-o", "time=1", "--name", "D", "--json")
    told = json.loads(stdout)
    assert (code, told["failed"]) == (0, [])
    assert [it["out"] for it in told["surfaces"]] == [str(folder / "air.lode"), str(folder / "wind.lode")]
    for index, (name, unit) in enumerate([("air", "K"), ("wind", "m s-1")]):
        surface = ls.decode((folder / f"{name}.lode").read_bytes())
        np.testing.assert_array_equal(heights(surface), values(index + 1)[1])
        expected = {"name": "D", "along": "variable", "index": index, "value": name, "unit": unit}
        assert surface.metadata["series"] == expected
        assert surface.metadata["name"] == f"D {name}"


def test_each_variable_has_the_places_along_the_dimensions_that_it_has(
    run: Run, dataset: xarray.Dataset, tmp_path: Path
) -> None:
    file, folder = tmp_path / "day.nc", tmp_path / "variables"
    dataset["bed"] = (("lat", "lon"), values(3)[0])
    dataset["salt"] = (("time", "depth", "lat", "lon"), np.stack([values(4), values(5)], axis=1))
    dataset["layer"] = (("depth", "lat", "lon"), values(6)[:2])
    dataset.to_netcdf(file)
    code, _, stderr = run("encode", file, "--each", f"variable={folder}", "-o", f"time={DATES[2]}", "-o", "at=depth:1")
    assert code == 0, stderr
    shown = {surface.metadata["series"]["value"]: heights(surface) for surface in decoded(folder)}
    expected = {"air": values(1)[2], "wind": values(2)[2], "bed": values(3)[0], "salt": values(5)[2]}
    expected["layer"] = values(6)[1]
    assert shown.keys() == expected.keys()
    for name, array in expected.items():
        np.testing.assert_array_equal(shown[name], array)
    code, _, stderr = run("encode", file, "--each", f"variable={folder}", "-o", "at=level:1")
    assert (code, "expected -o at= with one of depth, lat, lon, time, got 'level'" in stderr) == (1, True), stderr


def test_steps_along_any_dimension_with_or_without_a_coordinate(run: Run, tmp_path: Path) -> None:
    array = np.random.default_rng(3).normal(size=(2, 3, ROWS, COLUMNS))
    for number, coords in enumerate([{}, {"level": ("level", [1000.0, 1000.0, 500.5], {"units": "hPa"})}]):
        file, folder = tmp_path / f"levels-{number}.nc", tmp_path / f"levels-{number}"
        xarray.Dataset({"t": (("member", "level", "row", "column"), array)}, coords=coords).to_netcdf(file)
        code, _, stderr = run("encode", file, "--each", f"level={folder}", "-o", "at=member:1")
        assert (code, stderr.count(" points, ")) == (0, 3)
        surfaces = decoded(folder)
        for index, surface in enumerate(surfaces):
            np.testing.assert_array_equal(heights(surface), array[1, index])
        places = [(it.metadata["series"]["value"], it.metadata["series"]["unit"]) for it in surfaces]
        assert places == ([(1000.0, "hPa"), (1000.0, "hPa"), (500.5, "hPa")] if coords else [(0, ""), (1, ""), (2, "")])
        expected = ["1000-hPa-0", "1000-hPa-1", "500.5-hPa"] if coords else ["level-0", "level-1", "level-2"]
        assert sorted(path.stem for path in folder.iterdir()) == expected


@pytest.mark.parametrize(
    ("places", "names"),
    [
        ([-5.0, 5.0, 0.0], ["level=-5-m", "5-m", "0-m"]),
        ([-5, 5, 0], ["level=-5-m", "5-m", "0-m"]),
        ([-0.5, 0.5, -1e-7], ["level=-0.5-m", "0.5-m", "level=-1e-07-m"]),
        ([1000000.1, 1000000.2, -1000000.1], ["1000000.1-m", "1000000.2-m", "level=-1000000.1-m"]),
        (["-", "-5", "5"], ["level", "level=-5-m", "5-m"]),
        # Names that are the same for a file system; steps that have the same value.
        (["A b", "a-b", "c"], ["A-b-m-0", "a-b-m-1", "c-m-2"]),
        (["a", "a", "a (0)"], ["a-m-0", "a-m-1", "a-0-m"]),
        (["\u00e9", "e\u0301", "c"], None),
        (["x" * 150 + "1", "x" * 150 + "2", "c"], None),
    ],
)
@pytest.mark.long
def test_no_step_has_the_name_of_another(run: Run, tmp_path: Path, places: list[Any], names: list[str] | None) -> None:
    file, folder = tmp_path / "levels.nc", tmp_path / "levels"
    unit = {} if places[0] == "-" else {"units": "m"}
    level = ("level", places, unit)
    xarray.Dataset({"t": (("level", "row", "column"), values(1))}, coords={"level": level}).to_netcdf(file)
    code, _, stderr = run("encode", file, "--each", f"level={folder}")
    assert (code, stderr.count(" points, ")) == (0, 3), stderr
    surfaces = decoded(folder)
    for index, surface in enumerate(surfaces):
        np.testing.assert_array_equal(heights(surface), values(1)[index])
        assert surface.metadata["series"]["value"] == places[index]
    assert len({surface.metadata["name"] for surface in surfaces}) == 3
    if names is not None:
        assert sorted(path.stem for path in folder.iterdir()) == sorted(
            name.removesuffix("" if unit else "-m") for name in names
        )


def test_times_without_readable_dates_are_numbers_with_their_unit(run: Run, tmp_path: Path) -> None:
    file, folder = tmp_path / "model.nc", tmp_path / "steps"
    time = ("time", [29.0, 59.0], {"units": "months ago", "axis": "T"})
    xarray.Dataset({"t": (("time", "row", "column"), values(1)[:2])}, coords={"time": time}).to_netcdf(file)
    assert run("encode", file, "--each", f"time={folder}")[0] == 0
    words = ["29 months ago", "59 months ago"]
    assert [it.metadata["name"] for it in decoded(folder)] == [f"model t {text}" for text in words]
    assert [it.metadata["series"]["value"] for it in decoded(folder)] == [29.0, 59.0]


@pytest.mark.parametrize(
    ("options", "words"),
    [
        (
            ("--each", "depth=D"),
            "expected variable, or a dimension of the file: time (3), lat (12), lon (17); got 'depth'",
        ),
        (("--each", "lat_bnds=D"), "got 'lat_bnds'"),
        (("--each", "time=D", "-o", "time=1"), "expected no place along time for each time, got one by -o time= or"),
        (("--each", "lat=D"), None),
        (("--each", "variable=D", "-o", "variable=air"), "expected no -o variable= for each variable"),
        (("--each", "time=D", "-o", "band=1"), "expected an option of format netcdf"),
        (("--each", "time=none/D"), "none"),
    ],
)
def test_what_has_no_such_steps_is_refused_with_those_that_there_are(
    run: Run, dataset: xarray.Dataset, tmp_path: Path, options: tuple[str, ...], words: str | None
) -> None:
    file = tmp_path / "day.nc"
    dataset[["air"]].to_netcdf(file)
    given = [option.replace("=D", f"={tmp_path / 'D'}").replace("none/D", f"{tmp_path}/none/D") for option in options]
    if words is None:  # each latitude is a surface over time and longitude
        code, _, stderr = run("encode", file, *given)
        assert (code, stderr.count(" points, ")) == (0, ROWS)
        return
    code, _, stderr = run("encode", file, *given)
    assert code == 1
    assert words in stderr
    assert list(tmp_path.iterdir()) == [file]


def test_a_dimension_that_another_variable_has_is_refused_with_those_of_this_one(
    run: Run, dataset: xarray.Dataset, tmp_path: Path
) -> None:
    file, url = tmp_path / "day.nc", "http://127.0.0.1:1"
    dataset["ice"] = (("member", *dataset["air"].dims), values(1)[None].repeat(2, axis=0))
    dataset.to_netcdf(file)
    words = "expected variable, or a dimension of {}; got {!r}"
    listed = "time (3), lat (12), lon (17)"
    for given, of in (
        (("depth",), f"the file: {listed}, member (2)"),  # whichever of its variables is meant
        (("member", "-o", "variable=air"), f"air: {listed}"),
    ):
        for command in (
            ["push", file, url, "--each", given[0]],
            ["encode", file, "--each", f"{given[0]}={tmp_path / 'D'}"],
        ):
            code, _, stderr = run(*command, *given[1:])
            assert (code, words.format(of, given[0]) in stderr) == (1, True), stderr
    assert list(tmp_path.iterdir()) == [file]


def test_other_formats_and_several_files_are_refused(run: Run, tmp_path: Path, server: str) -> None:
    file = tmp_path / "a.npy"
    np.save(file, np.ones((3, 4)))
    code, _, stderr = run("encode", file, "--each", f"time={tmp_path / 'D'}")
    assert (code, "expected a NetCDF or a Zarr store for each time, got a file of npy" in stderr) == (1, True)
    code, _, stderr = run("encode", file, tmp_path / "b.lode", "--each", f"time={tmp_path / 'D'}")
    assert (code, "argument --each: expected one FILE and no OUT" in stderr) == (2, True)
    assert run("encode", file)[0] == 2
    code, _, stderr = run("push", file, file, server, "--each", "time")
    assert (code, "argument --each: expected one FILE for each time" in stderr) == (2, True)


def test_a_step_that_cannot_be_a_surface_does_not_end_the_others(
    run: Run, dataset: xarray.Dataset, tmp_path: Path
) -> None:
    file, folder = tmp_path / "day.nc", tmp_path / "steps"
    dataset["air"][1] = np.nan
    dataset[["air"]].to_netcdf(file)
    code, stdout, stderr = run("encode", file, "--each", f"time={folder}", "--json")
    told = json.loads(stdout)
    assert code == 1
    assert len(told["surfaces"]) == STEPS - 1
    assert [it["time"] for it in told["failed"]] == [DATES[1]]
    assert f"lodestream: {DATES[1]}: " in stderr
    assert [it.metadata["series"]["index"] for it in decoded(folder)] == [0, 2]


@pytest.mark.parametrize("order", ["file url each", "file each url", "each file url"])
def test_steps_are_pushed_and_listed_together(
    run: Run, dataset: xarray.Dataset, tmp_path: Path, server: str, order: str
) -> None:
    file = tmp_path / f"{order.replace(' ', '-')}.nc"
    dataset[["air"]].to_netcdf(file)
    words = {"file": [str(file)], "url": [server], "each": ["--each", "time"]}
    code, stdout, stderr = run("push", *(word for part in order.split() for word in words[part]), "--precision", "0.1")
    assert code == 0, stderr
    lines = stdout.splitlines()
    assert [line.split(" ", 1)[1] for line in lines] == [f"{file.stem} air {date}" for date in DATES]
    listed = {it.url: it for it in Client(server).list()}
    for index, line in enumerate(lines):
        surface = listed[line.split(" ")[0]]
        assert (surface.details["series"]["index"], surface.details["series"]["name"]) == (index, f"{file.stem} air")
        assert surface.details["name"] == f"{file.stem} air {DATES[index]}"
        assert Client(surface.url).get(surface.url).details["series"] == surface.details["series"]
    _, stdout, _ = run("list", server, "--search", f"{file.stem} air, time")
    assert [line.split()[0] for line in stdout.splitlines()] == [line.split()[0] for line in lines]


def test_a_note_of_several_steps_is_said_once(run: Run, dataset: xarray.Dataset, tmp_path: Path, server: str) -> None:
    file = tmp_path / "noted.nc"
    data = dataset[["air"]].assign(profile=("depth", np.zeros(4)))
    data["air"].attrs["valid_max"] = np.float32(1e6)
    data["air"][1:, 0, 0] = 1e7
    data["air"][1, 0, 1] = 1e7
    data.to_netcdf(file)
    for command in (("encode", file, "--each", f"time={tmp_path / 'steps'}"), ("push", file, server, "--each", "time")):
        code, _, stderr = run(*command)
        assert code == 0, stderr
        notes = [line.removeprefix("lodestream: ") for line in stderr.splitlines() if " points, " not in line]
        label = DATES[2] if command[0] == "encode" else f"noted air {DATES[2]}"
        before = DATES[1] if command[0] == "encode" else f"noted air {DATES[1]}"
        assert sorted(notes) == sorted(
            [
                "left out: profile",
                f"{before}: 2 values of air outside its valid range: missing",
                f"{before}: 2 of 204 points are holes",
                f"{label}: 1 value of air outside its valid range: missing",
                f"{label}: 1 of 204 points is a hole",
            ]
        )
    data["air"][1, 0, 1] = 0.0
    data.to_netcdf(file)
    _, _, stderr = run("encode", file, "--each", f"time={tmp_path / 'steps'}")
    assert "1 value of air outside its valid range: missing (2 of 3 surfaces)" in stderr
    assert "1 of 204 points is a hole (2 of 3 surfaces)" in stderr


def test_each_file_is_a_surface_wherever_the_option_stands(run: Run, tmp_path: Path, server: str) -> None:
    names = [tmp_path / "a.npy", tmp_path / "b.npy"]
    for number, name in enumerate(names):
        np.save(name, np.full((3, 4), number) + np.arange(4))
    for args in (
        ("--each", *names, server),
        (*names, server, "--each"),
        (names[0], "--each", server),
        ("--each", names[0], server),
        ("--each", "file", *names, server),
    ):
        code, stdout, stderr = run("push", *args)
        assert code == 0, stderr
        pushed = [Path(line.split(" ", 1)[1]) for line in stdout.splitlines()]
        assert pushed == [name for name in names if name in args]
    code, _, stderr = run("push", "--each", names[0], "no url")
    assert (code, "argument URL" in stderr) == (2, True)


def test_a_dimension_that_a_small_file_claims_to_be_long_is_refused(run: Run, tmp_path: Path) -> None:
    h5py = pytest.importorskip("h5py")
    with h5py.File(tmp_path / "long.nc", "w") as file:
        air = file.create_dataset("air", (5_000_000, ROWS, COLUMNS), "f4", chunks=(1, ROWS, COLUMNS))
        for axis, (name, length) in enumerate({"step": 5_000_000, "lat": ROWS, "lon": COLUMNS}.items()):
            file.create_dataset(name, (length,), "f4", chunks=(min(length, 1 << 20),)).make_scale(name)
            air.dims[axis].attach_scale(file[name])
    assert (tmp_path / "long.nc").stat().st_size < 100_000
    code, stdout, stderr = run("encode", tmp_path / "long.nc", "--each", f"step={tmp_path / 'out'}")
    assert (code, stdout) == (1, "")
    assert "expected at most 100,000 surfaces of a file, got 5,000,000 along step" in stderr
