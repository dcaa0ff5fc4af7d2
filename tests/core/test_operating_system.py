"""What a system says that is no answer: locks that fail, and users without a home."""

from __future__ import annotations

import errno
import fcntl
import os
from pathlib import Path

import pytest

from lodestream import operating_system


def _refusing(number: int) -> object:
    def flock(*_: object) -> None:
        raise OSError(number, os.strerror(number))

    return flock


@pytest.mark.parametrize("number", [errno.EAGAIN, errno.EACCES])
def test_a_lock_that_another_program_has_is_not_free(monkeypatch: pytest.MonkeyPatch, number: int) -> None:
    monkeypatch.setattr(fcntl, "flock", _refusing(number))
    assert not operating_system.lock(0)


@pytest.mark.parametrize("number", [errno.EPERM, errno.ENOLCK, errno.EIO])
def test_a_lock_that_fails_is_not_taken_for_one_that_another_program_has(
    monkeypatch: pytest.MonkeyPatch, number: int
) -> None:
    monkeypatch.setattr(fcntl, "flock", _refusing(number))
    with pytest.raises(OSError, match=os.strerror(number)):
        operating_system.lock(0)


def test_a_user_without_a_home_is_told_what_to_set(monkeypatch: pytest.MonkeyPatch) -> None:
    def home() -> Path:
        raise RuntimeError("Could not determine home directory.")

    monkeypatch.delenv("XDG_CACHE_HOME", raising=False)
    monkeypatch.setattr(Path, "home", home)
    with pytest.raises(FileNotFoundError, match="this user has no home; set XDG_CACHE_HOME to a folder"):
        operating_system.cache_home()
