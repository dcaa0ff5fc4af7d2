"""What is left of a harness that is killed: nothing."""

from __future__ import annotations

from pathlib import Path

import psutil
import pytest

from tests.faults.programs import Programs, Server
from tests.faults.shim import CannotError
from tests.server.helpers import eventually


@pytest.mark.long
def test_a_server_ends_with_the_process_it_comes_from(tmp_path: Path) -> None:
    try:
        programs = Programs(tmp_path / "programs")
    except CannotError as error:
        pytest.skip(str(error))
    with programs:
        programs.shim.beneath(tmp_path / "data")
        server = Server(programs, tmp_path / "data")
        assert server.url is not None, server.program.text()
        process = psutil.Process(server.program.pid)
        programs.kill()
        eventually(lambda: not process.is_running() or process.status() == psutil.STATUS_ZOMBIE, "the server to end")
