"""``decode --memory``: what takes more is decoded by bands or refused, with the memory that it takes."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

import lodestream as ls
from lodestream.container import capacity
from lodestream_client.commands import decode_by_rows
from lodestream_client.commands.outcome import Outcome
from tests.core.encoding.block_surfaces import block_surface
from tests.core.surfaces import terrain

from ..conftest import Run

LITTLE = ("--memory", "1MiB")
HEIGHTS = np.rint(300 * terrain((500, 410))).astype(np.int16)


@pytest.fixture
def container(tmp_path: Path) -> Path:
    path = tmp_path / "a.lode"
    path.write_bytes(ls.encode(HEIGHTS))
    return path


def names(folder: Path) -> set[str]:
    return {path.name for path in folder.iterdir()}


def refused(run: Run, container: Path, out: str, *options: object) -> str:
    """The message with which a decoding ends that leaves nothing."""
    to = out if out == "-" else container.with_name(out)
    code, stdout, stderr = run("decode", container, to, *options)
    assert (code, stdout) == (1, "")
    assert stderr.startswith(f"lodestream: {container}: expected ")
    assert names(container.parent) == {"a.lode"}
    return stderr


@pytest.mark.parametrize("memory", [LITTLE, ()])
def test_more_vertices_than_allowed_are_refused_by_bands_too(
    run: Run, container: Path, memory: tuple[str, ...]
) -> None:
    found = refused(run, container, "a.npy", *memory, "--max-vertices", 1_000)
    assert "expected at most 1,000 vertices (max_vertices), got 205,000" in found
    assert run("decode", container, container.with_name("a.npy"), *memory, "--max-vertices", 205_000)[0] == 0


@pytest.mark.parametrize(("out", "name", "size"), [("a.vts", "vts", 10), ("a.npz", "npz", 7), ("a.obj", "obj", 29)])
def test_a_format_that_is_written_whole_is_refused_if_it_takes_more(
    run: Run, container: Path, out: str, name: str, size: int
) -> None:
    found = refused(run, container, out, *LITTLE)
    assert (
        f"at most 1 MiB to write as {name}, got one that takes about {size} MiB; npy, geotiff, cog, netcdf, zarr are"
        in found
    )
    assert run("decode", container, container.with_name(out), "--memory", "64MiB")[0] == 0
    # A level, and a window, take what they take.
    assert run("decode", container, container.with_name(out), *LITTLE, "--level", 4)[0] == 0
    assert run("decode", container, container.with_name(out), *LITTLE, "--roi", "0:9,0:9")[0] == 0


@pytest.mark.parametrize("suffix", ["npy", "tif", "nc"])
def test_a_level_is_decoded_by_bands_to_the_same_file(
    run: Run, container: Path, suffix: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    big, small = container.with_name(f"big.{suffix}"), container.with_name(f"small.{suffix}")
    levels = ls.Decoder()
    levels.feed(container.read_bytes())
    assert levels.header is not None
    level = levels.header.levels - 1
    code, whole, _ = run("decode", container, big, "--level", level, "--json")
    assert code == 0
    monkeypatch.setattr(decode_by_rows, "_WHOLE", 24)  # of a level of 250 x 205 heights
    code, banded, _ = run("decode", container, small, *LITTLE, "--level", level, "--json")
    assert code == 0
    assert small.read_bytes() == big.read_bytes()
    told = json.loads(banded)
    assert told.pop("wire_bytes") <= len(container.read_bytes())
    assert told == told | {key: json.loads(whole)[key] for key in ("bytes", "level", "rms", "max", "bound", "ended")}
    assert names(container.parent) == {"a.lode", small.name, big.name}
    # A level that does not exist is told as it is without the option.
    assert "expected a level of 0 to 9, got 99" in run("decode", container, small, *LITTLE, "--level", 99)[2]


def test_what_is_not_decoded_by_bands_is_refused_with_the_reason(run: Run, container: Path) -> None:
    words = "at most 1 MiB to decode, got one that takes about 3 MiB and is not decoded by bands: "
    assert words + "standard output is written in one piece" in refused(run, container, "-", *LITTLE)
    for options in (("--partial",), ("--until-rms", "10%")):
        assert words + "only the whole surface or a level is" in refused(run, container, "a.npy", *LITTLE, *options)
    rows, columns = np.indices(HEIGHTS.shape)
    container.write_bytes(ls.encode(ls.Surface(np.stack([columns, rows, HEIGHTS], axis=-1).astype(np.float32))))
    assert words + "x and y are made of rules" in refused(run, container, "a.npy", *LITTLE)


def test_a_torus_is_decoded_by_bands(run: Run, container: Path) -> None:
    container.write_bytes(ls.encode(ls.Surface(HEIGHTS, (True, True))))
    assert run("decode", container, container.with_name("a.npy"), *LITTLE)[0] == 0
    assert np.array_equal(np.load(container.with_name("a.npy")), HEIGHTS)


@pytest.mark.parametrize("out", ["a.vtm", "a.p3d"])
@pytest.mark.long
def test_blocks_are_decoded_and_written_one_after_another(
    run: Run, container: Path, out: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    points = block_surface("plates", (181, 181), 1, "float32", "", np.random.default_rng(1)).points
    mask = np.random.default_rng(2).random((31, 181)) < 0.9
    surface = ls.Surface(blocks=[ls.Block(points[top : top + 31], mask=mask) for top in range(0, 180, 30)])
    container.write_bytes(ls.encode(surface))
    whole, little = container.with_name("whole") / out, container.with_name("little") / out
    for path in (whole, little):
        path.parent.mkdir()
    assert run("decode", container, whole, "--memory", "1GiB")[0] == 0
    monkeypatch.setattr(ls.Decoder, "surface", None)  # in one piece
    code, _, stderr = run("decode", container, little, *LITTLE)
    assert code == 0, stderr
    made = sorted(path.relative_to(little.parent) for path in little.parent.rglob("*") if path.is_file())
    assert made == sorted(path.relative_to(whole.parent) for path in whole.parent.rglob("*") if path.is_file())
    assert len(made) == (1 if out == "a.p3d" else 1 + len(surface.blocks))
    for name in made:
        assert (little.parent / name).read_bytes() == (whole.parent / name).read_bytes()


def test_a_surface_that_touches_itself_is_not_divided(run: Run, container: Path) -> None:
    surface = block_surface("sphere", (200, 190), 1, "float32", "", np.random.default_rng(1))
    container.write_bytes(ls.encode(surface))
    found = refused(run, container, "a.npy", *LITTLE)
    assert "is not decoded by bands: its largest block is decoded as a whole, in about 5 MiB" in found


def test_without_the_option_the_machine_is_the_limit(
    run: Run, container: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(capacity, "memory_limit", lambda: 4 << 20)
    assert "at most 4 MiB to write as vts" in refused(run, container, "a.vts")
    monkeypatch.setattr(capacity, "memory_limit", lambda: 16 << 20)
    assert run("decode", container, container.with_name("a.vts"))[0] == 0


def test_a_damaged_container_is_named_and_what_was_there_is_kept(
    run: Run, container: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    data = bytearray(container.read_bytes())
    data[len(data) // 2] ^= 1
    container.write_bytes(data)
    out = container.with_name("a.npy")
    out.write_bytes(b"of yesterday")
    code, _, stderr = run("decode", container, out, *LITTLE)
    assert code == 1
    assert stderr.startswith(f"lodestream: {container}: expected a ")
    assert out.read_bytes() == b"of yesterday"
    assert names(out.parent) == {"a.lode", "a.npy"}


@pytest.mark.parametrize(("error", "code"), [(KeyboardInterrupt(), 130), (OSError(28, "No space left on device"), 1)])
def test_a_decoding_that_is_cut_leaves_what_was_there(
    run: Run, container: Path, monkeypatch: pytest.MonkeyPatch, error: BaseException, code: int
) -> None:
    def fails(*arguments: object) -> None:
        raise error

    out = container.with_name("a.npy")
    out.write_bytes(b"of yesterday")
    monkeypatch.setattr(Outcome, "write", fails)
    assert run("decode", container, out, *LITTLE)[0] == code
    assert out.read_bytes() == b"of yesterday"
    assert names(out.parent) == {"a.lode", "a.npy"}
