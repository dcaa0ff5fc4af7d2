"""Kill -9 at random moments: what was acknowledged is there, bit for bit, and nothing is half there."""

from __future__ import annotations

from pathlib import Path

from tests.torture import kills


def test_a_server_that_is_killed_again_and_again(tmp_path: Path) -> None:
    done = kills.run(tmp_path, 2, longest=1.0)
    assert done.servers == 2
    assert done.uploads > 0
