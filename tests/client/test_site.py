"""The public demo: a folder that a host of files serves, and surfaces that arrive as they were generated."""

from __future__ import annotations

from pathlib import Path

import httpx
import numpy as np
import pytest

from lodestream_client import Client
from lodestream_client.demo import site
from tests.client.files import ranged
from tests.patience import PATIENCE


@pytest.mark.usefixtures("built")
@pytest.mark.long
def test_a_host_of_files_serves_five_surfaces_of_different_kinds(tmp_path: Path) -> None:
    folder = tmp_path / "new" / "site"
    assert site.main([str(folder)]) == 0
    kinds = set()
    with ranged(folder) as host:
        assert "<title>page</title>" in httpx.get(f"{host.url}/index.html", trust_env=False, timeout=PATIENCE).text
        config = httpx.get(f"{host.url}/view.json", trust_env=False, timeout=PATIENCE).json()
        assert [entry["name"] for entry in config["surfaces"]] == list(site.SURFACES)
        for entry in config["surfaces"]:
            assert (folder / entry["src"]).stat().st_size == entry["bytes"]
            with Client(f"{host.url}/#{entry['name']}").connect(f"{host.url}/#{entry['name']}") as stream:
                views = list(stream)
            assert len(views) > 5
            assert views[-1].complete
            arrived, generated = views[-1].surface(), site.SURFACES[entry["name"]]()
            assert entry["title"] == generated.metadata["name"]
            for block, original in zip(arrived.blocks, generated.blocks, strict=True):
                assert np.array_equal(block.points, original.points, equal_nan=True)
                assert block.points.dtype == original.points.dtype
                for name, values in original.attributes.items():
                    assert np.array_equal(block.attributes[name], values, equal_nan=True)
            first = generated.blocks[0]
            kinds.add(
                (len(generated.blocks), first.points.ndim, first.closed, first.holes > 0, tuple(first.attributes))
            )
    assert len(kinds) == len(site.SURFACES) == 5


@pytest.mark.usefixtures("built")
def test_the_page_of_a_map_shows_what_the_site_has(tmp_path: Path) -> None:
    given = tmp_path / "given"
    given.mkdir()
    example = (Path(__file__).parents[2] / "client" / "web" / "examples" / "map.html").read_text(encoding="utf-8")
    for name, text in (("map.html", example), ("maplibre.js", "// code"), ("maplibre.js.map", "{}")):
        (given / name).write_text(text, encoding="utf-8")
    for _ in range(2):  # once more into what is there
        assert site.main([str(tmp_path / "site"), str(given)]) == 0
        copied = tmp_path / "site" / "map"
        assert sorted(path.name for path in copied.iterdir()) == ["index.html", "maplibre.js"]
        assert "lode://../index.html#mountains" in (copied / "index.html").read_text(encoding="utf-8")


@pytest.mark.usefixtures("built")
def test_a_folder_with_other_files_is_left_alone(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (tmp_path / "out").mkdir()
    (tmp_path / "out" / "view.json").write_text('{"zoom": 3}')
    assert site.main([str(tmp_path / "out")]) == 1
    assert "expected a view.json that lodestream publish has written" in capsys.readouterr().err
    assert [path.name for path in (tmp_path / "out").iterdir()] == ["view.json"]


def test_a_page_that_is_not_built_is_told(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr("lodestream_client.demo.site.assets", dict)
    assert site.main([str(tmp_path / "out")]) == 1
    assert "make page" in capsys.readouterr().err
    assert not (tmp_path / "out").exists()
    assert site.main([]) == site.main(["a", "b", "c"]) == 2


def test_the_blocks_of_the_moon_share_the_points_of_their_sides() -> None:
    blocks = [block.points for block in site.moon().blocks]
    sides = np.concatenate(
        [np.concatenate([points[0], points[-1], points[1:-1, 0], points[1:-1, -1]]) for points in blocks]
    )
    length = len(blocks[0]) - 2
    assert len(np.unique(sides, axis=0)) == 12 * length + 8
