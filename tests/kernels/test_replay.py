"""Calls that are made again: what differs is seen, in the result and in memory, in kernels and in recordings."""

from __future__ import annotations

import shutil
import subprocess
from pathlib import Path

import numpy as np
import pytest

from lodestream import kernels
from lodestream.kernels import INTEGER, REAL, Kernel, reads, reads_plane, writes, writes_plane

from . import declared, scenes
from .compiling import compiled
from .conftest import NAMES, Sources
from .recording import Recorder, _regions

needs_gcc = pytest.mark.skipif(shutil.which("gcc") is None, reason="there is no gcc")


def replay(program: Path, calls: Path) -> subprocess.CompletedProcess[str]:
    return subprocess.run([program, calls], capture_output=True, text=True)


def program_of(sources: Sources) -> Path:
    files = ["calls.c", "replay.c"]
    return compiled(
        "replay", ["gcc"], ["-O1"], files, kernels=sources.folder, names=NAMES, folder=sources.folder.parent
    )


@needs_gcc
def test_the_same_kernel_does_the_same_and_another_does_not(sources: Sources, masks: Path) -> None:
    done = replay(program_of(sources), masks)
    assert (done.returncode, done.stderr) == (0, "")
    assert done.stdout.startswith("8 calls, ")
    assert done.stdout.endswith(" bytes compared: the same\n")
    sources.plant("mask.c", "state[1] = coder.width;", "state[1] = coder.width + 1;")
    done = replay(program_of(sources), masks)
    assert done.returncode == 1
    assert "call 0, mask: memory" in done.stdout
    assert done.stdout.endswith("DIFFERENT\n")


@needs_gcc
def test_every_byte_of_a_recording_counts(sources: Sources, masks: Path, tmp_path: Path) -> None:
    program, content, changed = program_of(sources), masks.read_bytes(), tmp_path / "changed.calls"
    # The last numbers are the places of the last call; before them stand its arguments, and what was there afterwards.
    for place in (3, 9, 17, 25, len(content) - 8 * 12):
        changed.write_bytes(content[:place] + bytes([content[place] ^ 1]) + content[place + 1 :])
        done = replay(program, changed)
        assert done.returncode != 0, place
        assert done.stdout + done.stderr
    for size in (0, 15, 16, 1000, len(content) - 8):
        changed.write_bytes(content[:size])
        assert replay(program, changed).returncode == 2, size


def test_arrays_that_overlap_are_recorded_as_one_piece_of_memory() -> None:
    whole, other = np.arange(60, dtype=np.int32).reshape(6, 10), np.zeros(3, np.uint8)
    left, right = whole[:, :4], whole[2:, 4:7]
    arguments = (reads_plane(np.int32), INTEGER, writes_plane(np.int32), REAL, writes(np.uint8), reads(np.uint8))
    regions, found = _regions(arguments, (left, 1, right, 0.5, other[1:], other[:0]))
    assert found[0] == found[2]
    assert len({found[0], found[4], found[5]}) == 3
    one = regions[found[0]]
    assert (one.end - one.first, one.size, one.written) == (57 * 4, 4, True)  # to the last value of `right`
    assert [regions[found[place]].written for place in (4, 5)] == [True, False]
    with pytest.raises(ValueError, match="of one size"):
        _regions((reads(np.uint8), reads(np.int32)), (whole.view(np.uint8), whole))


def test_a_refused_call_is_recorded_and_refused(tmp_path: Path) -> None:
    state, model = np.zeros(4, np.int64), np.zeros(kernels.MASK_MODEL, np.int32)
    values = (1, 2, 2, 0, 2, np.zeros(3, np.uint8), model, np.zeros(1, np.uint8), state)
    with (tmp_path / "calls").open("wb") as file:
        recorder = Recorder(file)
        with pytest.raises(ValueError, match="do not fit each other"):
            recorder.call(kernels.mask, Kernel.__call__, values)
    assert recorder.calls["mask"] == 1


def test_a_kernel_that_no_scene_calls_is_named(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setattr(scenes, "SCENES", {})
    with pytest.raises(AssertionError, match=r"none that calls .*\bmask\b"):
        scenes.seeds(tmp_path / "calls", 1, 1)


@needs_gcc
def test_a_declaration_that_the_header_contradicts_is_no_program(
    sources: Sources, monkeypatch: pytest.MonkeyPatch
) -> None:
    right = kernels.mask.arguments
    for wrong in ((*right[:5], reads(np.uint8), *right[6:]), (*right[:6], writes(np.uint32), *right[7:]), right[:-1]):
        monkeypatch.setattr(declared, "declarations", lambda wrong=wrong: {"mask": wrong})
        with pytest.raises(RuntimeError, match=r"dispatch\.c"):
            program_of(sources)
