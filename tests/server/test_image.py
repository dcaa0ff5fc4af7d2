"""The image of docker/ can read what the server reads by default, within a limit of memory."""

from __future__ import annotations

import importlib.util
import re
import sys
from pathlib import Path
from types import ModuleType

import pytest

from lodestream_server.operation.settings import Settings

ROOT = Path(__file__).parents[2]
#: Formats by the extra that their libraries come with.
NEEDED = {"formats": {"geotiff", "netcdf", "png", "esri-ascii", "srtm-hgt"}, "vtk": {"vtk", "vts", "cgns"}}

_EXTRAS = re.compile(r"(?:lodestream|'\.)\[([\w,]+)\]")


@pytest.mark.parametrize(("page", "more"), [("docker/Dockerfile", {"stores"}), ("docs/operating.md", {"distributed"})])
def test_the_extras_of_a_server_are_those_of_the_default_formats(page: str, more: set[str]) -> None:
    default = Settings.model_fields["formats"].default
    wanted = {"server", *(extra for extra, formats in NEEDED.items() if formats & set(default))}
    assert wanted == {"server", "formats", "vtk"}
    installed = [set(extras.split(",")) for extras in _EXTRAS.findall((ROOT / page).read_text())]
    servers = [extras for extras in installed if "server" in extras]  # the workers of a cluster read no formats
    assert servers
    for extras in servers:
        assert wanted <= extras <= wanted | more
    for extras in installed:
        assert "server" in extras or extras <= more


def test_the_compose_file_limits_memory() -> None:
    for name in ("compose.yaml", "compose.scale.yaml"):
        limits = re.findall(r"(?m)^ {2,4}(?:mem|memswap)_limit: (\S+)$", (ROOT / "docker" / name).read_text())
        assert limits == ["4g", "4g"]
    assert "4 GiB of memory" in (ROOT / "docs/operating.md").read_text()


def image_check() -> ModuleType:
    """The program of ``make image-check``, which lies in no package."""
    spec = importlib.util.spec_from_file_location("image_check", ROOT / ".ci/image.py")
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    sys.modules[spec.name] = module  # its dataclasses look for it there
    spec.loader.exec_module(module)
    return module


def test_image_check_knows_every_instruction_of_the_dockerfile() -> None:
    found = image_check().instructions((ROOT / "docker/Dockerfile").read_text())
    names = [instruction.name for instruction in found]
    assert names[0] == "FROM"
    assert names[-2:] == ["ENTRYPOINT", "CMD"]
    (healthcheck,) = [instruction.text for instruction in found if instruction.name == "HEALTHCHECK"]
    assert "--retries=3" in healthcheck
    assert "/healthz" in healthcheck
    assert not any("#" in instruction.text or "\\" in instruction.text for instruction in found)


@pytest.mark.parametrize(
    "line", ["ADD a b", "COPY --from=build a b", "RUN --network=none true", "FROM debian", "HEALTHCHECK NONE"]
)
def test_image_check_refuses_what_it_does_not_know(line: str, tmp_path: Path) -> None:
    module = image_check()
    image = module.Image(tmp_path)
    image._stage = module.Stage(tmp_path)
    with pytest.raises(SystemExit, match=r"not known to image\.py"):
        image.follow(*module.instructions(line))
    assert list(tmp_path.iterdir()) == []


def test_image_check_leaves_out_what_the_dockerignore_does() -> None:
    module = image_check()
    rules = module.Image(ROOT)._rules
    taken = ["pyproject.toml", "core/lodestream/sizes.py", "client/web/src/main.ts", "core/lodestream/page/__init__.py"]
    left = [
        "docs/cli.md",
        "core/lodestream/native/x.so",
        "server/a/b/__pycache__/c.pyc",
        "client/web/node_modules/a/b.js",
    ]
    assert not [path for path in taken if module.ignored(path, rules)]
    assert not [path for path in left if not module.ignored(path, rules)]
