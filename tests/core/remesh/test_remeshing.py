from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

import lodestream as ls
from lodestream.errors import FormatError, OptionError, TooLargeError
from lodestream.mesh import weld
from lodestream.remesh import remeshing
from lodestream.remesh.cells import find_nearest, grow_cells, place_sites
from lodestream.remesh.cleaning import clean, longest_edges, refine
from lodestream.remesh.distances import Distances, folded_quads, measure
from lodestream.remesh.maps import Maps
from lodestream.remesh.relaxation import Relaxation
from lodestream.remesh.remeshing import Remeshing, _unfolded, remesh_triangles
from lodestream.remesh.rims import trace_rims
from lodestream.remesh.samples import Grids, quads_of
from lodestream.remesh.triangulation import Triangulation
from tests.examples import examples

from . import scenes
from .layouts import blocks_of, check_pairs, cut

pytest.importorskip("igl")

ALL = {**scenes.CLOSED, **scenes.OPEN}


def edges_of(result: Remeshing) -> tuple[np.ndarray, np.ndarray]:
    """Edges between samples, and how many quads each has."""
    quads = quads_of(result.grids.numbers)
    edges = np.sort(np.stack([quads, np.roll(quads, -1, axis=1)], axis=-1).reshape(-1, 2), axis=1)
    return np.unique(edges, axis=0, return_counts=True)


@pytest.fixture(scope="module", params=ALL)
def remeshed(request: pytest.FixtureRequest) -> tuple[str, Remeshing]:
    return request.param, remesh_triangles(*ALL[request.param](), blocks=24, error=1e-2)


@pytest.mark.sweep(4)
@pytest.mark.long
def test_a_closed_surface_stays_closed_and_no_edge_has_three_quads(remeshed: tuple[str, Remeshing]) -> None:
    name, result = remeshed
    _, count = edges_of(result)
    assert count.max() == 2
    assert (count.min() == 2) == (name in scenes.CLOSED)


@pytest.mark.sweep(4)
def test_the_genus_is_kept(remeshed: tuple[str, Remeshing]) -> None:
    _, result = remeshed
    edges, _ = edges_of(result)
    characteristic = result.grids.count - len(edges) + len(quads_of(result.grids.numbers))
    assert characteristic == result.mesh.characteristic().sum()
    assert len(np.unique(result.grids.numbers)) == result.grids.count


@pytest.mark.sweep(4)
def test_the_surface_is_near_both_ways(remeshed: tuple[str, Remeshing]) -> None:
    _, result = remeshed
    assert result.distances.rms < 1e-2
    assert result.distances.largest < 6e-2
    assert result.folds <= 0.02 * len(quads_of(result.grids.numbers))
    assert result.folds == folded_quads(result.mesh, quads_of(result.grids.numbers), result.points).sum()


@pytest.mark.sweep(4)
def test_faces_look_the_way_of_the_input(remeshed: tuple[str, Remeshing]) -> None:
    _, result = remeshed
    corners = result.points[quads_of(result.grids.numbers)]
    normals = np.cross(corners[:, 2] - corners[:, 0], corners[:, 3] - corners[:, 1])
    _, triangles, _ = result.mesh.closest(corners.mean(axis=1))
    assert ((normals * result.mesh.normals[triangles]).sum(axis=1) > 0).mean() > 0.95


@examples(15)
@given(st.integers(0, 10_000), st.sampled_from([*ALL]), st.integers(4, 60))
def test_random_cells_are_paired_without_exception(seed: int, name: str, count: int) -> None:
    check_pairs(cut(*ALL[name](), count, seed), name in scenes.CLOSED)


@pytest.mark.long
def test_cells_are_discs_and_no_triangle_is_turned_over_in_their_maps() -> None:
    for scene in ALL.values():
        cells = cut(*scene(), 30)
        rims = trace_rims(cells)
        assert min(map(len, rims.sides)) >= 3
        assert Maps(cells, rims).folded == 0


def test_further_sites_are_found_as_if_all_had_been_there() -> None:
    for scene in (scenes.torus, scenes.disc, scenes.components):
        mesh, _, _ = clean(*scene())
        triangles = np.random.default_rng(0).permutation(len(mesh.faces))
        first = np.unique([*triangles[:9], *np.unique(mesh.components, return_index=True)[1]])
        more = np.setdiff1d(triangles[9:14], first)
        step, whole = find_nearest(mesh, first).plus(mesh, more), find_nearest(mesh, np.concatenate([first, more]))
        np.testing.assert_array_equal(step.triangles, whole.triangles)
        np.testing.assert_allclose(step.distance, whole.distance)
        assert (step.labels == whole.labels).mean() > 0.999  # two sites may be equally near


def test_maps_that_are_known_are_those_that_would_be_made() -> None:
    mesh, _, _ = clean(*scenes.torus())
    fine, _ = refine(mesh, np.array([0.1]))
    sites = place_sites(fine, np.array([20]))
    cells, sites = grow_cells(fine, sites, 1000)
    before = Maps(cells, trace_rims(cells))
    cells, _ = grow_cells(fine, sites.plus(fine, np.setdiff1d([5], sites.triangles)), 1000)
    rims = trace_rims(cells)
    count = np.arange(cells.count).repeat(30)
    random = np.random.default_rng(1)
    places = random.random(len(count)), random.random(len(count)) * 2 * np.pi
    step, whole = Maps(cells, rims, before), Maps(cells, rims)
    assert len(before.discs.keys() & whole.discs.keys()) > 10
    np.testing.assert_allclose(step.locate(count, *places)[0], whole.locate(count, *places)[0], atol=1e-9)


def test_borders_are_not_paid_for_with_blocks() -> None:
    """A disc has about as many blocks as it has cells; kites would be six times as many."""
    cells = cut(*scenes.disc(), 30)
    assert len(blocks_of(cells)) <= cells.count


def test_points_of_the_border_stay_on_the_border() -> None:
    result = remesh_triangles(*scenes.disc(), blocks=12, error=1e-2)
    edges, count = edges_of(result)
    rim = result.points[np.unique(edges[count == 1])]
    assert np.abs(np.hypot(rim[:, 0], rim[:, 1]) - 1).max() < 5e-3  # between two vertices of the polygon


def test_sharp_edges_and_corners_of_a_cube_are_kept() -> None:
    result = remesh_triangles(*scenes.cube(), blocks=24, error=1e-3)
    assert result.distances.rms < 1e-3
    gap = np.linalg.norm(result.points[:, None] - scenes.cube()[0], axis=2).min(axis=0)
    assert gap.max() < 1e-6
    assert result.sharp_edges >= 12


def test_quads_that_are_folded_are_unfolded() -> None:
    result = remesh_triangles(*scenes.torus(), blocks=24, error=1e-2)
    quads = quads_of(result.grids.numbers)
    points = result.points.copy()
    for block in result.grids.numbers[::3]:
        points[block[3:5, 4]] = points[block[3:5, 4][::-1]]
    before = folded_quads(result.mesh, quads, points)
    assert before.sum() > 8
    unfolded, left = _unfolded(result.mesh, Relaxation(result.mesh), result.grids, points, before)
    assert left.sum() <= result.folds
    np.testing.assert_array_equal(left, folded_quads(result.mesh, quads, unfolded))
    moved = np.unique(quads[np.isin(quads, quads[before]).any(axis=1)])
    untouched = np.setdiff1d(np.arange(len(points)), moved)
    np.testing.assert_array_equal(unfolded[untouched], points[untouched])
    assert result.mesh.closest(unfolded[moved])[0].max() < 1e-9


@pytest.mark.long
def test_sites_are_shared_out_by_area() -> None:
    result = remesh_triangles(*scenes.components(), blocks=60, error=1e-9, most_points=60 * 3 * 17**2)
    large = result.points[result.grids.numbers].reshape(len(result.grids.numbers), -1, 3)[:, :, 2].max(axis=1) < 3
    assert large.sum() > 25  # of twelve components the one with nine tenths of the area
    assert result.distances.rms < 3e-3


def test_the_error_that_is_asked_for_decides_how_many_points_a_block_has() -> None:
    coarse = remesh_triangles(*scenes.sphere(), blocks=24, error=2e-2)
    fine = remesh_triangles(*scenes.sphere(), blocks=24, error=5e-4)
    assert coarse.grids.intervals == 8
    assert fine.grids.intervals > 8
    assert fine.distances.rms <= 5e-4 < coarse.distances.rms


def test_samples_that_are_far_from_the_error_are_not_measured_in_full(monkeypatch: pytest.MonkeyPatch) -> None:
    sizes = []

    def measured(mesh: Triangulation, grids: Grids, points: np.ndarray) -> Distances:
        sizes.append(grids.intervals)
        return measure(mesh, grids, points)

    monkeypatch.setattr(remeshing, "measure", measured)
    result = remesh_triangles(*scenes.sphere(), blocks=8, error=1e-9, most_points=12 * 17**2)
    assert result.grids.intervals == 16
    assert set(sizes) == {16}


@pytest.mark.long
def test_the_same_mesh_gives_the_same_blocks() -> None:
    first, second = (remesh_triangles(*scenes.torus(), blocks=24, error=1e-2) for _ in range(2))
    np.testing.assert_array_equal(first.points, second.points)
    np.testing.assert_array_equal(first.grids.numbers, second.grids.numbers)


def test_doubled_vertices_and_faces_and_mixed_windings_are_cleaned() -> None:
    points, faces = scenes.sphere()
    soup = points[faces].reshape(-1, 3)  # as an STL has it
    triangles = np.arange(len(soup)).reshape(-1, 3)
    triangles[::3] = triangles[::3][:, [0, 2, 1]]
    triangles = np.concatenate([triangles, triangles[:5], [[0, 0, 1]]])
    mesh, rows, turned = clean(soup, triangles)
    assert len(mesh.vertices) == len(points)
    assert len(mesh.faces) == len(faces)
    assert not mesh.border.any()
    restored = triangles[rows]
    restored[turned] = restored[turned][:, [0, 2, 1]]
    np.testing.assert_array_equal(mesh.vertices[mesh.faces], soup[restored])


def test_fans_at_one_vertex_get_vertices_of_their_own() -> None:
    points, faces = scenes.sphere(100)
    mirrored = points.copy()
    mirrored[:, 0] = 2 * points[:, 0].max() - points[:, 0]
    mesh, _, _ = clean(np.concatenate([points, mirrored]), np.concatenate([faces, faces[:, ::-1] + len(points)]))
    assert mesh.characteristic().tolist() == [2, 2]


def beside(first: scenes.MeshArrays, second: scenes.MeshArrays) -> scenes.MeshArrays:
    """Two meshes as one."""
    return np.concatenate([first[0], second[0]]), np.concatenate([first[1], second[1] + len(first[0])])


def sliver(height: float) -> scenes.MeshArrays:
    """A strip of triangles of that height, two long, with vertices on both sides."""
    x = np.linspace(0, 2, 9)
    points = np.concatenate([np.column_stack([x, 0 * x, 0 * x + 5]), np.column_stack([x, 0 * x + height, 0 * x + 5])])
    low = np.arange(8)
    faces = np.concatenate([np.stack([low, low + 1, low + 10], -1), np.stack([low, low + 10, low + 9], -1)])
    return points, faces


def test_a_component_without_area_is_dropped() -> None:
    """Its edges would be halved for ever."""
    mesh, rows, turned = clean(*beside(scenes.cube(), sliver(0)))
    assert (len(mesh.vertices), len(mesh.faces), len(rows), len(turned)) == (8, 12, 12, 12)
    assert rows.max() == 11
    result = remesh_triangles(*beside(sliver(0), scenes.cube()), blocks=24, error=1e-2)
    assert result.rows.min() == 16
    assert result.distances.rms < 1e-2


@pytest.mark.parametrize("height", [1e-3, 1e-9])
@pytest.mark.long
def test_a_narrow_component_is_cut_into_so_many_triangles_only(height: float) -> None:
    result = remesh_triangles(*beside(scenes.cube(), sliver(height)), blocks=12, error=1e-2)
    mesh = Triangulation(*sliver(height))
    longest = longest_edges(mesh, np.sqrt(mesh.areas.sum() / np.array([4])) / 5, np.array([4]))
    fine, _ = refine(mesh, longest)
    assert len(fine.faces) < 10_000
    _, count = edges_of(result)
    assert count.max() == 2
    assert result.distances.rms < 1e-2


def test_more_components_than_cells_are_refused_at_once() -> None:
    points, faces = scenes.cube()
    places = np.arange(400)[:, None, None] * [3, 0, 0] + points
    every = (np.arange(400)[:, None, None] * 8 + faces).reshape(-1, 3)
    with pytest.raises(FormatError, match=r"got 400 components of 4 cells or more each: .* ask for [0-9]+ blocks"):
        remesh_triangles(places.reshape(-1, 3), every)


def test_more_blocks_than_points_are_refused_before_the_work_begins(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(remeshing, "_adapted", None)
    with pytest.raises(TooLargeError, match=r"at most 100,000 points, got 3,000 blocks of 17\^2: ask for fewer"):
        remesh_triangles(*scenes.sphere(), blocks=4000, most_points=100_000)


def test_a_remedy_that_would_be_refused_is_not_named() -> None:
    points, faces = scenes.cube()
    places = np.arange(4100)[:, None, None] * [3, 0, 0] + points
    every = (np.arange(4100)[:, None, None] * 8 + faces).reshape(-1, 3)
    with pytest.raises(FormatError, match=r"leave out the small ones$"):
        remesh_triangles(places.reshape(-1, 3), every, blocks=100)


@pytest.mark.parametrize("size", [1e-100, 1e100, 1e300])
def test_sizes_beyond_all_measure_are_refused(size: float) -> None:
    points, faces = scenes.cube()
    with pytest.raises(FormatError, match="take another unit"):
        remesh_triangles(points * size, faces)


@pytest.mark.parametrize("size", [1e-30, 1e30])
@pytest.mark.long
def test_the_unit_does_not_matter(size: float) -> None:
    points, faces = scenes.sphere()
    usual, other = (remesh_triangles(points * unit, faces, blocks=24, error=1e-2) for unit in (1, size))
    assert other.distances.rms == pytest.approx(usual.distances.rms, rel=0.2)
    assert len(other.grids.numbers) == len(usual.grids.numbers)


def moebius() -> scenes.MeshArrays:
    turn = np.linspace(0, 2 * np.pi, 40, endpoint=False)
    width = np.array([-0.3, 0.0, 0.3])[:, None]
    radius = 1 + width * np.cos(turn / 2)
    points = np.stack([radius * np.cos(turn), radius * np.sin(turn), width * np.sin(turn / 2)], axis=-1).reshape(-1, 3)
    faces = []
    for row in range(2):
        for column in range(40):
            right = column + 1
            a, b = row * 40 + column, (row + 1) * 40 + column
            c, d = (row * 40 + right, (row + 1) * 40 + right) if right < 40 else ((2 - row) * 40, (1 - row) * 40)
            faces += [[a, c, b], [c, d, b]]
    return points, np.array(faces)


@pytest.mark.parametrize(
    ("mesh", "words"),
    [
        (moebius(), "one side only"),
        ((scenes.cube()[0], np.concatenate([scenes.cube()[1], [[0, 1, 6]]])), "at most two triangles, got 2 edges"),
        ((scenes.cube()[0], scenes.cube()[1][:3]), "at least four triangles"),
        ((np.where(scenes.cube()[0] == 1, np.nan, 0), scenes.cube()[1]), "finite coordinates"),
        ((scenes.cube()[0] * [1, 0, 0], scenes.cube()[1]), "triangles with an area"),
    ],
)
def test_what_is_no_surface_is_refused(mesh: scenes.MeshArrays, words: str) -> None:
    with pytest.raises(FormatError, match=words):
        remesh_triangles(*mesh)


def test_a_surface_with_too_many_handles_is_refused_with_a_remedy() -> None:
    mesh, _, _ = clean(*scenes.gyroid())
    with pytest.raises(FormatError, match="ask for more blocks"):
        grow_cells(mesh, find_nearest(mesh, np.array([0, 100, 200, 300])), 12)


def test_halving_edges_keeps_the_surface_whole() -> None:
    points, faces = scenes.torus()
    mesh = Triangulation(points, faces)
    fine, parents = refine(mesh, np.array([0.05]))
    assert fine.characteristic().tolist() == [0]
    np.testing.assert_allclose(np.bincount(parents, fine.areas), mesh.areas)
    assert np.linalg.norm(np.diff(fine.vertices[fine.edges], axis=1), axis=2).max() <= 0.05


class TestSurfaces:
    def test_blocks_are_watertight_after_coding(self) -> None:
        surface = ls.Surface.from_mesh(*scenes.torus(), remesh=True, blocks=24, remesh_error=1e-2)
        decoded = ls.decode(ls.encode(surface, precision=1e-2))
        before = np.concatenate([block.points.reshape(-1, 3) for block in surface.blocks])
        after = np.concatenate([block.points.reshape(-1, 3) for block in decoded.blocks])
        _, place = np.unique(before, axis=0, return_inverse=True)
        first = np.zeros((place.max() + 1, 3))
        first[place.reshape(-1)] = after
        np.testing.assert_array_equal(first[place.reshape(-1)], after)

    @pytest.mark.parametrize("scene", [scenes.torus, scenes.disc])
    @pytest.mark.long
    def test_any_layer_and_level_is_one_watertight_mesh(self, scene: scenes.Scene) -> None:
        surface = ls.Surface.from_mesh(*scene(), remesh=True, blocks=24, remesh_error=1e-2)
        container = ls.encode(surface)
        characteristics, borders = set(), set()
        for share in (0.3, 0.6, 1.0):
            decoder = ls.Decoder()
            decoder.feed(container[: int(share * len(container))])
            for level in range(1, 4):
                mesh = weld(decoder.surface(level))
                assert not len(mesh.triangles)
                edges = np.sort(np.stack([mesh.quads, np.roll(mesh.quads, -1, axis=1)], axis=-1).reshape(-1, 2), axis=1)
                unique, count = np.unique(edges, axis=0, return_counts=True)
                assert count.max() == 2
                borders.add(bool((count == 1).any()))
                characteristics.add(len(np.unique(mesh.quads)) - len(unique) + len(mesh.quads))
        assert (characteristics, borders) == ({0 if scene is scenes.torus else 1}, {scene is scenes.disc})

    def test_the_metadata_say_what_was_measured(self) -> None:
        surface = ls.Surface.from_mesh(*scenes.sphere(), remesh=True, blocks=24, remesh_error=1e-2)
        report = surface.metadata["remesh"]
        assert report["blocks"] == len(surface.blocks)
        assert report["quads"] == sum(np.prod(np.subtract(block.shape, 1)) for block in surface.blocks)
        assert 0 < report["rms_from_input"] <= 1e-2 * report["diagonal"]
        assert report["rms_to_input"] <= report["largest_to_input"]
        assert ls.decode(ls.encode(surface)).metadata["remesh"] == report

    def test_a_mesh_that_is_a_grid_stays_one(self) -> None:
        rows, columns = np.mgrid[:5, :7]
        points = np.stack([rows, columns, rows * columns], axis=-1).reshape(-1, 3).astype(float)
        corner = (np.arange(4)[:, None] * 7 + np.arange(6)).reshape(-1)
        faces = np.stack([corner, corner + 1, corner + 8, corner + 7], axis=-1)
        surface = ls.Surface.from_mesh(points, faces, remesh=True)
        assert surface.shape == (5, 7)
        assert "remesh" not in surface.metadata

    def test_without_remesh_the_refusal_names_the_option(self) -> None:
        with pytest.raises(FormatError, match="remesh=yes"):
            ls.Surface.from_mesh(*scenes.sphere())

    @pytest.mark.parametrize(
        ("options", "words"),
        [
            ({"blocks": 10}, "together with remesh"),
            ({"remesh": "perhaps"}, "yes or no"),
            ({"remesh": True, "blocks": "many"}, "a number"),
            ({"remesh": True, "blocks": 0}, "from 1"),
            ({"remesh": True, "blocks": 4001}, "from 1 to 4,000, got 4,001: a smaller remesh_error="),
            ({"remesh": True, "remesh_error": 2}, "below 1"),
        ],
    )
    def test_wrong_options_are_refused(self, options: dict[str, Any], words: str) -> None:
        with pytest.raises(OptionError, match=words):
            ls.Surface.from_mesh(*scenes.sphere(), **options)

    def test_attributes_are_sampled_with_the_points(self) -> None:
        points, faces = scenes.sphere()
        colours = np.round(127.5 * (points + 1)).astype(np.uint8)
        attributes: dict[str, Any] = {
            "color": colours,
            "height": points[:, 2],
            "kind": np.where(points[:, 0] > 0, 7, -3),
        }
        surface = ls.Surface.from_mesh(points, faces, attributes, remesh=True, blocks=24, remesh_error=1e-2)
        for block in surface.blocks:
            np.testing.assert_allclose(block.attributes["height"], block.points[..., 2], atol=2e-2)
            assert np.abs(block.attributes["color"] - 127.5 * (block.points + 1)).max() < 6
            assert block.attributes["color"].dtype == np.uint8
            assert set(np.unique(block.attributes["kind"])) <= {7, -3}

    def test_normals_are_left_out_unless_asked_for(self) -> None:
        points, faces = scenes.sphere()
        options: dict[str, Any] = {"remesh": True, "blocks": 24, "remesh_error": 1e-2}
        with pytest.warns(ls.FormatWarning, match="normal left out"):
            surface = ls.Surface.from_mesh(points, faces, {"normal": points}, **options)
        assert not surface.blocks[0].attributes
        kept = ls.Surface.from_mesh(points, faces, {"normal": points}, remesh_normals=True, **options)
        for block in kept.blocks:
            np.testing.assert_allclose(np.linalg.norm(block.attributes["normal"], axis=-1), 1, atol=1e-6)
