"""The harness of ``make torture``: what one part does to the others, and what is left of a run that is interrupted."""

from __future__ import annotations

import os
import platform
import re
import signal
import subprocess
import sys
from collections.abc import Iterable
from contextlib import suppress
from pathlib import Path

import psutil
import pytest

from tests.patience import PATIENCE
from tests.server.helpers import eventually
from tests.torture import streams
from tests.torture.lanes import STAGES, Lanes, Wish
from tests.torture.parts import PARTS, PROGRESS, Part, Result

MIB = 1 << 20


def figures(used: Iterable[tuple[int, int]], free: int = 0) -> list[streams.Memory]:
    """Figures of memory: how many schedules had run, and bytes in use, beside as many bytes free for each schedule."""
    return [streams.Memory(number, size + number * free, number * free, 300_000) for number, size in used]


def test_memory_that_grows_is_told_from_memory_that_is_warm_or_uneven() -> None:
    numbers = range(0, 50_001, 500)
    flat = [(number, 200 * MIB + min(number, streams.WARM_UP) * 10_000) for number in numbers]
    assert streams.growth(figures(flat)) == 0
    assert streams.growth(figures(flat, free=600)) == 0
    uneven = [(number, size + (number // 500 % 3) * MIB) for number, size in flat]
    assert abs(streams.growth(figures(uneven)) or 0) <= MIB
    leaking = [(number, size + number * 600) for number, size in flat]
    assert (streams.growth(figures(leaking)) or 0) > streams.MOST_GROWTH
    assert streams.growth(figures(flat[:5])) is None
    assert streams.told(figures(flat)).count("blocks") <= 13
    assert streams.told(figures(flat)).endswith("after 50,000")


# Each smaller than what glibc maps for itself, so that all lie one after another.
HOLES = """
from tests.torture import streams

before = streams.memory(0)
blocks = [bytearray(b"x" * 100_000) for _ in range(640)]
grown = streams.memory(1)
del blocks[1::2], blocks[2::3]
holes = streams.memory(2)
print(grown.used - before.used, holes.free - grown.free, holes.used - before.used, len(blocks))
"""


@pytest.mark.skipif(platform.libc_ver()[0] != "glibc", reason="only glibc tells what is free")
@pytest.mark.long
def test_holes_between_blocks_in_use_are_not_in_use() -> None:
    # In a process of its own: in one of many tests, blocks come to lie in what those have left.
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join(filter(None, sys.path))}
    done = subprocess.run([sys.executable, "-c", HOLES], env=environment, stdout=subprocess.PIPE, text=True, check=True)
    grown, freed, left, blocks = map(int, done.stdout.split())
    assert grown > 50 * MIB
    assert freed > 30 * MIB
    assert left < 40 * MIB  # of 64, of which 21 are left
    assert blocks > 200


def test_a_result_comes_whole_from_another_process() -> None:
    result = Result(PARTS["disk"], 20, 10, ("one", "two"), 1.5, None)
    assert Result.of_json(result.to_json()) == result


def torture(page: Path, *arguments: str) -> subprocess.Popen[str]:
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join(filter(None, sys.path))}
    # Without SIGINT, as in the background of a shell.
    command = ["sh", "-c", 'trap "" INT; exec "$@"', "sh"]
    command += [sys.executable, "-m", "tests.torture", *arguments, "--page", str(page)]
    return subprocess.Popen(command, env=environment, stdout=subprocess.PIPE, text=True)


def with_server(process: int, name: str) -> list[psutil.Process]:
    """The processes of a run, once a part is among them and the server that it starts."""
    found = psutil.Process(process).children(recursive=True)
    with suppress(psutil.Error):  # one that ends meanwhile
        words = {word for each in found for word in each.cmdline()}
        return found if {name, "tests.server.alone"} <= words else []
    return []


def is_over(process: psutil.Process) -> bool:
    """Whether it has ended, also where nobody has asked for it yet."""
    with suppress(psutil.NoSuchProcess):
        return bool(process.status() == psutil.STATUS_ZOMBIE)
    return True


@pytest.mark.long
def test_a_run_that_is_interrupted_leaves_what_there_is(tmp_path: Path) -> None:
    page = tmp_path / "page.md"
    page.write_text("# Reliability\n\n## One run\n\nan old one\n")
    with torture(page, "disk", "history", "--count", "0.05", "--seconds", "disk=0") as process:
        eventually(lambda: "`disk` (requests)" in page.read_text(), "the first part to end")
        parts = eventually(lambda: with_server(process.pid, "history"), "the second part to begin")
        process.send_signal(signal.SIGTERM)
        assert process.wait(PATIENCE) == 130
    eventually(lambda: all(map(is_over, parts)), "the processes of the part to end")
    text = page.read_text()
    assert text.startswith("# Reliability\n\n## One run\n")
    assert "an old one" not in text
    assert "**Interrupted, or not yet at its end**" in text
    assert "`history` had not ended" in text
    assert re.search(r"`disk` \(requests\): 0 in \d+ s, \*\*of 100\*\*\.", text)


@pytest.mark.long
def test_what_fails_because_it_was_ended_has_not_failed(tmp_path: Path) -> None:
    page, kept = tmp_path / "page.md", tmp_path / "kept"
    with torture(page, "fuzz", "--resume", str(kept)) as process:
        eventually((kept / "fuzz" / "messages" / "state.json").exists, "the fuzzer to begin")
        process.send_signal(signal.SIGTERM)
        assert process.wait(PATIENCE) == 130
        assert process.stdout is not None
        assert "failed" not in process.stdout.read()
    assert not page.exists()


def test_a_part_that_dies_is_a_result() -> None:
    nobody = Part("nobody", "", "", 1, PARTS["disk"].work)
    result = Lanes(lambda part: None, lambda result: None)._one(Wish(nobody, 7, None))
    assert result is not None
    assert (result.part, result.wanted, result.cases) == (nobody, 7, 0)
    assert "the process ended with 1" in (result.failure or "")
    assert "KeyError: 'nobody'" in (result.failure or "")


def test_every_part_has_a_lane() -> None:
    assert sorted(name for stage in STAGES for lane in stage for name in lane) == sorted(PARTS)


def test_a_part_says_how_far_it_is(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    said = tmp_path / "said"
    with said.open("wb") as output:
        words = f"print('a word'); print('{PROGRESS}half')"
        process = subprocess.Popen([sys.executable, "-c", words], stdout=output, process_group=0)
    Lanes(print, print)._await(process, said)
    assert capsys.readouterr().out == f"{PROGRESS}half\n"
