"""Builds in folders: late tasks, and builds whose folders are gone."""

from __future__ import annotations

import shutil
from pathlib import Path

import numpy as np
import pytest

from lodestream.container.model import Header
from lodestream.decoding.decoder import Decoder, decode
from lodestream.encoding import build, phases, transform_phases
from lodestream.encoding.build import Build
from lodestream.encoding.encode import encode
from lodestream.encoding.lattice_coordinates import exact_lattices
from lodestream.encoding.phases import Phases
from lodestream.encoding.prepared import prepare
from lodestream.quality import Quality
from lodestream.scratch import FolderScratch
from lodestream.surface import Surface
from lodestream.transform.predictors import default_predictors

from .grid_surfaces import SURFACES, heights
from .test_any_pieces import built


def _header(container: bytes) -> Header:
    decoder = Decoder()
    decoder.feed(container)
    header = decoder.header
    assert header is not None
    return header


def test_a_late_task_of_fitted_predictors_does_no_harm(monkeypatch: pytest.MonkeyPatch) -> None:
    surface = SURFACES["integers"][0]
    prepared = prepare(surface, Quality())
    monkeypatch.setattr(transform_phases, "COEFFICIENT_BITS", 0)  # so that coefficients of fitted predictors do not fit
    expected = built(prepared, 1, 600)
    code, late = Phases._code, list[Path]()

    def after_late_tasks(self: Phases) -> None:
        folder = Path(self._build.folder)
        for kind in ("coefficients", "planes", "rules", "core-rules"):
            for path in sorted((folder / f"plain-{kind}").rglob("*.npy")):
                own = str(path.relative_to(folder).with_suffix("")).removeprefix("plain-")
                assert not self._build.scratch.has(own)
                self._build.scratch.write(own, np.load(path) + 1)
                late.append(path)
        code(self)

    monkeypatch.setattr(Phases, "_code", after_late_tasks)
    container = built(prepared, 1, 600)
    assert len(late) > 10
    assert container == expected
    assert np.array_equal(decode(container).points, surface.points)


def test_predictors_give_way_where_their_coefficients_do_not_fit(monkeypatch: pytest.MonkeyPatch) -> None:
    surface = SURFACES["integers"][0]
    fitted = encode(surface)
    monkeypatch.setattr(transform_phases, "COEFFICIENT_BITS", 0)
    plain = encode(surface)
    headers = [_header(container) for container in (fitted, plain)]
    assert (headers[0].predictors != headers[1].predictors).any()
    assert (headers[1].predictors == default_predictors(headers[1].layout)).all()
    assert np.array_equal(decode(plain).points, surface.points)


def test_units_are_large_where_that_is_worth_its_bytes(monkeypatch: pytest.MonkeyPatch) -> None:
    row, column = np.mgrid[0:200, 0:240]
    steps = Surface((row // 11 * 29 + column // 7 * 13).astype(np.int16))  # alike in one plane, and not in those above
    chosen = encode(steps)
    sizes = []
    for is_worth in (True, False):
        monkeypatch.setattr(phases, "worth", lambda large, small, growth, is_worth=is_worth: is_worth)
        sizes.append(len(encode(steps)))
    assert sizes[0] > 1.1 * sizes[1]
    assert len(chosen) == sizes[1]


def test_builds_whose_folders_are_gone_are_forgotten(tmp_path: Path) -> None:
    def saved(name: str) -> Build:
        prepared = prepare(Surface(heights((20, 30))), Quality())
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
