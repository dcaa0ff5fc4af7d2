"""The shim itself: what it counts, what it lets fail, and that it leaves everything else alone."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest

from tests.faults.cases import cases_of
from tests.faults.shim import ERRORS, SHORT, CannotError, Fault, Shim, Site, library

Says = dict[str, str]

#: Does each thing once, and says what came of it; a process that it starts does the last one.
PROGRAM = """
import os, shutil, subprocess, sys
from pathlib import Path

root = Path(sys.argv[1])


def do(name, function):
    try:
        print(name, function())
    except OSError as error:
        print(name, os.strerror(error.errno).replace(" ", "-"))


path = root / "records" / "0123456789.json"
do("mkdir", lambda: path.parent.mkdir(exist_ok=True))
do("write", lambda: path.open("wb", buffering=0).write(b"0" * 100))
do("read", lambda: len(path.open("rb", buffering=0).read(100)))
do("stat", lambda: path.stat().st_size)
do("list", lambda: len(os.listdir(path.parent)))
do("rename", lambda: path.rename(root / "damaged"))
do("back", lambda: (root / "damaged").rename(path))
do("remove", lambda: shutil.rmtree(path.parent))
command = [sys.executable, "-I", "-c", "import os, sys; os.mkdir(sys.argv[1])", str(root / "work")]
print("child", subprocess.run(command, stderr=subprocess.DEVNULL).returncode)
do("deep", lambda: (root / "work" / "deep").mkdir())
"""

WELL = {
    "mkdir": "None",
    "write": "100",
    "read": "100",
    "stat": "100",
    "list": "1",
    "rename": "{root}/damaged",
    "back": "{root}/records/0123456789.json",
    "remove": "None",
    "child": "0",
    "deep": "None",
}


class Bench:
    """A shim, a folder, and the program."""

    def __init__(self, folder: Path) -> None:
        self.shim = Shim(library(folder, ("records", "damaged", "work", "work/deep")), folder / "page")
        self.folder = folder
        self._runs = 0

    def new(self) -> Path:
        self._runs += 1
        root = self.folder / f"root{self._runs}"
        root.mkdir()
        self.shim.beneath(root)
        return root

    def run(self, root: Path) -> Says:
        command = [sys.executable, "-I", "-c", PROGRAM, str(root)]
        done = subprocess.run(command, env=self.shim.environment(), capture_output=True, text=True, check=True)
        return dict(line.split(" ", 1) for line in done.stdout.splitlines())

    def well(self, root: Path) -> Says:
        return {name: words.format(root=root) for name, words in WELL.items()}


@pytest.fixture(scope="module")
def bench(tmp_path_factory: pytest.TempPathFactory) -> Bench:
    try:
        return Bench(tmp_path_factory.mktemp("shim"))
    except CannotError as error:
        pytest.skip(str(error))


def test_calls_are_counted_by_what_they_are_and_where(bench: Bench) -> None:
    root = bench.new()
    with bench.shim.counting():
        assert bench.run(root) == bench.well(root)
    found = {(site.call, site.place) for site in bench.shim.sites()}
    assert found >= {
        ("mkdir", "records"),
        ("open to write", "records/ID"),
        ("write", "records/ID"),
        ("close", "records/ID"),
        ("open to read", "records/ID"),
        ("read", "records/ID"),
        ("stat", "records/ID"),
        ("readdir", "records"),
        ("rename", "damaged"),
        ("rename", "records/ID"),
        ("unlink", "records/ID"),
        ("rmdir", "records"),
        ("mkdir", "work"),  # by the process that the program starts
        ("mkdir", "work/deep"),
    }
    there = {"child": "1", "deep": "File-exists"}  # folders of these names, by now
    assert bench.run(root) == bench.well(root) | there
    assert {(site.call, site.place) for site in bench.shim.sites()} == found  # nothing was added meanwhile


@pytest.mark.parametrize(
    ("fault", "changes"),
    [
        (Fault("mkdir", "work", 0, "EIO"), {"child": "1", "deep": "No-such-file-or-directory"}),
        (Fault("mkdir", "work/deep", 0, "EIO"), {"deep": "Input/output-error"}),
        (Fault("write", "records/ID", 0, "ENOSPC"), {"write": "No-space-left-on-device", "read": "0", "stat": "0"}),
        (Fault("write", "records/ID", 0, SHORT), {"write": "16", "read": "16", "stat": "16"}),
        (Fault("read", "records/ID", 0, SHORT), {"read": "16"}),
        (Fault("read", "records/ID", 0, "ESTALE"), {"read": "Stale-file-handle"}),
        (Fault("stat", "records/ID", 0, "EACCES"), {"stat": "Permission-denied"}),
        (Fault("readdir", "records", 0, "EIO"), {"list": "Input/output-error"}),
        (Fault("unlink", "records/ID", 0, "EROFS"), {"remove": "Read-only-file-system"}),
        (Fault("rename", "records/ID", 0, "EXDEV"), {"back": "Invalid-cross-device-link", "remove": "None"}),
        (Fault("open to read", "records/ID", 0, "EMFILE"), {"read": "Too-many-open-files"}),
        (Fault("mkdir", "records", 1, "EIO"), {}),  # there is no second one
    ],
    ids=str,
)
@pytest.mark.long
def test_one_call_fails_and_only_that_one(bench: Bench, fault: Fault, changes: Says) -> None:
    root = bench.new()
    with bench.shim.failing(fault):
        assert bench.run(root) == bench.well(root) | changes
    assert bench.shim.hits == bool(changes)
    if changes:
        assert Path(bench.shim.hit).is_relative_to(root.resolve())
    elsewhere = bench.new()
    with bench.shim.failing(fault):
        bench.shim.beneath(root)
        assert bench.run(elsewhere) == bench.well(elsewhere)


def test_each_site_has_every_error_its_call_can_return_and_later_one() -> None:
    site, other = Site("rename", "records/ID", "a.py:1"), Site("fsync", "records", "a.py:2")
    seen: set[Site] = set()
    first = list(cases_of("start", "serve", {site: [0, 3, 4], other: [1]}, seen))
    assert sorted((case.fault.number, case.fault.error) for case in first if case.site == site) == sorted(
        (number, error) for number in (0, 4) for error in ERRORS["rename"]
    )
    assert [case.fault.error for case in first if case.site == other] == list(ERRORS["fsync"])
    again = list(cases_of("start", "another step", {site: [0, 3, 4]}, seen))
    assert [case.fault.number for case in again] == [0, 4]
    assert len({case.fault.error for case in again}) == 1
