"""What all tests share: profiles of property tests, a folder for what `pull` keeps, and what has loaded the kernels."""

from __future__ import annotations

import gc
import os
import secrets
import signal
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest
from hypothesis import HealthCheck, settings

from lodestream.confinement import available, missing
from tests.examples import EXAMPLES, MARKS, PROFILE, REST, USUAL, chosen

# No deadline: no test here is about time. The same examples in every run, so that a change is judged by what it
# changes; HYPOTHESIS_PROFILE=torture tries others, and 200 times as many, see `tests.examples`.
settings.register_profile(
    "whole",
    deadline=None,
    max_examples=int(os.environ.get(EXAMPLES, USUAL)),
    derandomize=True,
    print_blob=True,
    suppress_health_check=[HealthCheck.too_slow],
)
settings.register_profile("default", settings.get_profile("whole"), max_examples=USUAL // 2)
settings.register_profile("ci", settings.get_profile("default"))
settings.register_profile(REST, settings.get_profile("default"))
settings.register_profile("torture", settings.get_profile("whole"), derandomize=False, max_examples=2000)
settings.register_profile("sanitizers", settings.get_profile("default"))
settings.load_profile(PROFILE)


#: Tests of what needs Linux, beside those that start a server in this process, which are skipped one by one.
OF_LINUX = ("server", "faults", "torture", "client/requests/test_local.py", "client/stream/test_interrupted.py")

if sys.platform != "linux":
    import lodestream_server

    def _skip(*_: object, **__: object) -> None:
        pytest.skip("the server needs Linux")

    # Many modules of tests import it by its name.
    lodestream_server.running_server = _skip
    collect_ignore = list(OF_LINUX)


#: Files that take longest, in `make test` or in `make test-rest`: what begins last is not to be what takes longest.
LONGEST = (
    "tests/history/test_takeovers.py",
    "tests/other_systems/test_main_paths.py",
    "tests/server/builds/test_interrupted_builds.py",
    "tests/history/test_runs.py",
    "tests/core/stores/test_faults.py",
    "tests/server/builds/test_processes.py",
    "tests/client/commands/test_pull_watch.py",
    "tests/server/builds/test_confinement.py",
    "tests/server/builds/test_cluster_builds.py",
    "tests/server/builds/test_levels.py",
    "tests/client/test_xarray_engine.py",
    "tests/client/stream/test_interrupted.py",
    "tests/client/commands/test_large_surfaces.py",
    "tests/server/builds/test_builds.py",
    "tests/server/routes/test_resumable.py",
    "tests/test_hanging.py",
    "tests/server/builds/test_waiting.py",
    "tests/server/test_compose_of_many.py",
    "tests/server/connections/test_connections.py",
    "tests/server/operation/test_command.py",
    "tests/torture/test_lanes.py",
    "tests/server/operation/test_operation.py",
    "tests/server/builds/test_shares.py",
    "tests/core/encoding/test_encode.py",
    "tests/core/decoding/test_reference_decoder.py",
    "tests/server/connections/test_crowds.py",
    "tests/test_tutorial.py",
    "tests/core/encoding/test_effort.py",
    "tests/server/store/test_surfaces.py",
    "tests/server/store/test_fsck.py",
    "tests/client/stream/test_resume.py",
    "tests/core/remesh/test_remeshing.py",
    "tests/client/test_without_kernels.py",
    "tests/client/commands/test_series.py",
    "tests/server/operation/test_start.py",
    "tests/core/formats/test_vtk.py",
    "tests/core/formats/test_cf_conventions.py",
    "tests/core/interop/test_xarray_files.py",
    "tests/core/remesh/test_real_triangles.py",
    "tests/server/builds/test_large_builds.py",
)


def pytest_configure(config: pytest.Config) -> None:
    """Let the processes of pytest-xdist take files in their order here, and not those of the most tests first."""
    config.addinivalue_line("markers", "sweep(count): so many of its cases are its sample, see tests.examples")
    config.addinivalue_line("markers", "long: `make test` leaves it out, `make test-rest` runs it, or its sample")
    config.option.loadscopereorder = False
    gc.disable()  # what is collected stays: to look through it again and again frees nothing


def pytest_ignore_collect(collection_path: Path, config: pytest.Config) -> bool | None:
    """Leave out files of which the profile `REST` takes nothing: each process would take seconds to import them."""
    if PROFILE != REST or _is_named(config) or not collection_path.match("test_*.py"):
        return None
    return None if MARKS.search(collection_path.read_text(encoding="utf-8")) else True


def pytest_collection_finish() -> None:
    """Look for garbage from now on, among what the tests make."""
    gc.freeze()
    gc.enable()


def pytest_collection_modifyitems(config: pytest.Config, items: list[pytest.Item]) -> None:
    """Take the tests of the profile, or all of them if a test is named; begin with the files that take longest."""
    if not _is_named(config):
        taken = chosen(items, PROFILE)
        config.hook.pytest_deselected(items=[item for item in items if item not in taken])
        items[:] = [item for item in items if item in taken]
    places = _places(list(dict.fromkeys(map(_file, items))))
    items.sort(key=lambda item: places[_file(item)])


def _is_named(config: pytest.Config) -> bool:
    return bool(config.option.keyword or config.option.markexpr or any("::" in each for each in config.args))


def _file(item: pytest.Item) -> str:
    return item.nodeid.partition("::")[0]


def _places(files: list[str]) -> dict[str, tuple[int, float]]:
    """Return what sorts files: those that take longest come first, then those of all folders in turn.

    The files of each folder are spread over the whole run, since tests of servers and clients wait for much of their
    time, and those of the core keep a processor busy.
    """
    folders: dict[str, list[str]] = {}
    for file in files:
        folders.setdefault("/".join(file.split("/")[:2]), []).append(file)
    spread = {file: (at + 0.5) / len(folder) for folder in folders.values() for at, file in enumerate(folder)}
    return {file: (LONGEST.index(file) if file in LONGEST else len(LONGEST), spread[file]) for file in files}


@pytest.fixture(scope="session", autouse=True)
def _caches(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Path]:
    """What `pull` keeps, in this process and in those that it starts, is not kept in the user's folder."""
    folder = tmp_path_factory.mktemp("caches")
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("LODESTREAM_CACHE", str(folder / "fixtures"))
        yield folder


@pytest.fixture(autouse=True)
def _cache_of_its_own(_caches: Path) -> Iterator[None]:
    """Many tests pull the same surface, and what one leaves for `pull --resume` is not there for another."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("LODESTREAM_CACHE", str(_caches / secrets.token_hex(8)))
        yield


@pytest.fixture(scope="session", autouse=True)
def _servers_start_everywhere() -> Iterator[None]:
    """Servers as programs of their own start also on machines whose kernel does not confine their builds."""
    with pytest.MonkeyPatch.context() as patch:
        if missing(available()):
            patch.setenv("LODESTREAM_UNCONFINED", "yes")
        yield


@pytest.fixture
def interrupts() -> Iterator[None]:
    """Programs that are started heed them, also where these tests run in the background and ignore them."""
    before = signal.signal(signal.SIGINT, signal.default_int_handler)
    yield
    signal.signal(signal.SIGINT, before)


@pytest.fixture(scope="session")
def one_fork_server() -> Iterator[None]:
    """Servers that are objects here share what calls are forked from: each call has its own process anyway.

    Those that are programs of their own do as they always do. For the whole session, since tests of several folders
    take turns in a process of pytest-xdist.
    """
    if sys.platform != "linux":
        yield
        return
    from lodestream_server.builds import builder
    from lodestream_server.builds.processes import ForkServer
    from tests.server.builds import slow

    class Shared(ForkServer):
        def close(self) -> None:
            """Leave it to the next server."""

    shared = Shared(slow.preload)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(builder, "ForkServer", lambda _: shared)
        yield
    ForkServer.close(shared)
