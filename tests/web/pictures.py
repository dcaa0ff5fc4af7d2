"""Pictures for README.md and docs/viewer.md, from generated terrain: ``python -m tests.web.pictures``."""

from __future__ import annotations

import io
import tempfile
from pathlib import Path

import numpy as np
from PIL import Image

import lodestream as ls
from lodestream_client import Client
from lodestream_server import running_server

from .browser import Heard, Tab, chromium, tab

DOCS = Path(__file__).parents[2] / "docs"
MOST_BYTES = 250_000


def terrain() -> ls.Surface:
    """Mountains of 241 x 321 points, 30 m apart: octaves of noise, raised to a power so that valleys are wide."""
    random = np.random.default_rng(41)
    rows, columns = np.mgrid[0:241, 0:321] / 80
    heights = np.zeros(rows.shape)
    for octave in range(7):
        size = 2.0**octave
        for _ in range(5):
            angle, phase = random.uniform(0, 2 * np.pi, 2)
            along = (np.cos(angle) * rows + np.sin(angle) * columns) * size * random.uniform(0.7, 1.4)
            heights += (1 - np.abs(np.sin(along + phase))) / size**1.15
    heights = (heights - heights.min()) / np.ptp(heights)
    heights = np.round(420 + 1900 * heights**1.7, 1).astype(np.float32)
    metadata = {"name": "Mountains", "unit": "m", "geotransform": [500000.0, 30.0, 0.0, 4200000.0, 0.0, -30.0]}
    return ls.Surface(heights, metadata=metadata)


def main() -> None:
    """Draw a surface whole, and as it is after 2.8 kB."""
    with tempfile.TemporaryDirectory() as folder, running_server(Path(folder) / "data", workers=1) as server:
        surface = Client(server).upload(terrain())
        with chromium() as browser, tab(browser, Heard(), (1120, 680)) as shown:
            shown.go(f"{server}/#s={surface.id}")
            shown.everything("m")
            shown.point(0.45, 0.5)
            save(shown, "viewer")
            shown.press(*["["] * sum(moment["bytes"] > 3_000 for moment in shown.moments))
            shown.until(lambda: shown.view.locator("output[for=moment]").inner_text() == "2.84 kB")
            shown.point(0.45, 0.5)
            save(shown, "viewer-coarse")


def save(shown: Tab, name: str) -> None:
    """Write it with a palette: one that fits closely, since others put dark patches into shaded slopes."""
    shown.picture()
    with Image.open(io.BytesIO(shown.page.screenshot())) as image:
        small = image.convert("RGB").quantize(256, kmeans=3, dither=Image.Dither.NONE)
        path = DOCS / f"{name}.png"
        small.save(path, optimize=True)
    if path.stat().st_size > MOST_BYTES:
        raise SystemExit(f"expected at most {MOST_BYTES} bytes, got {path.stat().st_size} in {path}")
    print(path.name, path.stat().st_size)


if __name__ == "__main__":
    main()
