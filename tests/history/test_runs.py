"""Short runs of `tests.torture.history`, one for each promise, and clients at several servers."""

from __future__ import annotations

import random
from pathlib import Path

import pytest

from tests.history.checker import check
from tests.history.disasters import KINDS
from tests.history.driver import Client, Crowd, Goods, Server
from tests.history.events import Finding, History
from tests.history.simple import Fault, simple_server
from tests.server.helpers import eventually, hills, npy
from tests.torture import history


def told(folder: Path, *kinds: str, owners: bool = False) -> history.Done:
    done = history.run(folder, len(kinds), kinds=kinds, owners=owners, longest=0.5)
    if done.findings:
        pytest.fail("\n".join(map(str, done.findings)))
    assert all(done.disasters[kind] == 1 for kind in kinds)
    assert done.uploads > 0
    assert done.reads > 0
    return done


@pytest.mark.long
def test_a_server_that_is_ended_and_does_not_find_its_index_or_an_extra(tmp_path: Path) -> None:
    assert told(tmp_path, "restart", "index", "extra").uploads > 0


@pytest.mark.long
def test_a_server_whose_index_is_lost_while_it_runs_and_whose_strays_are_removed(tmp_path: Path) -> None:
    assert told(tmp_path, "live-index", "collect", owners=True).uploads > 0


@pytest.mark.skipif("full" not in history.possible(), reason="no small disk can be mounted on this machine")
def test_a_full_disk(tmp_path: Path) -> None:
    assert told(tmp_path, "full").refused > 0


@pytest.mark.long
def test_two_owners_a_server_that_is_killed_and_a_backup_under_load_that_is_restored(tmp_path: Path) -> None:
    assert told(tmp_path, "kill", "backup", owners=True).owners == 2


def test_every_kind_has_a_run() -> None:
    assert {"restart", "kill", "full", "index", "live-index", "collect", "backup", "extra"} == KINDS.keys()


TOKENS = {name: f"token of {name}" for name in ("ann", "ben", "admin")}


def crowded(*urls: str, count: int = 200) -> list[Finding]:
    """What is found when clients, who are two owners and an admin, do not know which of these they ask."""
    goods, recorded = Goods(tokens=TOKENS), History(admins=frozenset({"admin"}))
    for number in range(3):
        for owner in ("ann", "ben"):
            goods.add(owner, f"hills {number}", npy(hills(20, 20 + number)), array=True)
    servers = [Server(f"server {number}", url) for number, url in enumerate(urls)]
    crowd = Crowd(recorded, goods, lambda: servers, list(goods.bodies), seed=1, size=3)
    client = Client("first", recorded, goods, lambda: servers, crowd.ids, random.Random(1))
    for subject in goods.bodies:
        client.upload(subject)
    with crowd:
        eventually(lambda: len(recorded.operations) >= count, "so many operations")
    for subject in goods.bodies:
        client.look(subject)
        client.fetch(subject)
        client.values(subject)
    client.close()
    return check(recorded)


def test_one_server_at_two_addresses_has_one_history() -> None:
    with simple_server(TOKENS) as url:
        assert crowded(url, url.replace("127.0.0.1", "localhost")) == []


def test_two_servers_that_know_nothing_of_each_other_are_found_out() -> None:
    with simple_server(TOKENS) as one, simple_server(TOKENS) as two:
        assert {finding.rule for finding in crowded(one, two)} & {"lost", "came back", "order"}


@pytest.mark.parametrize(
    ("fault", "rules"),
    [
        ("loses", {"lost"}),
        ("comes back", {"came back"}),
        ("goes back", {"went back"}),
        ("other bytes", {"wrong bytes"}),
        ("other values", {"wrong bytes"}),
        ("no name", {"name"}),
        ("no owners", {"mixed"}),
    ],
)
@pytest.mark.long
def test_a_server_that_does_one_thing_wrong_is_found_out(fault: Fault, rules: set[str]) -> None:
    with simple_server(TOKENS, fault) as url:
        assert rules <= {finding.rule for finding in crowded(url)}
