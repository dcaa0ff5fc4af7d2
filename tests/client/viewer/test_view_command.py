"""``lodestream view`` and its pictures; ``lodestream open`` and its page, until Ctrl-C."""

from __future__ import annotations

import os
import re
import signal
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import httpx
import numpy as np
import pytest

import lodestream as ls
from lodestream.opening.byte_sources import FileSource
from lodestream_client.program import main
from lodestream_client.remote_source import RemoteSource
from lodestream_client.viewer.picture_change import DONE, VISIBLE, picture_change, share_above
from lodestream_client.viewer.pictures import Picture, view_after, view_when_done
from tests.client.files import ranged
from tests.patience import PATIENCE

HILLS = np.add.outer(np.sin(np.arange(60) / 9), np.cos(np.arange(80) / 7)).astype(np.float32)


@pytest.fixture
def container(tmp_path: Path) -> Path:
    path = tmp_path / "hills.lode"
    path.write_bytes(ls.encode(HILLS))
    return path


def test_a_page_that_is_not_built_is_told(
    container: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr("lodestream_client.commands.open.assets", dict)
    assert main(["open", str(container)]) == 1
    assert "make page" in capsys.readouterr().err


@pytest.mark.usefixtures("built")
@pytest.mark.parametrize("kind", ["missing", "letter", "folder"])
def test_what_cannot_be_read_gets_no_address(tmp_path: Path, capsys: pytest.CaptureFixture[str], kind: str) -> None:
    path = tmp_path / "hills.npy"
    if kind == "letter":
        path.write_text("Dear reader, this is no surface.")
    elif kind == "folder":
        path.mkdir()
    assert main(["open", "--no-browser", str(path)]) == 1
    told = capsys.readouterr()
    assert told.out == ""
    assert "hills.npy" in told.err


def test_pictures_without_a_browser(tmp_path: Path, container: Path, capsys: pytest.CaptureFixture[str]) -> None:
    image = pytest.importorskip("PIL.Image")
    pytest.importorskip("matplotlib")
    assert main(["view", str(container), "--png", str(tmp_path / "out.png"), "--at", "1kB,all"]) == 0
    said = capsys.readouterr().err
    assert "RMS error 0, maximum 0" in said.splitlines()[-1]
    sizes = []
    for label in ("1kB", "all"):
        with image.open(tmp_path / f"out-{label}.png") as drawn:
            sizes.append(drawn.size)
    assert sizes[0] == sizes[1]
    assert min(sizes[0]) > 200
    assert (tmp_path / "out-1kB.png").read_bytes() != (tmp_path / "out-all.png").read_bytes()


def test_a_picture_is_drawn_as_soon_as_it_looks_done(
    tmp_path: Path, container: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["view", str(container), "--png", str(tmp_path / "a.png"), "--until-done"]) == 0
    told = re.search(r"looks done after (\S+) (k?B) of .* \(estimate: (\S+) % of", capsys.readouterr().err)
    assert told is not None
    received = round(float(told[1]) * (1000 if told[2] == "kB" else 1))
    assert 0 < received < 0.5 * container.stat().st_size
    assert float(told[3]) < 1
    # The same state by its bytes: its picture is the same, and hardly differs from the exact one.
    source = ls.open(container)
    view, picture, share = view_when_done(source, source.source.name)
    assert share < DONE
    assert (tmp_path / "a.png").read_bytes() == picture.png()
    last, layout = view_after(source, None)
    exact = Picture.of(last, layout, source.source.name).pixels()
    assert share_above(picture_change(picture.pixels(), exact), VISIBLE) < 0.03
    assert view.bytes < last.bytes


def test_a_picture_that_is_never_done_before_its_end_is_the_exact_one(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path = tmp_path / "noise.lode"
    noise = np.random.default_rng(3).integers(0, 3, (40, 50), np.int16)
    path.write_bytes(ls.encode(noise))
    assert main(["view", str(path), "--png", str(tmp_path / "a.png"), "--until-done"]) == 0
    assert "complete" in capsys.readouterr().err
    assert main(["view", str(path), "--png", str(tmp_path / "b.png")]) == 0
    assert (tmp_path / "a.png").read_bytes() == (tmp_path / "b.png").read_bytes()


def test_a_picture_of_a_window_is_that_of_its_points(
    tmp_path: Path, container: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    image = pytest.importorskip("PIL.Image")
    pytest.importorskip("matplotlib")
    out, window = tmp_path / "out.png", HILLS[5:25, 10:50]
    assert main(["view", str(container), "--png", str(out), "--roi", "5:25,10:50", "--at", "1B,all"]) == 0
    first, last = capsys.readouterr().err.splitlines()
    assert "no picture, since the first one takes" in first
    assert "RMS error 0, maximum 0" in last
    assert int(re.search(r"out-all\.png: (\d+) bytes", last)[1]) < container.stat().st_size  # type: ignore[index]
    (tmp_path / "window.lode").write_bytes(ls.encode(ls.Surface(window)))
    assert main(["view", str(tmp_path / "window.lode"), "--png", str(tmp_path / "window.png")]) == 0
    pictures = []
    for name in ("out-all", "window"):
        with image.open(tmp_path / f"{name}.png") as drawn:
            pictures.append(np.asarray(drawn.convert("RGB"), np.int64))
    below = len(pictures[0]) // 6  # the title, which tells another size
    assert np.array_equal(pictures[0][below:], pictures[1][below:])
    assert main(["view", str(container), "--png", str(out), "--roi", "5:25,10:5000"]) == 1
    assert "got 10:5000" in capsys.readouterr().err


def test_a_size_that_is_too_small_does_not_lose_the_other_pictures(
    tmp_path: Path, container: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    pytest.importorskip("matplotlib")
    out = tmp_path / "out.png"
    assert main(["view", str(container), "--png", str(out), "--at", "3B,all"]) == 0
    assert sorted(path.name for path in tmp_path.glob("*.png")) == ["out-all.png"]
    first, _ = capsys.readouterr().err.splitlines()
    least = int(re.fullmatch(r"lodestream: --at 3B: no picture, since the first one takes (\d+) bytes", first)[1])  # type: ignore[index]
    assert main(["view", str(container), "--png", str(out), "--at", f"1,{least - 1}"]) == 1
    assert f"--at 1, {least - 1}: expected {least} bytes or more" in capsys.readouterr().err
    assert main(["view", str(container), "--png", str(out), "--at", f"{least}B"]) == 0


def test_a_picture_of_a_prefix_has_north_at_the_top(tmp_path: Path) -> None:
    image = pytest.importorskip("PIL.Image")
    pytest.importorskip("matplotlib")
    ramp = np.repeat(np.arange(60.0), 80).reshape(60, 80)
    drawn = []
    for name, step in (("up", 1.0), ("down", -1.0)):
        metadata = {"geotransform": [0.0, 1.0, 0.0, 0.0, 0.0, step]}
        (tmp_path / "a.lode").write_bytes(ls.encode(ls.Surface(ramp, metadata=metadata)))
        assert main(["view", str(tmp_path / "a.lode"), "--png", str(tmp_path / f"{name}.png"), "--at", "200B"]) == 0
        with image.open(tmp_path / f"{name}-200B.png") as picture:
            drawn.append(np.asarray(picture.convert("RGB"), np.int64))
    up, down = (each[len(each) // 3, each.shape[1] // 3] for each in drawn)
    assert np.abs(up - down).max() > 20


@pytest.mark.parametrize(
    "surface",
    [
        ls.Surface(np.random.default_rng(1).normal(size=(9, 1, 3))),
        ls.Surface(np.random.default_rng(1).normal(size=(9, 8, 2)), (True, False)),
        ls.Surface(np.random.default_rng(1).normal(size=(9, 8, 3)), mask=np.eye(9, 8) == 0),
        ls.Surface(np.array([[1.0, np.inf, -np.inf, 2.0]])),
        ls.Surface(np.zeros((9, 8))),
        ls.Surface(np.full((9, 8), 7, np.int16)),
        ls.Surface(np.full((9, 8, 3), 2.5)),
    ],
    ids=["curve", "plane", "holes", "infinite", "zero", "constant", "one point"],
)
def test_pictures_of_every_kind(tmp_path: Path, surface: ls.Surface) -> None:
    pytest.importorskip("matplotlib")
    (tmp_path / "one.lode").write_bytes(ls.encode(surface))
    assert main(["view", str(tmp_path / "one.lode"), "--png", str(tmp_path / "one.png")]) == 0
    assert (tmp_path / "one.png").read_bytes().startswith(b"\x89PNG")


@pytest.mark.parametrize(
    "arguments",
    [
        ["view"],
        ["view", "--at", "1kB"],
        ["view", "--roi", "0:9,0:9"],
        ["view", "--until-done"],
        ["view", "--png", "a.png", "--until-done", "--at", "1kB"],
        ["view", "--png", "a.png", "--until-done", "--roi", "0:9,0:9"],
        ["view", "--png", "a.gif"],
        ["open", "--png", "a.png"],
        ["open", "--port", "65536"],
        ["open", "other.npy", "http://host/a.lode"],
        ["open", "s3://bucket/a.lode"],
    ],
)
def test_wrong_command_lines(container: Path, arguments: list[str]) -> None:
    with pytest.raises(SystemExit) as ended:
        main([*arguments, str(container)])
    assert ended.value.code == 2


@pytest.mark.usefixtures("built")
@pytest.mark.parametrize("option", [["--closed", "both"], ["--precision", "1"], ["--rms", "1"], ["-o", "variable=z"]])
def test_of_what_is_encoded_already_nothing_is_chosen(
    tmp_path: Path, container: Path, capsys: pytest.CaptureFixture[str], option: list[str]
) -> None:
    for shown, what in ((str(container), "a container"), ("http://127.0.0.1:1/a.lode", "an address")):
        assert main(["view", shown, "--png", str(tmp_path / "out.png"), *option]) == 1
        assert f"got {what}, which is shown as it is" in capsys.readouterr().err
        assert not (tmp_path / "out.png").exists()


def test_a_container_of_another_host_is_passed_on(tmp_path: Path, container: Path) -> None:
    with ranged(tmp_path) as host:
        source = RemoteSource(f"{host.url}/{container.name}", None)
        try:
            assert (source.name, source.size) == ("hills", container.stat().st_size)
            assert source.read(10, 30) == container.read_bytes()[10:40]
            assert source.read(0, source.size) == container.read_bytes()
        finally:
            source.close()


@pytest.mark.parametrize("replace", [False, True])
def test_a_file_that_has_changed(container: Path, replace: bool) -> None:
    source = FileSource(container)
    other = container.with_suffix(".new") if replace else container
    other.write_bytes(bytes(source.size))
    os.utime(other, ns=(1, 1))
    other.replace(container)
    with pytest.raises(ls.LodestreamError, match="has changed"):
        source.read(0, 10)


def test_a_container_of_another_host_that_has_changed(tmp_path: Path, container: Path) -> None:
    with ranged(tmp_path) as host:
        source = RemoteSource(f"{host.url}/{container.name}", None)
        try:
            container.write_bytes(bytes(source.size))
            with pytest.raises(ls.RemoteError, match="got another"):
                source.read(0, 10)
        finally:
            source.close()


@pytest.fixture
def viewing(built: Path, container: Path) -> Iterator[subprocess.Popen[str]]:
    code = (
        f"import sys; from pathlib import Path; from lodestream import page; made = page.assets(Path({str(built)!r}))\n"
        "from lodestream_client.commands import open; open.assets = lambda: made\n"
        "from lodestream_client.program import main; sys.exit(main(sys.argv[1:]))"
    )
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join(filter(None, sys.path)), "PYTHONUNBUFFERED": ""}
    command = [sys.executable, "-c", code, "open", str(container), "--no-browser"]
    with subprocess.Popen(
        command, env=environment, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True
    ) as process:
        try:
            yield process
        finally:
            process.kill()


@pytest.mark.usefixtures("interrupts")
@pytest.mark.parametrize(("number", "code"), [(signal.SIGINT, 0), (signal.SIGTERM, 143)])
def test_the_page_is_there_until_it_is_told_to_end(
    viewing: subprocess.Popen[str], container: Path, number: signal.Signals, code: int
) -> None:
    assert viewing.stdout is not None
    url = viewing.stdout.readline().strip()
    assert httpx.get(url, timeout=PATIENCE).status_code == 200
    while "progress" in httpx.get(url + "view.json", timeout=PATIENCE).json()["surfaces"][0]:
        pass
    assert httpx.get(url + "surface.lode", timeout=PATIENCE).content == container.read_bytes()
    viewing.send_signal(number)
    assert viewing.wait(PATIENCE) == code
