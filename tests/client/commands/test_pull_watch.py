"""``pull --watch``: OUT and a picture are there early, and are replaced as the surface improves."""

from __future__ import annotations

import errno
import os
from itertools import pairwise
from pathlib import Path
from threading import Event

import numpy as np
import pytest
from numpy.typing import NDArray
from PIL import Image

import lodestream as ls
from lodestream.formats import write
from lodestream.grid.layout import Layout
from lodestream_client import sync
from lodestream_client.commands import watching
from tests.patience import PATIENCE

from ..conftest import Run

Terrain = NDArray[np.float32]

SLOW = ("--limit-rate", "64kbit")


@pytest.mark.parametrize("transport", ["ws", "http"])
def test_out_is_replaced_by_better_ones(
    run: Run, surface: str, terrain: Terrain, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, transport: str
) -> None:
    out, errors, files = tmp_path / "out.npy", [], []

    def seen(state: ls.Surface, path: str) -> None:
        write(state, path)
        assert [each.name for each in tmp_path.iterdir()] == [out.name]
        errors.append(float(np.sqrt(np.mean((np.load(path).astype(float) - terrain) ** 2))))
        files.append(os.stat(path).st_ino)

    monkeypatch.setattr(watching, "write_surface", seen)
    code, _, stderr = run("pull", surface, out, "--watch", "--transport", transport, *SLOW)
    told = [line for line in stderr.splitlines() if line.startswith(f"lodestream: {out}: ")]
    assert code == 0
    assert len(errors) == len(told)
    # So small a file comes in one answer over HTTP, which says what is in it at its end.
    assert len(errors) > 3 or transport == "http"
    assert errors == sorted(errors, reverse=True)
    assert errors == pytest.approx([float(line.split()[-1]) for line in told], rel=1e-3)
    assert all(before != after for before, after in pairwise(files)), "replaced, not changed"
    assert np.load(out).tobytes() == terrain.tobytes()


def test_what_is_written_early_has_its_place_and_notes_come_once(run: Run, server: str, tmp_path: Path) -> None:
    place = {"geotransform": [5e5, 30.0, 0.0, 4.2e6, 0.0, -30.0], "unit": "m", "name": "hill"}
    rows, columns = np.mgrid[0:90, 0:80]
    hill = ls.Surface((100 * np.sin(rows / 20) * np.cos(columns / 9)).astype("f4"), metadata=place)
    url = sync.upload(server, hill).url
    out, early = tmp_path / "hill.npz", []

    with pytest.MonkeyPatch.context() as patch:

        def seen(state: ls.Surface, path: str) -> None:
            write(state, path)
            early.append(ls.read(path).metadata)

        patch.setattr(watching, "write_surface", seen)
        assert run("pull", url, out, "--watch", *SLOW)[0] == 0
    assert len(early) > 1
    assert [each["unit"] for each in early] == ["m"] * len(early)
    out = tmp_path / "hill.npy"
    code, _, stderr = run("pull", url, out, "--watch", *SLOW)
    assert code == 0
    assert stderr.count("npy is written without") + stderr.count("NPY is written without") == 1


def test_a_picture_is_drawn_beside_it(run: Run, surface: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    from lodestream_client.viewer import pictures

    drawn: list[int] = []
    draw = pictures.draw

    def seen(view: ls.View, layout: Layout | None, name: str, path: Path) -> None:
        draw(view, layout, name, path)
        with Image.open(path) as picture:
            picture.load()
            drawn.append(view.bytes)

    monkeypatch.setattr(pictures, "draw", seen)
    out, picture = tmp_path / "out.npy", tmp_path / "out.png"
    assert run("pull", surface, out, "--picture", picture)[0] == 0
    assert len(drawn) == 1
    drawn.clear()
    assert run("pull", surface, out, "--picture", picture, "--watch", "--roi", "0:40,0:40", *SLOW)[0] == 0
    assert len(drawn) > 1
    assert drawn == sorted(drawn)
    assert {each.name for each in tmp_path.iterdir()} == {"out.npy", "out.png"}


def test_nothing_waits_for_what_is_written_and_the_newest_is_next(
    terrain: Terrain, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    decoder = ls.Decoder()
    views = decoder.feed(ls.encode(terrain))
    assert decoder.header is not None
    layout, written = decoder.header.layout, list[float]()
    begun, go_on, second = Event(), Event(), Event()

    def blocked(state: ls.Surface, path: str) -> None:
        begun.set()
        assert go_on.wait(PATIENCE)
        written.append(float(np.sqrt(np.mean((state.points.astype(float) - terrain) ** 2))))
        if len(written) == 2:
            second.set()

    monkeypatch.setattr(watching, "write_surface", blocked)
    with watching.Watch(str(tmp_path / "out.npy"), None, ls.Target(), dict, "hill") as watch:
        watch.write(views[0], layout)
        assert begun.wait(PATIENCE)
        for view in views[1:9]:  # while the first is written
            watch.write(view, layout)
        assert not written
        go_on.set()
        assert second.wait(PATIENCE)
    assert written == pytest.approx([views[0].rms, views[8].rms], rel=1e-3)


def test_an_out_that_cannot_be_replaced_ends_it(
    run: Run, surface: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def full(state: ls.Surface, path: str) -> None:
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC), path)

    monkeypatch.setattr(watching, "write_surface", full)
    out = tmp_path / "out.npy"
    code, _, stderr = run("pull", surface, out, "--watch", *SLOW)
    assert code == 1
    assert f"{out}: No space left on device" in stderr
    assert not out.exists()


def test_what_cannot_be_watched_is_refused_at_once(run: Run, surface: str, tmp_path: Path) -> None:
    out = tmp_path / "out.npy"
    code, _, stderr = run("pull", surface, "-", "--watch")
    assert (code, "standard output cannot be written again" in stderr) == (2, True)
    for picture in (tmp_path / "a.jpg", out):
        code, _, stderr = run("pull", surface, out, "--picture", picture)
        assert (code, "argument --picture: expected" in stderr) == (2, True)
    assert run("pull", surface, tmp_path / "a.png", "--picture", tmp_path / "a.png")[0] == 2
    assert run("pull", surface, out, "--picture", tmp_path / "none" / "a.png")[0] == 1
    pipe = tmp_path / "pipe.npy"
    os.mkfifo(pipe)
    code, _, stderr = run("pull", surface, pipe, "--watch")
    assert (code, "it is no file" in stderr) == (1, True)
    assert not out.exists()


def test_a_store_is_not_replaced_again_and_again(run: Run, surface: str, tmp_path: Path) -> None:
    code, _, stderr = run("pull", surface, tmp_path / "out.zarr", "--watch")
    assert code == 1
    assert "out.zarr again and again: it is a folder, and only files are replaced" in stderr
    assert list(tmp_path.iterdir()) == [], "refused before the first state"
