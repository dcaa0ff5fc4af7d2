"""A browser, servers, and an ear for errors, for the tests of the page.

They take minutes and need Chromium and the built page, so a plain run of pytest leaves them out; `make test-web` sets
LODESTREAM_WEB, and then what is missing is a failure.
"""

from __future__ import annotations

import os
import subprocess
from collections.abc import Callable, Iterator
from contextlib import ExitStack
from pathlib import Path
from typing import TYPE_CHECKING, Any

import pytest

from tests.patience import PATIENCE
from tests.server.programs import server as program
from tests.stores.emulators import ministack, s3

__all__ = ["ministack", "s3"]

if TYPE_CHECKING:
    from playwright.sync_api import Browser

    from .browser import Heard, Tab
    from .shown import Shelf

if not os.environ.get("LODESTREAM_WEB"):
    collect_ignore_glob = ["test_page_*.py"]

WEB = Path(__file__).parents[2] / "client" / "web"

# (name, see `tests.web.browser.tab`) -> page
Tabs = Callable[..., "Tab"]


@pytest.fixture(scope="session")
def browser() -> Iterator[Browser]:
    from . import browser as browsers

    if lacks := browsers.missing():
        pytest.fail(lacks)
    with browsers.chromium() as started:
        yield started


@pytest.fixture
def heard() -> Iterator[Heard]:
    """What is heard of the pages of a test, which has no error in the end."""
    from .browser import Heard

    told = Heard()
    yield told
    told.check()


@pytest.fixture
def tabs(browser: Browser, heard: Heard) -> Iterator[Tabs]:
    """Opens pages, closed after the test."""
    from .browser import tab

    with ExitStack() as stack:

        def opened(url: str, **options: Any) -> Tab:
            return stack.enter_context(tab(browser, heard, **options)).go(url)

        yield opened


@pytest.fixture(scope="session")
def shelf(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Shelf]:
    """A server in a process of its own, and surfaces on it."""
    from .shown import Shelf

    with program(tmp_path_factory.mktemp("server") / "data", formats="all") as started:
        yield Shelf(started.url)


@pytest.fixture(scope="session")
def restricted(tmp_path_factory: pytest.TempPathFactory) -> Iterator[tuple[str, str, str]]:
    """A server that wants a token, a token for everything, and one that allows to read only."""
    from lodestream_server.access.tokens import TokenFile

    folder = tmp_path_factory.mktemp("closed") / "data"
    tokens = TokenFile(folder / "tokens.json")
    token, _ = tokens.create("tests", ("read", "write"))
    reader, _ = tokens.create("reader", ("read",))
    with program(folder) as started:
        yield started.url, token, reader


@pytest.fixture(scope="session")
def closed(restricted: tuple[str, str, str]) -> tuple[str, str]:
    """A server that wants a token, and a token."""
    return restricted[0], restricted[1]


@pytest.fixture(scope="session")
def reader(restricted: tuple[str, str, str]) -> str:
    """A token of that server that allows to read only."""
    return restricted[2]


@pytest.fixture
def outside(tmp_path: Path) -> Path:
    """A folder for the files of a static host."""
    folder = tmp_path / "host"
    folder.mkdir()
    return folder


@pytest.fixture(scope="session")
def library(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The files of the npm package, built as they are for its registry."""
    folder = tmp_path_factory.mktemp("library")
    vite = [str(WEB / "node_modules" / ".bin" / "vite"), "build", "--config", "vite.library.config.ts"]
    subprocess.run([*vite, "--outDir", str(folder), "--logLevel", "error"], cwd=WEB, check=True, timeout=PATIENCE)
    return folder
