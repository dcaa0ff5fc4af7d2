"""The image of docker/ can read what the server reads by default, within a limit of memory."""

from __future__ import annotations

import re
from pathlib import Path

import pytest

from lodestream_server.operation.table import TABLE

ROOT = Path(__file__).parents[2]
#: Formats by the extra that their libraries come with.
NEEDED = {"formats": {"geotiff", "netcdf", "png", "esri-ascii", "srtm-hgt"}, "vtk": {"vtk", "vts", "cgns"}}

_EXTRAS = re.compile(r"(?:lodestream|'\.)\[([\w,]+)\]")


@pytest.mark.parametrize(("page", "more"), [("docker/Dockerfile", set[str]()), ("docs/operating.md", {"distributed"})])
def test_the_extras_of_a_server_are_those_of_the_default_formats(page: str, more: set[str]) -> None:
    default = TABLE["formats"].default
    wanted = {"server", *(extra for extra, formats in NEEDED.items() if formats & set(default))}
    assert wanted == {"server", "formats", "vtk"}
    installed = [set(extras.split(",")) for extras in _EXTRAS.findall((ROOT / page).read_text())]
    servers = [extras for extras in installed if "server" in extras]  # the workers of a cluster read no formats
    assert wanted in servers
    for extras in servers:
        assert wanted <= extras <= wanted | more
    for extras in installed:
        assert "server" in extras or extras <= more


def test_the_compose_file_limits_memory() -> None:
    limits = re.findall(r"(?m)^    (?:mem|memswap)_limit: (\S+)$", (ROOT / "docker/compose.yaml").read_text())
    assert limits == ["4g", "4g"]
    assert "4 GiB of memory" in (ROOT / "docs/operating.md").read_text()
