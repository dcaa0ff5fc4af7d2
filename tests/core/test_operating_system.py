"""What a system says that is no answer: locks that fail, and users without a home."""

from __future__ import annotations

import errno
import os
from pathlib import Path

import pytest

from lodestream import operating_system

fcntl = pytest.importorskip("fcntl")  # not on Windows
resource = pytest.importorskip("resource")  # not on Windows


def _refusing(number: int) -> object:
    def flock(*_: object) -> None:
        raise OSError(number, os.strerror(number))

    return flock


@pytest.mark.parametrize("number", [errno.EAGAIN, errno.EACCES])
def test_a_lock_that_another_program_has_is_not_free(monkeypatch: pytest.MonkeyPatch, number: int) -> None:
    monkeypatch.setattr(fcntl, "flock", _refusing(number))
    assert not operating_system.lock(0)


@pytest.mark.parametrize("number", [errno.EAGAIN, errno.EACCES])
def test_a_lock_that_is_waited_for_is_taken_or_fails(monkeypatch: pytest.MonkeyPatch, number: int) -> None:
    monkeypatch.setattr(fcntl, "flock", _refusing(number))
    with pytest.raises(OSError, match=os.strerror(number)):
        operating_system.lock(0, wait=True)


@pytest.mark.parametrize("number", [errno.EPERM, errno.ENOLCK, errno.EIO])
def test_a_lock_that_fails_is_not_taken_for_one_that_another_program_has(
    monkeypatch: pytest.MonkeyPatch, number: int
) -> None:
    monkeypatch.setattr(fcntl, "flock", _refusing(number))
    with pytest.raises(OSError, match=os.strerror(number)):
        operating_system.lock(0)


@pytest.mark.parametrize("hard", [resource.RLIM_INFINITY, 1000, 50])
def test_a_limit_is_lowered_as_far_as_the_hard_one_allows(monkeypatch: pytest.MonkeyPatch, hard: int) -> None:
    limits: dict[int, tuple[int, int]] = {}
    monkeypatch.setattr(resource, "getrlimit", lambda kind: (hard, hard))
    monkeypatch.setattr(resource, "setrlimit", lambda kind, pair: limits.update({kind: pair}))
    operating_system.lower_limit("CPU", 60, grace=1)
    assert limits == {resource.RLIMIT_CPU: (50, 50) if hard == 50 else (60, 61)}


@pytest.mark.parametrize(
    ("soft", "hard", "allowed", "set_to"),
    [
        (100, 1000, 500, [(500, 1000)]),
        (100, 300, 300, [(300, 300)]),
        (800, 1000, 500, []),
        (100, resource.RLIM_INFINITY, 500, [(500, resource.RLIM_INFINITY)]),
        (resource.RLIM_INFINITY, resource.RLIM_INFINITY, 500, []),
    ],
)
def test_the_limit_of_open_files_is_raised_and_never_lowered(
    monkeypatch: pytest.MonkeyPatch, soft: int, hard: int, allowed: int, set_to: list[tuple[int, int]]
) -> None:
    calls: list[tuple[int, int]] = []
    monkeypatch.setattr(resource, "getrlimit", lambda kind: (soft, hard))
    monkeypatch.setattr(resource, "setrlimit", lambda kind, pair: calls.append(pair))
    assert operating_system.raise_file_limit(500) == allowed
    assert calls == set_to
    assert operating_system.file_limit() == (None if soft == resource.RLIM_INFINITY else soft)


def test_a_file_beyond_the_limit_is_refused_and_noticed_and_the_limit_ends_with_the_block(tmp_path: Path) -> None:
    path = tmp_path / "file"
    with operating_system.limited_file_size(100) as exceeded, path.open("wb", buffering=0) as file:
        file.write(bytes(100))
        assert not exceeded()
        with pytest.raises(OSError, match="too large"):
            file.write(b"more")
        assert exceeded()
    path.write_bytes(bytes(200))


def test_a_user_without_a_home_is_told_what_to_set(monkeypatch: pytest.MonkeyPatch) -> None:
    def home() -> Path:
        raise RuntimeError("Could not determine home directory.")

    monkeypatch.delenv("XDG_CACHE_HOME", raising=False)
    monkeypatch.setattr(Path, "home", home)
    with pytest.raises(FileNotFoundError, match="this user has no home; set XDG_CACHE_HOME to a folder"):
        operating_system.cache_home()
