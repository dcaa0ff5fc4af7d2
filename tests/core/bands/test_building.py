"""Containers built by bands: the bytes of those that are built in one piece."""

from __future__ import annotations

import io
import shutil
import tempfile
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from lodestream.bands import build, transforming
from lodestream.bands.build import Build
from lodestream.bands.building import Building
from lodestream.bands.executing import Execution
from lodestream.bands.front import encode
from lodestream.bands.pieces import CORE_POINTS
from lodestream.decoding.decoder import decode
from lodestream.encoding.lattice_coordinates import exact_lattices
from lodestream.encoding.prepared import prepare
from lodestream.quality import Quality
from lodestream.scratch import FolderScratch, MemoryScratch, Scratch
from lodestream.surface import Surface

from ..surfaces import terrain


def built(surface: Surface, points: int, core_points: int, threads: int = 1, **quality: Any) -> bytes:
    with tempfile.TemporaryDirectory() as folder:
        return _built(FolderScratch(folder), surface, points, core_points, threads, **quality)


def _built(
    scratch: Scratch, surface: Surface, points: int, core_points: int, threads: int = 1, **quality: Any
) -> bytes:
    out = io.BytesIO()
    prepared = prepare(surface, Quality.of(**quality))
    made = Build(scratch, prepared, exact_lattices(prepared), points, core_points)
    Building(made, Execution(made, None, threads), lambda fraction: None).write(out)
    return out.getvalue()


def _heights(shape: tuple[int, int]) -> NDArray[np.int16]:
    return np.rint(200 * terrain(shape)).astype(np.int16)


def _torus(shape: tuple[int, int]) -> NDArray[np.float32]:
    u, v = (np.arange(n) * 2 * np.pi / n for n in shape)
    around = 3 + np.cos(v) + 0.01 * terrain(shape)
    points = np.stack([around * np.cos(u[:, None]), around * np.sin(u[:, None]), np.sin(v) + 0 * around], axis=-1)
    return points.astype(np.float32)


def _surfaces() -> dict[str, tuple[Surface, dict[str, Any]]]:
    heights = _heights((310, 270))
    mask = np.hypot(*np.mgrid[-155:155, -135:135]) < 120
    rng = np.random.default_rng(4)
    columns = np.linspace(0, 2 * np.pi, 200, endpoint=False)
    ring = np.stack(np.broadcast_arrays(np.cos(columns), np.sin(columns), np.arange(150)[:, None] / 50), axis=-1)
    speed = rng.normal(size=heights.shape).astype(np.float32)
    speed[3, 5] = np.nan
    return {
        "integers": (Surface(heights), {}),
        "floats": (Surface(terrain((300, 290)).astype(np.float32)), {}),
        "doubles": (Surface(terrain((260, 290))), {}),
        "precision": (Surface(terrain((300, 290)).astype(np.float32)), {"precision": "1e-4d"}),
        "holes": (Surface(heights, mask=mask), {}),
        "floats with holes": (Surface(np.where(mask, heights, np.nan).astype(np.float32)), {}),
        "attributes": (Surface(heights, attributes={"speed": speed, "kind": (heights > 0).astype(np.uint8)}), {}),
        "ring": (Surface(ring.astype(np.float32), (False, True)), {}),
        "cylinder": (Surface(heights, (False, True)), {"precision": 3.0}),
        "closed rows": (Surface(heights, (True, False)), {}),
        "closed rows of odd number": (Surface(heights[:309], (True, False)), {"precision": 3.0}),
        "closed rows with holes": (Surface(heights[:302], (True, False), mask=mask[:302]), {}),
        "torus": (Surface(_torus((226, 130)), (True, True)), {}),
        "torus with attributes": (
            Surface(_torus((214, 131)), (True, True), attributes={"speed": speed[:214, :131]}),
            {"precision": "1e-4d"},
        ),
        "int64": (Surface(heights.astype(np.int64) * 2**45 + 1), {}),
        "uint64 with holes": (Surface(heights.astype(np.uint64) + np.uint64(2**63), mask=mask), {"precision": 2e4}),
        "attributes of 64 bits": (
            Surface(heights, attributes={"id": rng.integers(-(2**63), 2**63 - 1, (*heights.shape, 2), endpoint=True)}),
            {},
        ),
        "noise": (Surface(rng.integers(0, 2**31, (200, 210)).astype(np.int32)), {}),
        "narrow": (Surface(_heights((1500, 5))), {}),
        "wide": (Surface(_heights((5, 1500))), {}),
        "constant": (Surface(np.full((140, 150), 7.0)), {}),
    }


SURFACES = _surfaces()


@pytest.mark.parametrize("name", SURFACES)
@pytest.mark.parametrize(("points", "core_points"), [(1, 600), (30_000, 600), (30_000, CORE_POINTS)])
def test_bands_give_the_bytes_of_one_piece(name: str, points: int, core_points: int) -> None:
    surface, quality = SURFACES[name]
    whole = encode(surface, **quality)
    assert built(surface, points, core_points, threads=1 + points % 2, **quality) == whole
    # One piece or several, with one thread or two.
    for size, core, threads in ((points, core_points, 2 - points % 2), (1 << 22, 1 << 30, 1)):
        assert _built(MemoryScratch(), surface, size, core, threads, **quality) == whole


def test_a_late_task_of_fitted_predictors_does_no_harm(monkeypatch: pytest.MonkeyPatch) -> None:
    heights = _heights((310, 270))
    monkeypatch.setattr(transforming, "COEFFICIENT_BITS", 0)  # so that coefficients of fitted predictors do not fit
    expected = built(Surface(heights), 30_000, 600)
    code, late = Building._code, list[Path]()

    def after_late_tasks(self: Building) -> None:
        folder = Path(self._build.folder)
        for kind in ("coefficients", "planes", "rules", "core-rules"):
            for path in sorted((folder / f"plain-{kind}").rglob("*.npy")):
                own = str(path.relative_to(folder).with_suffix("")).removeprefix("plain-")
                assert not self._build.scratch.has(own)
                self._build.scratch.write(own, np.load(path) + 1)
                late.append(path)
        code(self)

    monkeypatch.setattr(Building, "_code", after_late_tasks)
    container = built(Surface(heights), 30_000, 600)
    assert len(late) > 10
    assert container == expected
    assert np.array_equal(decode(container).points, heights)


def test_builds_whose_folders_are_gone_are_forgotten(tmp_path: Path) -> None:
    def saved(name: str) -> Build:
        prepared = prepare(Surface(_heights((20, 30))), Quality())
        made = Build(FolderScratch(tmp_path / name), prepared, exact_lattices(prepared), 1000)
        made.save()
        opened = Build.open(str(tmp_path / name))
        assert Build.open(str(tmp_path / name)) is opened
        return made

    first = saved("first")
    shutil.rmtree(first.folder)
    second = saved("second")
    assert list(build._OPENED) == [str(tmp_path / "second")]
    second.save()
    for name in ("third", "fourth"):
        last = saved(name)
    assert list(build._OPENED) == [str(tmp_path / "third"), str(tmp_path / "fourth")]
    last.close()
    assert list(build._OPENED) == [str(tmp_path / "third")]
    with pytest.raises(FileNotFoundError):
        Build.open(str(tmp_path / "first"))
    saved("third").close()
    assert not build._OPENED
