from __future__ import annotations

import io
import json
import re
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

import lodestream as ls
from lodestream_server import running_server
from tests.core.surfaces import torus

from ..conftest import Run

Terrain = NDArray[np.float32]
KEYS = {"bytes", "wire_bytes", "level", "rms", "max", "bound", "seconds", "ended"}

# Both ways to the same surface: from a file, and from a server.
Fetch = Callable[..., tuple[int, dict[str, Any], str]]


@pytest.fixture(params=["decode", "pull"])
def fetch(request: pytest.FixtureRequest, run: Run, container_file: Path, tmp_path: Path) -> Fetch:
    source = container_file if request.param == "decode" else request.getfixturevalue("surface")

    def call(*options: object, out: str = "out.npy") -> tuple[int, dict[str, Any], str]:
        code, stdout, stderr = run(request.param, source, tmp_path / out, "--json", *options)
        return code, json.loads(stdout) if stdout else {}, stderr

    return call


@pytest.fixture
def info(run: Run, container_file: Path) -> dict[str, Any]:
    code, stdout, _ = run("info", container_file, "--json")
    assert code == 0
    described: dict[str, Any] = json.loads(stdout)
    return described


def error_of(points: NDArray[Any], terrain: Terrain) -> float:
    return float(np.sqrt(np.mean((points.astype(float) - terrain) ** 2)))


def test_a_whole_surface_is_the_original(fetch: Fetch, terrain: Terrain, tmp_path: Path, info: dict[str, Any]) -> None:
    code, figures, _ = fetch()
    assert code == 0
    assert set(figures) == KEYS
    assert figures["ended"] == "complete"
    assert (figures["rms"], figures["max"]) == (0, 0)
    assert figures["bytes"] == info["levels"][-1]["bytes"]
    assert figures["wire_bytes"] > figures["bytes"]
    assert np.array_equal(np.load(tmp_path / "out.npy"), terrain)


def test_a_byte_limit_is_the_last_layer_within(
    fetch: Fetch, terrain: Terrain, tmp_path: Path, info: dict[str, Any]
) -> None:
    code, figures, _ = fetch("--max-bytes", "2000")
    layer = [it for it in info["layers"] if it["bytes"] <= 2000][-1]
    assert code == 0
    assert figures["ended"] == "bytes"
    assert {key: figures[key] for key in layer} == layer
    assert error_of(np.load(tmp_path / "out.npy"), terrain) == pytest.approx(layer["rms"], rel=1e-6)


@pytest.mark.parametrize(("option", "key", "ended"), [("--until-rms", "rms", "rms"), ("--until-max", "max", "max")])
def test_an_error_limit_is_the_first_layer_within(
    fetch: Fetch, info: dict[str, Any], option: str, key: str, ended: str
) -> None:
    code, figures, _ = fetch(option, "15")
    layer = next(it for it in info["layers"] if it[key] <= 15)
    assert code == 0
    assert figures["ended"] == ended
    assert figures["bytes"] == layer["bytes"]


def test_a_level_is_a_grid_of_its_shape(fetch: Fetch, tmp_path: Path, info: dict[str, Any]) -> None:
    code, figures, _ = fetch("--level", "3")
    level = info["levels"][3]
    assert code == 0
    assert figures["ended"] == "level"
    assert {key: figures[key] for key in ("bytes", "rms", "max", "level")} == {
        key: level[key] for key in ("bytes", "rms", "max", "level")
    }
    assert list(np.load(tmp_path / "out.npy").shape) == level["shape"]


def test_level_order_stops_at_the_end_of_a_level(fetch: Fetch, info: dict[str, Any]) -> None:
    code, figures, _ = fetch("--order", "level", "--max-bytes", "3000")
    level = [it for it in info["levels"] if it["bytes"] <= 3000][-1]
    assert code == 0
    assert (figures["level"], figures["bytes"], figures["rms"]) == (level["level"], level["bytes"], level["rms"])


def test_a_coarse_level_is_drawn_as_large_as_the_surface(fetch: Fetch, terrain: Terrain, tmp_path: Path) -> None:
    assert fetch("--level", "2", out="coarse.obj")[0] == 0
    lines = (tmp_path / "coarse.obj").read_text().splitlines()
    points = np.array([line.split()[1:] for line in lines if line.startswith("v ")], float)
    rows, columns = terrain.shape
    # Beyond a gap the nodes are where the coarsened indices are, which is about there.
    assert points[:, :2].min() == pytest.approx(0, abs=1)
    assert points[:, 0].max() == pytest.approx(columns - 1, abs=1)
    assert points[:, 1].max() == pytest.approx(rows - 1, abs=1)


@pytest.mark.parametrize(
    ("options", "reason"),
    [
        (("--level", "99"), "expected a level of 0 to"),
        (("--max-bytes", "10"), "expected at least the"),
    ],
)
def test_what_the_surface_cannot_give(fetch: Fetch, tmp_path: Path, options: tuple[str, ...], reason: str) -> None:
    code, figures, stderr = fetch(*options)
    assert (code, figures) == (1, {})
    assert reason in stderr
    assert stderr.count("\n") == 1
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("out", ["out.bmp", "out", "nowhere/out.npy"])
def test_an_out_that_cannot_be_written(fetch: Fetch, out: str) -> None:
    code, _, stderr = fetch(out=out)
    assert code == 1
    assert stderr.startswith("lodestream: ")
    assert stderr.count("\n") == 1


def test_a_store_is_written_into_an_empty_folder_and_into_no_other(
    fetch: Fetch, terrain: Terrain, tmp_path: Path
) -> None:
    zarr = pytest.importorskip("zarr")
    (tmp_path / "out.zarr").mkdir()
    assert fetch(out="out.zarr")[0] == 0
    assert np.array_equal(zarr.open(tmp_path / "out.zarr", mode="r")["z"][:], terrain, equal_nan=True)
    code, _, stderr = fetch(out="out.zarr")
    assert code == 1
    assert "out.zarr: it is a folder with files; remove it, or choose another name" in stderr
    assert fetch(out="out.zarr/sub.zarr")[0] == 0, "a group of a store that is there"


def test_an_effort_is_taken_from_the_command_line(run: Run, terrain_file: Path, tmp_path: Path) -> None:
    for effort in ("fast", "small"):
        out = tmp_path / f"{effort}.lode"
        assert run("encode", terrain_file, out, "--effort", effort)[0] == 0
        assert out.read_bytes() == ls.encode(ls.read(terrain_file), effort=effort)
    code, _, stderr = run("encode", terrain_file, tmp_path / "out.lode", "--effort", "best")
    assert code == 2
    assert "argument --effort: invalid choice: best" in stderr.replace("'", "")


def test_a_limit_out_of_reach_is_complete_with_a_note(run: Run, terrain_file: Path, tmp_path: Path) -> None:
    lossy = tmp_path / "lossy.lode"
    assert run("encode", terrain_file, lossy, "--precision", "2")[0] == 0
    code, stdout, stderr = run("decode", lossy, tmp_path / "o.npy", "--until-rms", "1e-6", "--json")
    assert code == 0
    assert json.loads(stdout)["ended"] == "complete"
    assert "cannot be reached" in stderr


def test_a_cut_container(
    run: Run, container_file: Path, tmp_path: Path, terrain: Terrain, info: dict[str, Any]
) -> None:
    cut, out = tmp_path / "cut.lode", tmp_path / "out.npy"
    cut.write_bytes(container_file.read_bytes()[:3000])
    code, stdout, stderr = run("decode", cut, out, "--json")
    assert (code, stdout, stderr.count("\n")) == (1, "", 1)
    assert not out.exists()
    assert stderr.startswith(f"lodestream: {cut}: expected a whole container, got ")
    assert stderr.endswith(" in 3000 bytes: it is cut short; --partial writes the last complete layer before that\n")
    code, stdout, stderr = run("decode", cut, out, "--json", "--partial")
    assert stderr.startswith(f"lodestream: {cut}: expected a whole container, got ")
    layer = [it for it in info["layers"] if it["bytes"] <= 3000][-1]
    figures = json.loads(stdout)
    assert code == 0
    assert (figures["ended"], figures["bytes"], figures["rms"]) == ("truncated", layer["bytes"], layer["rms"])
    assert error_of(np.load(out), terrain) == pytest.approx(layer["rms"], rel=1e-6)


@pytest.mark.parametrize(
    ("bytes_", "options", "advice"),
    [
        (3000, ("--level", "2"), "order level, with --partial the last complete layer is written"),
        (3000, ("--level", "2", "--partial"), "order level, the last complete layer is written"),
        (
            3000,
            ("--order", "level"),
            "order level, with --partial the last complete layer is written",
        ),
        (40, (), "it is cut short"),
        (40, ("--partial",), "it is cut short"),
    ],
)
def test_a_cut_container_says_what_can_be_had(
    run: Run, container_file: Path, tmp_path: Path, bytes_: int, options: tuple[str, ...], advice: str
) -> None:
    cut = tmp_path / "cut.lode"
    cut.write_bytes(container_file.read_bytes()[:bytes_])
    code, stdout, stderr = run("decode", cut, tmp_path / "out.npy", *options)
    assert (code, stdout, stderr.count("\n"), (tmp_path / "out.npy").exists()) == (1, "", 1, False)
    assert stderr.startswith(f"lodestream: {cut}: expected ")
    assert advice in stderr
    code, stdout, stderr = run("info", cut)
    assert (code, stdout, stderr.count("\n")) == (1, "", 1)
    assert stderr.startswith(f"lodestream: {cut}: expected ")
    assert stderr.endswith("; lodestream decode --partial writes its last complete layer, if it has one\n")


@pytest.mark.parametrize(
    ("options", "ended"),
    [(("--until-rms", "30"), "rms"), (("--until-max", "90"), "max"), (("--max-bytes", "900"), "bytes")],
)
def test_a_cut_after_the_limit_does_no_harm(
    run: Run, container_file: Path, tmp_path: Path, options: tuple[str, ...], ended: str
) -> None:
    cut = tmp_path / "cut.lode"
    cut.write_bytes(container_file.read_bytes()[:3000])
    code, stdout, _ = run("decode", cut, tmp_path / "a.npy", "--json", *options)
    whole_code, whole, _ = run("decode", container_file, tmp_path / "b.npy", "--json", *options)
    assert (code, whole_code) == (0, 0)
    one, other = json.loads(stdout), json.loads(whole)
    assert one["ended"] == other["ended"] == ended
    for key in ("bytes", "level", "rms", "max"):
        assert one[key] == other[key]
    assert np.array_equal(np.load(tmp_path / "a.npy"), np.load(tmp_path / "b.npy"))


def test_a_damaged_container(run: Run, container_file: Path, tmp_path: Path) -> None:
    data = bytearray(container_file.read_bytes())
    data[2000] ^= 1
    damaged, out = tmp_path / "damaged.lode", tmp_path / "out.npy"
    damaged.write_bytes(data)
    code, _, stderr = run("decode", damaged, out)
    assert code == 1
    assert "at byte" in stderr
    assert stderr.startswith(f"lodestream: {damaged}: ")
    assert stderr.endswith("; --partial writes the last complete layer before that\n")
    code, stdout, _ = run("decode", damaged, out, "--json", "--partial")
    assert code == 0
    assert json.loads(stdout)["ended"] == "truncated"


@pytest.mark.parametrize("command", ["decode", "info"])
def test_what_is_no_container(run: Run, tmp_path: Path, command: str) -> None:
    path = tmp_path / "x.lode"
    for content in (b"", b"hello", b"\x93NUMPY" * 100):
        path.write_bytes(content)
        code, stdout, stderr = run(command, path, *([tmp_path / "o.npy"] if command == "decode" else []))
        assert (code, stdout, stderr.count("\n")) == (1, "", 1), stderr
        assert stderr.startswith(f"lodestream: {path}: expected ")


def test_encode_takes_surface_options(run: Run, tmp_path: Path) -> None:
    np.save(tmp_path / "ring.npy", np.random.default_rng(0).normal(size=(12, 9, 3)))
    out = tmp_path / "ring.lode"
    code, stdout, _ = run("encode", tmp_path / "ring.npy", out, "--closed", "rows", "--name", "Ring", "--json")
    assert code == 0
    assert json.loads(stdout)["closed"] == [True, False]
    described = json.loads(run("info", out, "--json")[1])
    assert described["closed"] == [True, False]
    assert described["metadata"]["name"] == "Ring"
    assert described["exact"] is True


class _Input:
    """Standard input that holds these bytes."""

    def __init__(self, content: bytes) -> None:
        self.buffer = io.BytesIO(content)


def test_standard_input_has_the_format_that_is_said(
    run: Run, server: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    numbers, out = b"10.5 20\n30 40\n50 60\n", tmp_path / "a.lode"
    for format_name in ("text", "csv"):
        monkeypatch.setattr(sys, "stdin", _Input(numbers))
        assert run("encode", "-", out, "--format", format_name)[0] == 0
        np.testing.assert_array_equal(ls.decode(out.read_bytes()).points, [[10.5, 20], [30, 40], [50, 60]])
    monkeypatch.setattr(sys, "stdin", _Input(numbers))
    code, stdout, stderr = run("push", "-", server, "--format", "csv", "--json")
    assert (code, stderr) == (0, "")
    assert json.loads(stdout)["filenames"] == ["standard input.dat"]
    assert json.loads(stdout)["shape"] == [3, 2]
    (tmp_path / "heights.bin").write_bytes(numbers + b"70 80\n")
    code, stdout, _ = run("push", tmp_path / "heights.bin", server, "--format", "text", "--json")
    assert (code, json.loads(stdout)["filenames"]) == (0, ["heights.dat"])
    for command in (("encode", "-", out), ("push", "-", server)):
        monkeypatch.setattr(sys, "stdin", _Input(numbers))
        code, stdout, stderr = run(*command, "--format", "pcd")
        assert (code, stdout) == (1, "")
        assert "standard input: this is text" in stderr


def test_bytes_that_are_read_twice_count_once(run: Run, container_file: Path, tmp_path: Path) -> None:
    size = container_file.stat().st_size
    for options in ((), ("--level", "1"), ("--until-rms", "1%")):
        code, stdout, _ = run("decode", container_file, tmp_path / "a.npy", "--json", *options)
        assert code == 0
        assert 0 < json.loads(stdout)["wire_bytes"] <= size
    assert run("decode", container_file, tmp_path / "a.npy")[2].count("read)") == 1


@pytest.mark.parametrize("transport", ["ws", "http"])
def test_people_are_told_the_bytes_of_the_container_not_those_of_messages(
    run: Run, surface: str, container_file: Path, tmp_path: Path, transport: str
) -> None:
    size = container_file.stat().st_size / 1000
    for options in ((), ("--resume",), ("--watch",)):
        code, _, stderr = run("pull", surface, tmp_path / "a.npy", "--transport", transport, *options)
        assert code == 0
        found = re.search(
            r"([\d.]+) kB of the surface \(([\d.]+) kB of the container read\) in ", stderr.splitlines()[-1]
        )
        assert found is not None
        assert float(found[1]) <= float(found[2]) <= size + 0.05


def test_the_last_row_of_layers_is_the_exact_surface(run: Run, container_file: Path, tmp_path: Path) -> None:
    last = run("info", container_file)[1].splitlines()[-1].split()
    levels = len(json.loads(run("info", container_file, "--json")[1])["levels"])
    assert last == ["exact", str(levels - 1), f"{container_file.stat().st_size:,}", "0", "0"]
    rounded = ls.encode(ls.decode(container_file.read_bytes()), precision=0.5)
    (tmp_path / "p.lode").write_bytes(rounded)
    assert "exact" not in run("info", tmp_path / "p.lode")[1].splitlines()[-1]


def test_push_of_many_files(run: Run, server: str, tmp_path: Path) -> None:
    names = []
    for number in range(3):
        names.append(tmp_path / f"slope-{number}.npy")
        np.save(names[-1], np.add.outer(np.arange(20 + number), np.arange(30)))
    code, stdout, stderr = run("push", "--each", *names, server)
    assert (code, stderr) == (0, "")
    urls, files = zip(*(line.split(" ", 1) for line in stdout.splitlines()), strict=True)
    assert files == tuple(map(str, names))
    shapes = [json.loads(run("info", url, "--json")[1])["shape"] for url in urls]
    assert shapes == [[20, 30], [21, 30], [22, 30]]
    (tmp_path / "no.off").write_text("OFF\n1 1 0\n0 0 0\n3 0 0 0\n")
    given = (names[0], tmp_path / "no.off", tmp_path / "missing.npy", names[1])
    code, stdout, stderr = run("push", "--each", *given, server)
    assert code == 1
    assert len(stdout.splitlines()) == 2
    assert stderr.splitlines()[1:] == [
        f"lodestream: {tmp_path / 'missing.npy'}: No such file or directory",
        "lodestream: 2 of 4 files failed",
    ]
    assert "no.off: " in stderr.splitlines()[0]
    code, stdout, _ = run("push", "--each", *given, server, "--json")
    told = json.loads(stdout)
    assert (code, [it["file"] for it in told["surfaces"]]) == (1, [str(given[0]), str(given[3])])
    assert [it["file"] for it in told["failed"]] == [*map(str, given[1:3])]
    assert run("push", "--each", *names, server, "--name", "all")[0] == 2
    code, stdout, stderr = run("push", "--each", *names, "http://127.0.0.1:9")
    assert (code, stdout, stderr.count("\n")) == (1, "", 1)


def test_push_of_many_files_says_whose_notes_they_are(run: Run, server: str, tmp_path: Path) -> None:
    heights = np.add.outer(np.arange(20.0), np.arange(30.0))
    np.save(tmp_path / "whole.npy", heights)
    heights[3, 4] = np.nan
    np.save(tmp_path / "holes.npy", heights)
    code, stdout, stderr = run("push", "--each", tmp_path / "whole.npy", tmp_path / "holes.npy", server)
    assert (code, len(stdout.splitlines())) == (0, 2)
    assert stderr == f"lodestream: {tmp_path / 'holes.npy'}: 1 of 600 points is a hole\n"


def test_list_finds_and_sorts(run: Run, tmp_path: Path) -> None:
    with running_server(tmp_path / "data", workers=1) as url:
        for name, size in (("Wide valley", 60), ("alp", 40), ("Hill", 50)):
            np.save(tmp_path / "a.npy", np.random.default_rng(size).normal(size=(size, size)))
            assert run("push", tmp_path / "a.npy", url, "--name", name)[0] == 0
        (tmp_path / "broken.off").write_text("OFF\n1 1 0\n0 0 0\n3 0 0 0\n")
        assert run("push", tmp_path / "broken.off", url)[0] == 1

        def names(*options: str) -> list[str]:
            code, stdout, _ = run("list", url, "--json", *options)
            assert code == 0
            return [surface["name"] or surface["filenames"][0] for surface in json.loads(stdout)["surfaces"]]

        assert sorted(names()) == ["Hill", "Wide valley", "alp", "broken.off"]
        assert names("--reverse") == names()[::-1]
        assert names("--sort", "name") == ["alp", "broken.off", "Hill", "Wide valley"]
        assert names("--sort", "size") == ["broken.off", "alp", "Hill", "Wide valley"]
        assert names("--sort", "size", "--reverse", "--state", "ready") == ["Wide valley", "Hill", "alp"]
        assert names("--sort", "created") == ["Wide valley", "alp", "Hill", "broken.off"]
        assert names("--sort", "state")[0] == "broken.off"
        assert names("--search", "hill") == ["Hill"]
        assert names("--search", "AL") == [name for name in names() if name in ("alp", "Wide valley")]
        line = run("list", url, "--state", "failed")[1]
        assert "failed" in line
        assert "24 B" in line
        assert "broken.off: expected" in line
        assert run("list", url, "--search", "nothing")[1:] == ("", "lodestream: no such surfaces\n")


def test_convert_goes_from_one_format_to_another(run: Run, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    heights = np.arange(24, dtype=np.float32).reshape(4, 6)
    np.save(tmp_path / "a.npy", heights)
    code, stdout, stderr = run("convert", tmp_path / "a.npy", tmp_path / "b.npz")
    assert (code, stdout) == (0, "")
    assert stderr.startswith("lodestream: 4 x 6 points written in ")
    with np.load(tmp_path / "b.npz") as arrays:
        np.testing.assert_array_equal(arrays["heights"], heights)
    code, stdout, _ = run("convert", tmp_path / "b.npz", tmp_path / "c.vts", "-o", "array=heights", "--json")
    assert (code, json.loads(stdout)["shape"]) == (0, [4, 6])
    assert (tmp_path / "c.vts").stat().st_size > heights.nbytes
    monkeypatch.setattr(sys, "stdin", _Input(b"1,2\n3,4\n"))
    assert run("convert", "-", tmp_path / "d.npy", "--format", "csv")[0] == 0
    np.testing.assert_array_equal(np.load(tmp_path / "d.npy"), [[1, 2], [3, 4]])


def test_convert_tells_the_size_of_what_it_writes(run: Run, tmp_path: Path) -> None:
    around = torus(8, 9)
    ls.write(ls.Surface(np.concatenate([around, around[:, :1]], axis=1)), tmp_path / "a.vts")
    assert ls.read(tmp_path / "a.vts").shape == (8, 9)  # the last column repeats the first
    assert run("convert", tmp_path / "a.vts", tmp_path / "b.npy")[2].startswith("lodestream: 8 x 10 points written in ")
    assert json.loads(run("convert", tmp_path / "a.vts", tmp_path / "b.npy", "--json")[1])["shape"] == [8, 10]
    assert np.load(tmp_path / "b.npy").shape == (8, 10, 3)


def test_convert_takes_a_container(run: Run, container_file: Path, terrain: Terrain, tmp_path: Path) -> None:
    assert run("convert", container_file, tmp_path / "b.nc", "--name", "hill")[0] == 0
    found = ls.read(tmp_path / "b.nc")
    np.testing.assert_array_equal(found.points, terrain)
    assert found.metadata["name"] == "hill"
    (tmp_path / "cut.lode").write_bytes(container_file.read_bytes()[:1000])
    code, _, stderr = run("convert", tmp_path / "cut.lode", tmp_path / "c.npz")
    assert code == 1
    assert "cut.lode: expected" in stderr
    assert run("convert", tmp_path / "none.lode", tmp_path / "c.npz")[0] == 1
    assert not (tmp_path / "c.npz").exists()


def test_convert_says_what_it_does_not_do(run: Run, container_file: Path, tmp_path: Path) -> None:
    np.save(tmp_path / "a.npy", np.eye(3))
    for files, words in (
        ((tmp_path / "a.npy", tmp_path / "b.lode"), "lodestream encode makes containers"),
        ((container_file, tmp_path / "a.npy", tmp_path / "b.vts"), "expected one container"),
        ((container_file, tmp_path / "b.npy", "--closed", "rows"), "for the container"),
        ((container_file, tmp_path / "b.npy", "-o", "array=a"), "for the container"),
        ((tmp_path / "a.npy", tmp_path / "b.npy", "--precision", "1"), "--precision"),
    ):
        code, stdout, stderr = run("convert", *files)
        assert (code, stdout) == (2, "")
        assert words in stderr
    assert run("convert", tmp_path / "a.npy", tmp_path / "b.docx")[0] == 1
    points = np.random.default_rng(1).normal(size=(2, 3, 3))
    blocks = ls.Surface(blocks=[ls.Block(points), ls.Block(points + 9)])
    ls.write(blocks, tmp_path / "two.p3d")
    code, _, stderr = run("convert", tmp_path / "two.p3d", tmp_path / "two.npy")
    assert (code, "two.npy: expected one block for npy, got 2" in stderr) == (1, True)
    assert sorted(path.name for path in tmp_path.iterdir()) == ["a.npy", "two.p3d"]


def test_encode_with_a_precision(run: Run, terrain_file: Path, terrain: Terrain, tmp_path: Path) -> None:
    assert run("encode", terrain_file, tmp_path / "p.lode", "--precision", "0.5")[0] == 0
    assert run("decode", tmp_path / "p.lode", tmp_path / "p.npy")[0] == 0
    assert 0 < np.abs(np.load(tmp_path / "p.npy").astype(float) - terrain).max() <= 0.5
    assert json.loads(run("info", tmp_path / "p.lode", "--json")[1])["exact"] is False


def test_encode_for_a_root_mean_square_error(
    run: Run, terrain_file: Path, terrain: Terrain, container_file: Path, tmp_path: Path
) -> None:
    made, out = tmp_path / "r.lode", tmp_path / "r.npy"
    assert run("encode", terrain_file, made, "--rms", "1%")[0] == 0
    assert run("decode", made, out)[0] == 0
    described = json.loads(run("info", made, "--json")[1])
    assert described["exact"] is False
    told = described["layers"][-1]["rms"]
    assert 0 < told <= 0.01 * float(np.ptp(terrain.astype(float)))
    assert error_of(np.load(out), terrain) == pytest.approx(told, rel=1e-6)
    assert "no, within the error that was asked for" in run("info", made)[1]
    assert run("encode", terrain_file, tmp_path / "zero.lode", "--rms", "0")[0] == 0
    zero, exact = (ls.decode(path.read_bytes()).points for path in (tmp_path / "zero.lode", container_file))
    assert np.array_equal(zero, exact)


@pytest.mark.parametrize(
    "options", [("-o", "nonsense=1"), ("-o", "path=x"), ("-o", "max_vertices=3"), ("--precision", "0")]
)
def test_encode_refuses_options(run: Run, terrain_file: Path, tmp_path: Path, options: tuple[str, ...]) -> None:
    code, _, stderr = run("encode", terrain_file, tmp_path / "o.lode", *options)
    if options[0] == "-o":
        assert (code, stderr.count("\n")) == (1, 1)
        assert not (tmp_path / "o.lode").exists()
    else:
        assert (code, stderr.count("\n")) in ((0, 1), (1, 1)), "lossless or refused, and no traceback"


@pytest.mark.parametrize(
    "arguments",
    [
        (),
        ("fly",),
        ("encode", "a.npy"),
        ("encode", "a.npy", "b.npy"),
        ("encode", "a.npy", "b.lode", "--closed", "perhaps"),
        ("encode", "a.npy", "b.lode", "--precision", "much"),
        ("encode", "a.npy", "b.lode", "--rms", "much"),
        ("encode", "a.npy", "b.lode", "--rms", "1", "--precision", "1"),
        ("encode", "a.npy", "b.lode", "-o", "key"),
        ("encode", "a.npy", "b.lode", "-o", "k=1", "-o", "k=2"),
        ("encode", "a.npy", "-", "--json"),
        ("encode", "-", "-", "b.lode"),
        ("decode", "a.lode", "b.npy", "--level", "1", "--max-bytes", "9"),
        ("decode", "a.lode", "b.npy", "--level", "-1"),
        ("decode", "a.lode", "b.npy", "--seconds", "0"),
        ("decode", "a.lode", "b.npy", "--until-rms", "-1"),
        ("decode", "a.lode", "b.npy", "--order", "random"),
        ("decode", "a.lode", "-", "--json"),
        ("pull", "nowhere", "b.npy"),
        ("pull", "http://host/v1/surfaces", "b.npy"),
        ("pull", "http://host/v1/surfaces/ab", "b.npy", "--limit-rate", "fast"),
        ("push", "a.npy", "host:8000"),
        ("push", "a.npy", "http://host", "--precision", "1", "--precision", "a=1", "--rms", "1"),
        ("list", "file:///tmp"),
        ("rm", "http://host"),
    ],
)
def test_exit_code_2_is_for_the_command_line_alone(run: Run, arguments: tuple[str, ...]) -> None:
    code, stdout, stderr = run(*arguments)
    assert code == 2
    assert stdout == ""
    assert "error: " in stderr


def test_a_file_that_is_not_there(run: Run, tmp_path: Path) -> None:
    for arguments in (("encode", "a.npy", "a.lode"), ("decode", "a.lode", "a.npy"), ("info", "a.lode")):
        paths = [tmp_path / name for name in arguments[1:]]
        code, _, stderr = run(arguments[0], *paths)
        assert code == 1
        assert stderr == f"lodestream: {paths[0]}: No such file or directory\n"


def test_info_for_people(run: Run, container_file: Path) -> None:
    code, stdout, _ = run("info", container_file)
    assert code == 0
    assert "97 x 70" in stdout
    assert "bit for bit" in stdout
    assert "\x1b" not in stdout


def test_info_of_a_server_has_the_keys_of_a_file(run: Run, surface: str, info: dict[str, Any]) -> None:
    described = json.loads(run("info", surface, "--json")[1])
    assert described["state"] == "ready"
    assert {key: described[key] for key in info if key != "metadata"} == {
        key: info[key] for key in info if key != "metadata"
    }
    assert "97 x 70" in run("info", surface)[1]


def test_push_list_pull_rm(run: Run, server: str, tmp_path: Path) -> None:
    points = np.add.outer(np.arange(20), np.arange(30)).astype(np.int16)
    np.save(tmp_path / "slope.npy", points)
    code, stdout, _ = run("push", tmp_path / "slope.npy", server, "--name", "Slope")
    assert code == 0
    url = stdout.splitlines()[-1]
    assert url.startswith(f"{server}/v1/surfaces/")
    assert url in run("list", server)[1]
    listed = json.loads(run("list", server, "--json")[1])["surfaces"]
    assert [it["name"] for it in listed if it["url"] == url] == ["Slope"]
    assert run("pull", url, tmp_path / "back.npy")[0] == 0
    assert np.array_equal(np.load(tmp_path / "back.npy"), points)
    assert run("rm", url)[0] == 0
    code, _, stderr = run("rm", url)
    assert (code, stderr.count("\n")) == (1, 1)
    assert url not in run("list", server)[1]


def test_a_list_has_a_line_for_each_however_narrow_the_terminal(
    run: Run, server: str, terrain_file: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    code, stdout, _ = run("push", terrain_file, server, "--name", "long " * 40)
    assert code == 0
    url = stdout.splitlines()[-1]
    monkeypatch.setenv("COLUMNS", "40")
    (line,) = [line for line in run("list", server)[1].splitlines() if "long" in line]
    assert line.startswith(f"{url}  ready  ")
    assert line.count("long") == 40
    assert run("rm", url)[0] == 0


def test_push_without_waiting_and_as_json(run: Run, server: str, terrain_file: Path) -> None:
    code, stdout, _ = run("push", terrain_file, server, "--no-wait", "--json")
    pushed = json.loads(stdout)
    assert code == 0
    assert pushed["url"] == f"{server}/v1/surfaces/{pushed['id']}"
    assert pushed["state"] in ("queued", "building", "ready")


def test_push_of_what_is_no_surface(run: Run, server: str, tmp_path: Path) -> None:
    path = tmp_path / "text.tif"
    path.write_text("hello")
    code, stdout, stderr = run("push", path, server)
    assert (code, stdout, stderr.count("\n")) == (1, "", 1)
    assert "text.tif" in stderr
    code, _, stderr = run("push", tmp_path / "text.tif", server, "-o", "nonsense=1")
    assert code == 1


@pytest.mark.usefixtures("paced")
def test_pull_for_some_seconds_brings_the_metadata(run: Run, surface: str, tmp_path: Path) -> None:
    out = tmp_path / "out.npy"
    code, stdout, stderr = run("pull", surface, out, "--seconds", "1.2", "--limit-rate", "32kbit", "--json")
    figures = json.loads(stdout)
    assert code == 0
    assert figures["ended"] == "seconds"
    assert "could not be fetched" not in stderr
    assert np.load(out).shape == (97, 70)


def test_the_token_comes_from_the_environment(
    run: Run, surface: str, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    monkeypatch.setenv("LODESTREAM_TOKEN", "secret")
    assert run("info", surface, "--json")[0] == 0
    assert run("pull", surface, tmp_path / "o.npy", "--token", "other")[0] == 0


def test_no_server(run: Run, tmp_path: Path) -> None:
    for arguments in (
        ("list", "http://127.0.0.1:9"),
        ("info", "http://127.0.0.1:9/v1/surfaces/ab"),
        ("pull", "http://127.0.0.1:9/v1/surfaces/ab", tmp_path / "o.npy"),
        ("rm", "http://127.0.0.1:9/v1/surfaces/ab"),
    ):
        code, stdout, stderr = run(*arguments)
        assert (code, stdout, stderr.count("\n")) == (1, "", 1)
        assert "no connection to http://127.0.0.1:9" in stderr
        assert stderr.endswith(": connection refused\n")


def test_out_is_written_by_rename(run: Run, container_file: Path, tmp_path: Path) -> None:
    out = tmp_path / "out.npy"
    out.write_bytes(b"before")
    assert run("decode", container_file, out, "--level", "99")[0] == 1
    assert out.read_bytes() == b"before"
    assert run("decode", container_file, out)[0] == 0
    assert [path.name for path in tmp_path.iterdir()] == ["out.npy"]
    assert np.load(out).shape == (97, 70)


def test_an_unknown_package_s_command(monkeypatch: pytest.MonkeyPatch, run: Run) -> None:
    from importlib import metadata

    broken = metadata.EntryPoint("juggle", "no_such_package.command:register", "lodestream.commands")
    monkeypatch.setattr(metadata, "entry_points", lambda group: [broken])
    code, _, stderr = run("juggle")
    assert code == 1
    assert "juggle is not fully installed" in stderr


def test_the_core_reads_what_the_command_wrote(container_file: Path, terrain: Terrain) -> None:
    assert np.array_equal(ls.decode(container_file.read_bytes()).points, terrain)
