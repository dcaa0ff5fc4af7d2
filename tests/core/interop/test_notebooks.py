"""What notebooks show of surfaces and views, and what is said where a library is missing."""

from __future__ import annotations

import base64
import io
import re
import subprocess
import sys

import numpy as np
import pytest

import lodestream as ls
from lodestream.interop.optional import require_library
from tests.core.surfaces import terrain, torus


def picture(html: str) -> tuple[int, int, float]:
    """Width and height of the PNG in a text, and how far its grey values are spread."""
    from PIL import Image

    found = re.search(r'src="data:image/png;base64,([^"]+)"', html)
    assert found
    image = Image.open(io.BytesIO(base64.b64decode(found[1])))
    return *image.size, float(np.asarray(image.convert("L"), np.float64).std())


@pytest.mark.parametrize(
    "surface",
    [
        ls.Surface(terrain((40, 700)), metadata={"name": "<script>", "unit": "m"}),
        ls.Surface(torus(24, 32), (True, True), attributes={"n": np.zeros((24, 32, 2), "i4")}),
        ls.Surface(blocks=[ls.Block(torus(5, 6)), ls.Block(torus(7, 8))]),
    ],
)
def test_a_surface_shows_a_picture_and_sizes(surface: ls.Surface) -> None:
    html = surface._repr_html_()
    width, height, spread = picture(html)
    assert max(width, height) < 700
    assert spread > 5, "not an empty picture"
    rows, columns = surface.blocks[-1].shape
    assert f"{rows}{' (closed)' * surface.blocks[-1].closed[0]} x {columns}" in html
    assert "<script>" not in html
    if surface.blocks[0].attributes:
        assert "n (int32, 2 components)" in html


def test_a_view_shows_bytes_and_errors_and_a_window_too() -> None:
    mask = np.ones((500, 600), np.bool_)
    mask[:9] = False
    container = ls.encode(ls.Surface(terrain((500, 600)).astype("f4"), mask=mask))
    views = ls.Decoder().feed(container)
    early, last = views[2]._repr_html_(), views[-1]._repr_html_()
    assert f"{views[2].bytes:,}" in early
    assert f"{views[2].rms:.4g}" in early
    assert "500 x 600" in early
    assert "0, exact" in last
    assert picture(early)[2] > 5
    decoder = ls.Decoder(ls.Target(region=((20, 60), (30, 90))))
    decoder.feed(container)
    assert "40 x 60" in decoder.view()._repr_html_()


def test_without_matplotlib_there_are_sizes(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "matplotlib.figure", None)
    html = ls.Surface(terrain((4, 5)))._repr_html_()
    assert "<img" not in html
    assert "4 x 5" in html


def test_a_missing_library_is_named_with_its_extra(monkeypatch: pytest.MonkeyPatch) -> None:
    with pytest.raises(ls.UnavailableError, match=r"pip install 'lodestream\[some\]'"):
        require_library("no_such_library_at_all", "some")
    surface = ls.Surface(terrain((4, 5)))
    for name in ("xarray", "pyvista", "trimesh"):
        monkeypatch.setitem(sys.modules, name, None)
        for call in (getattr(surface, f"to_{name}"), lambda name=name: getattr(ls.Surface, f"from_{name}")(None)):
            with pytest.raises((ls.UnavailableError, ModuleNotFoundError), match=name):
                call()


def test_surfaces_load_none_of_these_libraries() -> None:
    script = (
        "import sys, lodestream; lodestream.Surface([[1, 2], [3, 4]]); lodestream.Decoder(lodestream.Target(level=1));"
        "print(sorted({'xarray', 'pyvista', 'trimesh', 'zarr', 'dask', 'matplotlib'} & set(sys.modules)))"
    )
    result = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, check=True)
    assert result.stdout == "[]\n"


def test_a_decoder_takes_a_target_or_a_selection() -> None:
    surface = ls.Surface(terrain((60, 70)).astype("f4"), attributes={"a": np.ones((60, 70)), "b": np.zeros((60, 70))})
    container, region = ls.encode(surface), ((5, 25), (10, 40))
    found = []
    for wanted in (ls.Target(region=region, attributes=("b",)), ls.Selection(region, ("b",))):
        decoder = ls.Decoder(wanted)
        decoder.feed(container)
        found.append(decoder.surface())
    for each in found:
        assert np.array_equal(each.points, surface.points[5:25, 10:40])
        assert list(each.attributes) == ["b"]
    big = ls.encode(np.zeros((900, 900), "f4") + np.arange(900, dtype="f4"))
    ls.Decoder(ls.Target(level=1), max_vertices=4000).feed(big[:400])
    with pytest.raises(ls.TooLargeError):
        ls.Decoder(ls.Target(), max_vertices=4000).feed(big[:400])
