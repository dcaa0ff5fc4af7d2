"""``pull --watch``: OUT and a picture are there early, and are replaced as the surface improves."""

from __future__ import annotations

import errno
import os
import re
import signal
import subprocess
import sys
from itertools import pairwise
from pathlib import Path
from threading import Event, Thread
from time import sleep
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray
from PIL import Image

import lodestream as ls
from lodestream.decoding.view import View
from lodestream.formats import write
from lodestream.grid.layout import Layout
from lodestream_client import Client
from lodestream_client.commands import watching
from lodestream_client.commands.outcome import write_surface
from lodestream_client.terminal.interrupts import Terminated
from lodestream_client.viewer import drawing
from lodestream_client.viewer.pictures import Picture, write_png
from tests.patience import PATIENCE

from ..conftest import Run

Terrain = NDArray[np.float32]

SLOW = ("--limit-rate", "64kbit")


@pytest.fixture
def patient(monkeypatch: pytest.MonkeyPatch) -> None:
    """Each state is written before the next one is taken: however long that takes, some are written early."""
    write = watching.Watch.write

    def written(watch: watching.Watch, view: View, layout: Layout) -> None:
        write(watch, view, layout)
        if (thread := watch._thread) is not None:
            thread.join()

    monkeypatch.setattr(watching.Watch, "write", written)


@pytest.mark.usefixtures("patient")
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


@pytest.mark.usefixtures("patient")
def test_what_is_written_early_has_its_place_and_notes_come_once(run: Run, server: str, tmp_path: Path) -> None:
    place = {"geotransform": [5e5, 30.0, 0.0, 4.2e6, 0.0, -30.0], "unit": "m", "name": "hill"}
    rows, columns = np.mgrid[0:90, 0:80]
    hill = ls.Surface((100 * np.sin(rows / 20) * np.cos(columns / 9)).astype("f4"), metadata=place)
    url = Client(server).upload(hill).url
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


@pytest.mark.long
def test_a_picture_is_drawn_beside_it(run: Run, surface: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    out, picture = tmp_path / "out.npy", tmp_path / "out.png"
    assert run("pull", surface, out, "--picture", picture)[0] == 0
    last = picture.read_bytes()
    drawn = list[bytes]()

    def seen(png: bytes, path: Path) -> None:
        write_png(png, path)
        with Image.open(path) as shown:
            shown.load()
        drawn.append(png)

    monkeypatch.setattr(drawing, "write_png", seen)
    assert run("pull", surface, out, "--picture", picture, "--watch", *SLOW)[0] == 0
    assert drawn[-1] == last == picture.read_bytes(), "the last state is drawn whatever came before"
    assert run("pull", surface, out, "--picture", picture, "--watch", "--roi", "0:40,0:40", *SLOW)[0] == 0
    assert picture.read_bytes() == drawn[-1] != last
    assert {file.name for file in tmp_path.iterdir()} == {"out.npy", "out.png"}


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
    with watching.Watch(str(tmp_path / "out.npy"), None, ls.Target(), dict) as watch:
        watch.write(views[0], layout)
        assert begun.wait(PATIENCE)
        for view in views[1:9]:  # while the first is written
            watch.write(view, layout)
        assert not written
        go_on.set()
        assert second.wait(PATIENCE)
    assert written == pytest.approx([views[0].rms, views[8].rms], rel=1e-3)


#: A process that finishes no picture until there is a file `go` in a folder.
BLOCKED = """
import pathlib, pickle, sys, time
from lodestream_client.viewer import drawing, pictures
png, folder = pictures.Picture.png, pathlib.Path(sys.argv[1])
def blocked(picture):
    (folder / "begun").touch()
    while not (folder / "go").exists():
        time.sleep(0.01)
    return png(picture)
pictures.Picture.png = blocked
drawing.serve(sys.stdin.buffer, sys.stdout.buffer)
"""

#: A process whose every picture fails, or that ends at the first one.
FAILING = """
import os, sys
from lodestream_client.viewer import drawing, pictures
def failing(picture):
    {}
pictures.Picture.png = failing
drawing.serve(sys.stdin.buffer, sys.stdout.buffer)
"""


def drawn_by(monkeypatch: pytest.MonkeyPatch, program: str, *args: object) -> None:
    """Have another program draw."""
    monkeypatch.setattr(drawing, "command", lambda: [sys.executable, "-c", program, *map(str, args)])


@pytest.fixture
def started(monkeypatch: pytest.MonkeyPatch) -> list[subprocess.Popen[bytes]]:
    """The programs that are started here. A server that other tests share has processes too, which come and go."""
    programs = list[subprocess.Popen[bytes]]()

    class Noted(subprocess.Popen[bytes]):
        def __init__(self, *arguments: Any, **options: Any) -> None:
            super().__init__(*arguments, **options)
            programs.append(self)

    monkeypatch.setattr(subprocess, "Popen", Noted)
    return programs


@pytest.mark.long
def test_the_stream_does_not_wait_for_a_picture(
    run: Run,
    surface: str,
    terrain: Terrain,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    started: list[subprocess.Popen[bytes]],
) -> None:
    """A picture that is never finished holds no state back: it is let go on when the stream has ended."""
    folder, out, picture = tmp_path / "folder", tmp_path / "out.npy", tmp_path / "out.png"
    folder.mkdir()
    drawn_by(monkeypatch, BLOCKED, folder)
    draw = drawing.Drawing.draw
    ended = list[bool]()

    def last(process: drawing.Drawing, *state: object) -> None:
        while not (folder / "begun").exists():
            sleep(0.01)
        ended.append(picture.exists())
        assert np.load(out).tobytes() == terrain.tobytes(), "OUT does not wait for pictures"
        (folder / "go").touch()
        draw(process, *state)  # type: ignore[arg-type]

    offer, waiting = drawing.Drawing.offer, Event()

    def first(process: drawing.Drawing, *state: object) -> None:
        if not waiting.is_set():  # the first state finds a process that is ready
            process._answer.result()
            waiting.set()
        offer(process, *state)  # type: ignore[arg-type]

    monkeypatch.setattr(drawing.Drawing, "offer", first)
    monkeypatch.setattr(drawing.Drawing, "draw", last)
    assert run("pull", surface, out, "--picture", picture, "--watch", *SLOW)[0] == 0
    assert ended == [False], "the stream ended while the first picture was drawn"
    assert picture.exists()
    assert [program.returncode is None for program in started] == [False], "no process is left"


@pytest.mark.parametrize(
    ("program", "words"),
    [
        (FAILING.format("raise ValueError('no ink')"), "the picture cannot be drawn: ValueError: no ink"),
        (FAILING.format("os._exit(7)"), "out.png: the process that draws pictures ended with code 7"),
        ("raise SystemExit(3)", "out.png: the process that draws pictures ended with code 3"),
    ],
)
@pytest.mark.long
def test_a_picture_that_cannot_be_drawn_is_told_after_the_surface_is_written(
    run: Run,
    surface: str,
    terrain: Terrain,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    started: list[subprocess.Popen[bytes]],
    program: str,
    words: str,
) -> None:
    drawn_by(monkeypatch, program)
    out, picture = tmp_path / "out.npy", tmp_path / "out.png"
    for more in ((), ("--watch", *SLOW)):
        out.unlink(missing_ok=True)
        code, _, stderr = run("pull", surface, out, "--picture", picture, *more)
        assert code == 1
        assert stderr.splitlines()[-1].endswith(words)
        assert np.load(out).tobytes() == terrain.tobytes()
    assert not picture.exists()
    assert [program.returncode is None for program in started] == [False, False]


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_an_interruption_leaves_no_process_that_draws(
    run: Run,
    surface: str,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    started: list[subprocess.Popen[bytes]],
    number: signal.Signals,
) -> None:
    """Once while a picture is being drawn, and once more while the last one is waited for."""
    drawn_by(monkeypatch, BLOCKED, tmp_path)

    def interrupted(state: ls.Surface, path: str) -> None:
        write_surface(state, path)
        os.kill(os.getpid(), number)

    def last(process: drawing.Drawing, *state: object) -> None:
        raise Terminated("terminated") if number == signal.SIGTERM else KeyboardInterrupt

    monkeypatch.setattr(watching, "write_surface", interrupted)
    monkeypatch.setattr(drawing.Drawing, "draw", last)
    code, *_ = run("pull", surface, tmp_path / "out.npy", "--picture", tmp_path / "out.png", "--watch", *SLOW)
    assert code == 128 + number
    assert [program.returncode is None for program in started] == [False], "no process is left"
    assert not (tmp_path / "out.png").exists()


@pytest.mark.long
def test_the_process_draws_what_is_drawn_here(tmp_path: Path, terrain: Terrain) -> None:
    decoder = ls.Decoder()
    views = decoder.feed(ls.encode(terrain))
    assert decoder.header is not None
    layout, path = decoder.header.layout, tmp_path / "out.png"
    with drawing.Drawing(path, "hill", window=False) as process:
        for view in (views[3], views[-1]):
            process.draw(view, layout, {})
            assert path.read_bytes() == Picture.of(view, layout, "hill").png()


class Pictures:
    """What a `Drawing` sends to its process: the sizes of the states, in their order."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch) -> None:
        self.sizes = list[int]()
        make = Picture.of

        def of(view: View, layout: Layout | None, name: str) -> Picture:
            self.sizes.append(view.bytes)
            return make(view, layout, name)

        monkeypatch.setattr(Picture, "of", of)


@pytest.mark.long
def test_the_last_state_is_drawn_once(
    run: Run, surface: str, tmp_path: Path, terrain: Terrain, monkeypatch: pytest.MonkeyPatch
) -> None:
    decoder, drawn = ls.Decoder(), Pictures(monkeypatch)
    views = decoder.feed(ls.encode(terrain))
    assert decoder.header is not None
    with drawing.Drawing(tmp_path / "out.png", "hill", window=False) as process:
        process._answer.result()
        process.offer(views[3], decoder.header.layout, {})
        process.draw(views[3], decoder.header.layout, {})
        assert drawn.sizes == [views[3].bytes]
        process.draw(views[3], decoder.header.layout, {"name": "another"})
        process.draw(views[-1], decoder.header.layout, {"name": "another"})
        assert drawn.sizes == [views[3].bytes, views[3].bytes, views[-1].bytes]
    # A stream that stops before its end: its last state has been offered when the pull is over, or not.
    drawn.sizes.clear()
    picture = tmp_path / "out.png"
    assert run("pull", surface, tmp_path / "a.npy", "--picture", picture, "--watch", "--until-rms", "5", *SLOW)[0] == 0
    assert len(set(drawn.sizes)) == len(drawn.sizes)
    assert drawn.sizes == sorted(drawn.sizes)


@pytest.mark.long
def test_pictures_that_nobody_waits_for_take_half_of_the_time(
    tmp_path: Path, terrain: Terrain, monkeypatch: pytest.MonkeyPatch
) -> None:
    decoder, drawn, now = ls.Decoder(), Pictures(monkeypatch), [0.0]
    views = decoder.feed(ls.encode(terrain))
    assert decoder.header is not None
    layout = decoder.header.layout

    def later(png: bytes, path: Path) -> None:
        now[0] += 5

    monkeypatch.setattr(drawing, "monotonic", lambda: now[0])
    monkeypatch.setattr(drawing, "write_png", later)
    with drawing.Drawing(tmp_path / "out.png", "hill", window=False) as process:
        process._answer.result()
        for number, (time, offered) in enumerate([(0, True), (9.5, False), (10, True), (19, False), (20, True)]):
            now[0] = float(time)
            before = len(drawn.sizes)
            process.offer(views[number], layout, {})
            process._answer.result()
            assert len(drawn.sizes) - before == offered
        process.draw(views[-1], layout, {})  # at once
    assert drawn.sizes == [views[number].bytes for number in (0, 2, 4, -1)]


def test_what_is_written_when_the_stream_is_over_is_not_drawn(
    tmp_path: Path, terrain: Terrain, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The last picture is next, and would wait for it."""
    decoder = ls.Decoder()
    views = decoder.feed(ls.encode(terrain))
    assert decoder.header is not None
    begun, go_on, written, offered = Event(), Event(), list[str](), list[int]()

    def blocked(state: ls.Surface, path: str) -> None:
        begun.set()
        assert go_on.wait(PATIENCE)
        written.append(path)

    monkeypatch.setattr(watching, "write_surface", blocked)
    process = drawing.Drawing(tmp_path / "out.png", "hill", window=False)
    monkeypatch.setattr(process, "offer", lambda view, *_: offered.append(view.bytes))
    with watching.Watch(str(tmp_path / "out.npy"), process, ls.Target(), dict) as watch:
        watch.write(views[0], decoder.header.layout)
        assert begun.wait(PATIENCE)
        thread = watch._thread
        assert thread is not None

        def joined() -> None:
            go_on.set()
            Thread.join(thread)

        monkeypatch.setattr(thread, "join", joined)
    assert (len(written), offered) == (1, [])


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


@pytest.mark.parametrize("transport", ["ws", "http"])
@pytest.mark.long
def test_a_stream_stops_when_its_picture_looks_done(
    run: Run, surface: str, terrain: Terrain, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, transport: str
) -> None:
    """Each state is drawn before the next one is taken, so that it does not matter how long that takes."""

    def each(self: watching.Watch, view: View, layout: Layout) -> None:
        assert self._drawing is not None
        self._drawing.draw(view, layout, self._metadata())

    monkeypatch.setattr(watching.Watch, "write", each)
    out, picture = tmp_path / "out.npy", tmp_path / "out.png"
    options = ("--watch", "--picture", picture, "--until-done", "--transport", transport, "--limit-rate", "200kbit")
    code, _, stderr = run("pull", surface, out, *options)
    assert code == 0, stderr
    told = re.search(r"looks done after \S+ k?B of \S+ k?B \(estimate: (\S+) % of", stderr)
    assert told is not None, stderr
    assert float(told[1]) < 1
    assert "lodestream: stopped: " in stderr
    rms = float(np.sqrt(np.mean((np.load(out).astype(float) - terrain) ** 2)))
    assert 0 < rms < 0.05 * np.ptp(terrain)
    with Image.open(picture) as shown:
        shown.load()
    # From a server, a picture alone: no more is read than it needs.
    code, _, stderr = run("view", surface, "--png", picture, "--until-done")
    assert (code, "looks done after" in stderr) == (0, True)


@pytest.mark.parametrize(
    "options",
    [
        ("--until-done",),
        ("--until-done", "--watch"),
        ("--until-done", "--picture", "a.png"),
        ("--until-done", "--watch", "--picture", "a.png", "--until-rms", "1"),
        ("--until-done", "--watch", "--picture", "a.png", "--level", "1"),
        ("--until-done", "--watch", "--picture", "a.png", "--roi", "0:9,0:9"),
        ("--until-done", "--watch", "--picture", "a.png", "--order", "level"),
    ],
)
def test_a_stream_that_stops_by_its_picture_needs_one_and_no_other_end(
    run: Run, surface: str, tmp_path: Path, options: tuple[str, ...]
) -> None:
    code, _, stderr = run("pull", surface, tmp_path / "out.npy", *options)
    assert (code, "argument --until-done" in stderr) == (2, True)


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
    assert "out.zarr as the surface improves: it is a folder, and --watch needs a file" in stderr
    assert list(tmp_path.iterdir()) == [], "refused before the first state"
