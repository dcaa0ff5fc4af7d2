"""Distances of the benchmark of meshes are those of surfaces, not of points in another order."""

from __future__ import annotations

import pytest

import lodestream as ls
from tests.core.remesh import scenes

pytest.importorskip("igl")


def test_a_remeshed_surface_is_as_near_as_was_measured_when_it_was_made() -> None:
    from benchmarks.peers.remeshed import error_of

    points, faces = scenes.sphere()
    surface = ls.Surface.from_mesh(points, faces, remesh=True, blocks=24, remesh_error=1e-2)
    report = surface.metadata["remesh"]
    told = max(report["rms_to_input"], report["rms_from_input"]) / report["diagonal"]
    assert error_of(points, faces, ls.decode(ls.encode(surface))) == pytest.approx(told, rel=0.1)


def test_the_generated_torus_is_closed_and_has_about_so_many_triangles() -> None:
    from benchmarks.remeshing import torus
    from lodestream.remesh.triangulation import Triangulation

    mesh = Triangulation(*torus(5_000))
    assert not mesh.border.any()
    assert mesh.characteristic().tolist() == [0]
    assert len(mesh.faces) == pytest.approx(5_000, rel=0.1)


def test_of_draco_the_fewest_triangles_that_reach_an_error_are_looked_for(monkeypatch: pytest.MonkeyPatch) -> None:
    pytest.importorskip("DracoPy")
    pytest.importorskip("fast_simplification")
    from benchmarks.peers import remeshed

    monkeypatch.setattr(remeshed, "_BITS", (12,))
    monkeypatch.setattr(remeshed, "_SAMPLES", 2_000)
    monkeypatch.setattr(remeshed, "ERRORS", (3e-3,))
    rows = list(remeshed._draco(*scenes.torus()))
    tried = sorted(int(row["setting"].split()[0]) for row in rows)
    fewest = min(int(row["setting"].split()[0]) for row in rows if row["rms"] <= 3e-3)
    assert fewest > tried[0]
    assert tried[tried.index(fewest) - 1] > 0.9 * fewest
