"""The image of docker/ can read what the server reads by default, within a limit of memory."""

from __future__ import annotations

import re
from pathlib import Path

import pytest

from lodestream_server.operation.table import TABLE

ROOT = Path(__file__).parents[2]
#: Formats by the extra that their libraries come with.
NEEDED = {"formats": {"geotiff", "netcdf", "png", "esri-ascii", "srtm-hgt"}, "vtk": {"vtk", "vts", "cgns"}}


@pytest.mark.parametrize("page", ["docker/Dockerfile", "docs/operating.md"])
def test_the_extras_are_those_of_the_default_formats(page: str) -> None:
    default = TABLE["formats"].default
    wanted = {"server", *(extra for extra, formats in NEEDED.items() if formats & set(default))}
    assert wanted == {"server", "formats", "vtk"}
    installed = re.findall(r"(?:lodestream|'\.)\[([\w,]+)\]", (ROOT / page).read_text())
    assert installed
    for extras in installed:
        assert set(extras.split(",")) == wanted


def test_the_compose_file_limits_memory() -> None:
    limits = re.findall(r"(?m)^    (?:mem|memswap)_limit: (\S+)$", (ROOT / "docker/compose.yaml").read_text())
    assert limits == ["4g", "4g"]
    assert "4 GiB of memory" in (ROOT / "docs/operating.md").read_text()
