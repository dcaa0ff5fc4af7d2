"""Kernels that are wrong on purpose, and calls of the right ones."""

from __future__ import annotations

import shutil
from pathlib import Path

import pytest

from tests.core.entropy.test_mask import blobs

from .compiling import KERNELS
from .recording import recorded

#: All tests here take one kernel, which is compiled in no time.
NAMES = ("mask",)


class Sources:
    """The sources of one kernel in a folder of their own, where they can be changed."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder / "sources"
        self.folder.mkdir(parents=True)
        for path in (*KERNELS.glob("*.h"), KERNELS / "mask.c", KERNELS / "library.c"):
            shutil.copy(path, self.folder)

    def plant(self, name: str, right: str, wrong: str) -> None:
        """Change one place of a file, the only one that reads so."""
        path = self.folder / name
        text = path.read_text()
        assert text.count(right) == 1, f"expected {name} to hold one {right!r}, where the fault is to be planted"
        path.write_text(text.replace(right, wrong))


@pytest.fixture
def sources(tmp_path: Path) -> Sources:
    """Those of the kernel of masks."""
    return Sources(tmp_path)


@pytest.fixture(scope="session")
def masks(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Recorded calls that write and read masks."""
    from lodestream.entropy.mask import decode_mask, encode_mask

    path = tmp_path_factory.mktemp("calls") / "masks.calls"
    with recorded(path, names=NAMES) as recorder:
        for seed, shape in enumerate([(1, 1), (3, 5), (20, 40), (60, 70)]):
            mask = blobs(shape, seed)
            assert (decode_mask(encode_mask(mask), shape, 0) == mask).all()
    assert recorder.calls == {"mask": 8}
    return path
