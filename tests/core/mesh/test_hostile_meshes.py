"""Meshes made to cost much: each refused with its reason, or read, within five seconds of a processor and 512 MiB."""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray

from ..formats.refusals import SECONDS, Refusal, refusals
from ..formats.test_bad_input import MIB

COUNT = 30_000


def obj(faces: NDArray[np.int64]) -> bytes:
    vertices = int(faces.max()) + 1
    lines = [f"v {k % 1009} {k // 1009} {k % 7}" for k in range(vertices)]
    lines += ["f " + " ".join(map(str, face)) for face in (faces + 1).tolist()]
    return "\n".join(lines).encode()


def soup() -> NDArray[np.int64]:
    return np.arange(4 * COUNT).reshape(-1, 4)


def stairs() -> NDArray[np.int64]:
    """A strip of quads along the diagonal of a grid that would have COUNT^2 / 4 cells."""
    faces = []
    a, b, top = 0, 1, 2
    for step in range(COUNT):
        faces.append((a, b, top + 1, top))
        a, b = (b, top + 1) if step % 2 else (top + 1, top)
        top += 2
    return np.array(faces)


def fan() -> NDArray[np.int64]:
    ring = np.arange(1, COUNT + 1)
    return np.stack([np.zeros(COUNT, np.int64), ring, np.roll(ring, -1)], axis=-1)


def many_fans() -> NDArray[np.int64]:
    """Pyramids in a grid: half of all vertices look like poles."""
    side = int(np.sqrt(COUNT / 4))
    r, c = (index.reshape(-1) for index in np.indices((side, side)))
    corners = [(r + i) * (side + 1) + c + j for i, j in ((0, 0), (0, 1), (1, 1), (1, 0))]
    top = (side + 1) ** 2 + np.arange(side * side)
    faces = np.stack([np.stack([corners[k], corners[(k + 1) % 4], top], axis=-1) for k in range(4)])
    return np.random.default_rng(0).permutation(faces.reshape(-1, 3))


def tangle() -> NDArray[np.int64]:
    return np.arange(COUNT)[:, None] + np.arange(4)


def random_faces() -> NDArray[np.int64]:
    faces = np.random.default_rng(1).integers(0, COUNT, (COUNT, 4))
    return faces[[len(set(face)) == 4 for face in faces.tolist()]]


def twisted_rings() -> NDArray[np.int64]:
    """Small tori that wind, each to be cut open by itself."""
    r, c = (index.reshape(-1) for index in np.indices((3, 7)))
    shift = np.where(r == 2, 2, 0)
    ring = np.stack(
        [7 * r + c, 7 * r + (c + 1) % 7, (r + 1) % 3 * 7 + (c + 1 + shift) % 7, (r + 1) % 3 * 7 + (c + shift) % 7], -1
    )
    return np.concatenate([ring + 21 * k for k in range(COUNT // 21)])


CASES = {
    "soup": (soup, "pieces, of 30,000 faces"),
    "stairs": (stairs, "irregular vertices"),
    "many fans": (many_fans, "with six round every inner vertex"),
    "tangle": (tangle, "each edge to join at most two faces"),
    "random faces": (random_faces, "blocks|pieces|two sides|two faces"),
    "twisted rings": (twisted_rings, "connected pieces"),
    "fan": (fan, r"2 x 30000"),
}


@pytest.fixture(scope="module")
def results(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Refusal]:
    folder = tmp_path_factory.mktemp("meshes")
    paths: list[Path] = []
    for name, (make, _) in CASES.items():
        paths.append(folder / f"{name.replace(' ', '_')}.obj")
        paths[-1].write_bytes(obj(make()))
    return dict(zip(CASES, refusals([(path, {}) for path in paths]), strict=True))


@pytest.mark.parametrize("name", CASES)
@pytest.mark.long
def test_meshes_that_cost_much(results: dict[str, Refusal], name: str) -> None:
    result = results[name]
    assert result.error == ("none" if name == "fan" else "FormatError"), result.message
    assert re.search(CASES[name][1], result.message), result.message
    assert result.memory < 512 * MIB
    assert result.seconds < SECONDS
