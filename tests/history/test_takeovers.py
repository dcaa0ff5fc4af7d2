"""A minute of `tests.torture.takeovers`, on a machine that is not busy."""

from __future__ import annotations

import os
from pathlib import Path

import pytest

from tests.torture import takeovers


@pytest.mark.long
def test_servers_of_one_bucket_that_are_killed_and_stopped_behind_a_network_that_fails(tmp_path: Path) -> None:
    # Nobody lists everything meanwhile: what `changes.json` does not tell is never seen.
    times = takeovers.Times(lease=3.0, look=0.5)
    # Two clients, which leave the processors to the tests beside them; and few kinds, each of them once.
    seed, kept, kinds = int(os.environ.get("LODESTREAM_SEED", "1")), tmp_path / "history", ("stop", "kill", "network")
    done = takeovers.run(tmp_path, len(kinds), times=times, clients=2, seed=seed, kinds=kinds, keep=kept)
    if done.findings:
        pytest.fail("\n".join((*map(str, done.findings), f"python -m tests.history --again {kept}")))
    assert not kept.exists()
    assert [done.disasters[kind] for kind in kinds] == [1, 1, 1]
    assert done.takeovers
    assert done.uploads >= 10
    assert done.deletes
    assert done.ready
