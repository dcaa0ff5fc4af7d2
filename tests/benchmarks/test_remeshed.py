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
