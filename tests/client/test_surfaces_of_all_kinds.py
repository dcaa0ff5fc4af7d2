"""Surfaces of every kind pushed to a server and pulled again: blocks, holes with attributes, height fields, poles."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

import lodestream as ls
from lodestream.errors import OptionError
from lodestream_client import Client
from tests.patience import PATIENCE

from .conftest import Run, make_terrain

BLOCK_SHAPES = [(9, 13), (9, 13), (17, 9)]


def write_blocks(path: Path) -> None:
    """Three blocks of a PLOT3D text file that share sides."""
    blocks = []
    for number, (rows, columns) in enumerate(BLOCK_SHAPES):
        r, c = np.indices((rows, columns)).astype(float)
        x, y = (c + 12 * number, r) if number < 2 else (24 + c, r - 8)
        blocks.append(np.stack((x, y, np.round(np.sin(x / 5) * np.cos(y / 4), 6))))
    numbers = "\n".join(" ".join(map(repr, block.ravel().tolist())) for block in blocks)
    sizes = " ".join(f"{columns} {rows} 1" for rows, columns in BLOCK_SHAPES)
    path.write_text(f"{len(blocks)}\n{sizes}\n{numbers}\n")


def write_scan(path: Path) -> None:
    """An organised cloud of 45 x 60 points with 250 holes, intensities and rings."""
    rows, columns = np.indices((45, 60))
    z = np.sin(rows / 7) * np.cos(columns / 9)
    x, y = columns + 0.1 * np.sin(rows), rows + 0.1 * np.cos(columns)
    points = np.stack((x, y, z, 50 + 20 * z, rows % 16), axis=-1).astype(np.float32)
    points[10:20, 20:45, :3] = np.nan
    header = (
        "VERSION 0.7\nFIELDS x y z intensity ring\nSIZE 4 4 4 4 4\nTYPE F F F F F\nCOUNT 1 1 1 1 1\nWIDTH 60\n"
        "HEIGHT 45\nVIEWPOINT 0 0 0 1 0 0 0\nPOINTS 2700\nDATA binary\n"
    )
    path.write_bytes(header.encode() + points.tobytes())


def write_lattice(path: Path) -> None:
    """Heights as x, y, z over an even lattice."""
    heights = make_terrain(50, 40)
    rows, columns = np.indices(heights.shape)
    np.save(path, np.stack((500000 + 30.0 * columns, 4000000 - 30.0 * rows, heights), axis=-1))


def write_sphere(path: Path) -> None:
    """A sphere of quads with a fan of triangles at each pole."""
    rows, columns = 11, 16
    v = np.pi * np.arange(1, rows + 1)[:, None] / (rows + 1)
    u = 2 * np.pi * np.arange(columns) / columns
    ring = np.stack((np.sin(v) * np.cos(u), np.sin(v) * np.sin(u), np.broadcast_to(np.cos(v), (rows, columns))), axis=2)
    points = [*ring.reshape(-1, 3).tolist(), [0.0, 0.0, 1.0], [0.0, 0.0, -1.0]]
    top, bottom = rows * columns + 1, rows * columns + 2
    faces: list[tuple[int, ...]] = []
    for c in range(columns):
        d = (c + 1) % columns
        faces.append((top, c + 1, d + 1))
        for r in range(rows - 1):
            corners = (r * columns + c, (r + 1) * columns + c, (r + 1) * columns + d, r * columns + d)
            faces.append(tuple(corner + 1 for corner in corners))
        faces.append(((rows - 1) * columns + d + 1, (rows - 1) * columns + c + 1, bottom))
    lines = [f"v {x!r} {y!r} {z!r}" for x, y, z in points]
    path.write_text("\n".join([*lines, *(f"f {' '.join(map(str, face))}" for face in faces)]) + "\n")


WRITERS = {"wing.fmt": write_blocks, "scan.pcd": write_scan, "lattice.npy": write_lattice, "sphere.obj": write_sphere}


@pytest.fixture(scope="module")
def files(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("kinds")
    for name, write in WRITERS.items():
        write(folder / name)
    return folder


@pytest.fixture(scope="module")
def addresses(server: str, files: Path) -> dict[str, str]:
    return {name: Client(server).upload(files / name).url for name in WRITERS}


def pulled(url: str) -> ls.Surface:
    with Client(url).connect(url) as stream:
        views = list(stream)
    return views[-1].surface(metadata=stream.decoder.metadata)


def values(surface: ls.Surface) -> list[tuple[Any, ...]]:
    """All that has to come back bit for bit."""
    return [
        (
            *(block.shape, block.closed, bits(block.points, block.mask)),
            None if block.mask is None else block.mask.tobytes(),
            {name: bits(array, block.mask) for name, array in block.attributes.items()},
        )
        for block in surface.blocks
    ]


def bits(array: NDArray[Any], mask: NDArray[np.bool_] | None) -> tuple[str, bytes]:
    return array.dtype.str, (array if mask is None else array[mask]).tobytes()


@pytest.mark.parametrize("name", WRITERS)
def test_every_kind_comes_back_bit_for_bit(addresses: dict[str, str], files: Path, name: str) -> None:
    given, back = ls.read(files / name), pulled(addresses[name])
    assert values(back) == values(given)
    assert {key: back.metadata[key] for key in given.metadata} == given.metadata


def test_info_tells_blocks(run: Run, addresses: dict[str, str], files: Path, tmp_path: Path) -> None:
    assert run("encode", files / "wing.fmt", tmp_path / "wing.lode")[0] == 0
    for place in (tmp_path / "wing.lode", addresses["wing.fmt"]):
        code, out, _ = run("info", place)
        assert code == 0
        assert "3: 2 of 9 x 13, 17 x 9" in out
        assert "values sha256" in out
        assert "grid" not in out
        details = json.loads(run("info", place, "--json")[1])
        assert [tuple(block["shape"]) for block in details["blocks"]] == BLOCK_SHAPES
        assert (details["shape"], details["closed"], details["holes"], details["attributes"]) == (None, None, 0, [])
        assert all(level["shape"] is None for level in details["levels"])
        assert len(details["values_sha256"]) == 64


def test_info_tells_holes_attributes_and_what_was_recognised(run: Run, addresses: dict[str, str]) -> None:
    code, out, _ = run("info", addresses["scan.pcd"])
    assert code == 0
    assert "2700, 250 of them holes" in out
    assert "intensity, ring" in out
    assert "sphere, 16 x 13; 178 vertices; 2 poles" in run("info", addresses["sphere.obj"])[1]
    assert "grid" in run("info", addresses["lattice.npy"])[1]


def test_infinities_are_told_and_come_back_from_a_server(run: Run, server: str, tmp_path: Path) -> None:
    heights = np.hypot(*np.mgrid[:40, :50]).astype(np.float32)
    heights[3, 4:9], heights[20, 7], heights[30, 30:33] = np.inf, -np.inf, np.nan
    np.save(tmp_path / "lake.npy", heights)
    code, address, _ = run("push", tmp_path / "lake.npy", server)
    assert code == 0
    _, out, _ = run("info", address.strip())
    assert "2000, 9 of them holes, 6 of these infinite or partly NaN" in " ".join(out.split())
    assert "yes, bit for bit wherever there is a value" in " ".join(out.split())
    details = json.loads(run("info", address.strip(), "--json")[1])
    assert (details["holes"], details["non_finite"], details["exact"]) == (9, 6, True)
    assert run("pull", address.strip(), tmp_path / "back.npy")[0] == 0
    assert np.load(tmp_path / "back.npy").tobytes() == heights.tobytes()
    # From memory too, where a mask says more than the values do.
    mask = np.ones(heights.shape, bool)
    mask[10, 10] = False
    back = pulled(Client(server).upload(ls.Surface(heights, mask=mask)).url)
    heights[10, 10] = np.nan
    assert back.points.tobytes() == heights.tobytes()


def test_holes_are_noted(run: Run, server: str, files: Path, tmp_path: Path) -> None:
    code, _, err = run("encode", files / "scan.pcd", tmp_path / "scan.lode")
    assert (code, "lodestream: 250 of 2700 points are holes\n" in err) == (0, True)
    code, out, err = run("push", files / "scan.pcd", server)
    assert (code, "lodestream: 250 of 2700 points are holes\n" in err) == (0, True)
    assert out.startswith(server)
    assert out.count("\n") == 1
    assert "holes" not in run("encode", files / "wing.fmt", tmp_path / "wing.lode")[2]


def test_values_at_holes_are_told(run: Run, server: str, files: Path, tmp_path: Path) -> None:
    note = "values of attributes at 250 holes of the points left out: intensity, ring"
    code, _, err = run("encode", files / "scan.pcd", tmp_path / "scan.lode")
    assert (code, err.count(f"lodestream: {note}\n")) == (0, 1)
    code, out, err = run("push", files / "scan.pcd", server)
    assert (code, err.count(f"lodestream: {note}\n")) == (0, 1)
    assert json.loads(run("info", out.strip(), "--json")[1])["metadata"]["notes"] == [note]
    assert Client(server).upload(files / "scan.pcd").details["metadata"]["notes"] == [note]


def test_what_a_reader_notes_is_told_by_push_and_encode(run: Run, server: str, tmp_path: Path) -> None:
    volume = np.stack(np.meshgrid(np.arange(3.0), np.arange(5.0), np.arange(4.0) ** 2, indexing="ij"))
    (tmp_path / "box.fmt").write_text("4 5 3\n" + " ".join(map(repr, volume[::-1].ravel().tolist())) + "\n")
    for command in (("encode", tmp_path / "box.fmt", tmp_path / "box.lode"), ("push", tmp_path / "box.fmt", server)):
        code, _, err = run(*command)
        assert code == 0, err
        notes = [line for line in err.splitlines() if "plane" in line]
        assert len(notes) == 1
        assert notes[0].startswith("lodestream: ")


def test_a_level_is_a_grid_of_each_block(run: Run, addresses: dict[str, str], tmp_path: Path) -> None:
    levels = json.loads(run("info", addresses["wing.fmt"], "--json")[1])["levels"]
    for level in (0, len(levels) // 2, len(levels) - 1):
        assert run("pull", addresses["wing.fmt"], tmp_path / "a.ply", "--level", str(level))[0] == 0
        with Client(addresses["wing.fmt"]).connect(addresses["wing.fmt"], target=ls.Target(level=level)) as stream:
            surface = list(stream)[-1].surface(level)
        assert len(surface.blocks) == 3
        ls.write(surface, tmp_path / "b.ply")
        assert (tmp_path / "a.ply").read_bytes().split(b"end_header")[1] == (
            (tmp_path / "b.ply").read_bytes().split(b"end_header")[1]
        )
    assert [block.shape for block in surface.blocks] == BLOCK_SHAPES


def test_levels_as_files_over_http(addresses: dict[str, str], run: Run, tmp_path: Path) -> None:
    import httpx

    url = addresses["wing.fmt"]
    assert run("pull", url, tmp_path / "a.ply", "--level", "2")[0] == 0
    answer = httpx.get(f"{url}/levels/2", params={"format": "ply"}, timeout=PATIENCE)
    assert (answer.status_code, answer.content) == (200, (tmp_path / "a.ply").read_bytes())
    for name in ("obj", "glb", "vts", "vtm", "plot3d"):
        assert httpx.get(f"{url}/levels/1", params={"format": name}, timeout=PATIENCE).status_code == 200
    refused = httpx.get(f"{url}/levels/1", params={"format": "npy"}, timeout=PATIENCE)
    assert refused.status_code == 422
    assert (
        "expected one block for npy, got 3: ply, obj, vts, vtm, glb and plot3d hold several" in refused.json()["detail"]
    )


@pytest.mark.parametrize("suffix", ["npy", "tif", "png"])
def test_blocks_go_into_formats_that_hold_several(
    run: Run, addresses: dict[str, str], files: Path, tmp_path: Path, suffix: str
) -> None:
    assert run("encode", files / "wing.fmt", tmp_path / "wing.lode")[0] == 0
    for command, place in (("decode", tmp_path / "wing.lode"), ("pull", addresses["wing.fmt"])):
        code, _, err = run(command, place, tmp_path / f"out.{suffix}")
        assert code == 1
        assert err.count("\n") == 1
        assert "got 3: ply, obj, vts, vtm, glb and plot3d hold several" in err
        assert not list(tmp_path.glob("out*"))


def test_blocks_are_listed_and_removed(run: Run, server: str, files: Path) -> None:
    url = Client(server).upload(files / "wing.fmt", name="to be removed").url
    copy = Client(server).upload(files / "wing.fmt", name="again", precision=0.01).url
    assert copy != url
    lines = [line for line in run("list", server)[1].splitlines() if copy in line]
    assert len(lines) == 1
    assert "blocks" in lines[0]
    assert run("rm", copy)[0] == 0
    assert copy not in run("list", server)[1]


@pytest.mark.parametrize("kind", ["precision", "rms"])
def test_attributes_have_precisions_of_their_own(run: Run, server: str, files: Path, tmp_path: Path, kind: str) -> None:
    given = ls.read(files / "scan.pcd")
    words = (f"--{kind}", "0.001", "--precision", "intensity=0.5")
    assert run("encode", files / "scan.pcd", tmp_path / "scan.lode", *words)[0] == 0
    code, out, err = run("push", files / "scan.pcd", server, *words)
    assert code == 0, err
    url = out.strip()
    assert json.loads(run("info", url, "--json")[1])["options"] == {kind: "0.001", "precision=intensity": "0.5"}
    for back in (ls.decode((tmp_path / "scan.lode").read_bytes()), pulled(url)):
        valid = given.mask
        assert valid is not None
        off = np.abs(back.attributes["intensity"] - given.attributes["intensity"])[valid]
        assert 0 < off.max() <= 0.5
        assert np.array_equal(back.attributes["ring"][valid], given.attributes["ring"][valid])
        distances = np.linalg.norm((back.points - given.points)[valid], axis=1)
        assert 0 < (distances.max() if kind == "precision" else np.sqrt(np.mean(distances**2))) <= 0.001


def test_precisions_that_cannot_be(run: Run, server: str, files: Path, tmp_path: Path) -> None:
    out = tmp_path / "scan.lode"
    for words, code, says in (
        (("colour=0.5",), 1, "'colour'"),
        (("intensity=",), 2, "not an error bound"),
        (("=0.5",), 2, "expected P or NAME=P"),
        (("0.5", "0.6"), 2, "the precision of the points is given twice"),
        (("intensity=1", "intensity=1"), 2, "'intensity' is given twice"),
    ):
        given = [word for value in words for word in ("--precision", value)]
        found, _, err = run("encode", files / "scan.pcd", out, *given)
        assert (found, says in err) == (code, True), err
        assert not out.exists()
    with pytest.raises(ls.RemoteError, match="colour"):
        Client(server).upload(files / "scan.pcd", attribute_precision={"colour": 0.5})
    with pytest.raises(OptionError):
        Client(server).upload(files / "scan.pcd", attribute_precision={"ring": "much"})
