"""``lodestream view --static``: the page and containers as files, for any host of files with Range."""

from __future__ import annotations

import json
import shutil
from collections.abc import Callable, Mapping
from pathlib import Path

from lodestream.errors import LodestreamError
from lodestream.page import INDEX, Asset

from ..terminal.output import replacing
from .sources import Source

__all__ = ["write_static"]

_CONFIG = "view.json"


def write_static(
    folder: Path,
    pages: Mapping[str, Asset],
    sources: Mapping[str, Source],
    progress: Callable[[float], None] = lambda _: None,
) -> None:
    """Write the page, containers and ``view.json``, which lists them, into a folder.

    Parameters
    ----------
    folder : Path
        Made if it is not there. New, empty, or written by this function before; files of the same names are replaced.
    pages : mapping of str to Asset
    sources : mapping of str to Source
        Containers by the names of their files, such as ``surface.lode``, in the order in which the page lists them.
    progress : callable
        Called with the share of all bytes of the containers that is written, 0 to 1.

    Raises
    ------
    LodestreamError
        If the folder holds other files, or a container cannot be read.
    OSError
        If something cannot be written.
    """
    if folder.exists() and not (folder.is_dir() and (_ours(folder) or not any(folder.iterdir()))):
        raise LodestreamError(f"expected a folder that is new, empty, or written by this command before, got {folder}")
    folder.mkdir(parents=True, exist_ok=True)
    if not (folder / _CONFIG).exists():
        _write_config(folder, {})  # marks the folder as ours, should this be interrupted
    total, written = sum(source.size for source in sources.values()), 0
    for name, source in sources.items():
        with replacing(folder / name) as temporary, temporary.open("wb") as file:
            while (done := file.tell()) < source.size:
                file.write(source.read(done, source.size - done))
                progress((written + file.tell()) / total)
        written += source.size
    _write_config(folder, sources)
    # The page comes last, so that it never lists a container that is not there.
    for asset in sorted(pages.values(), key=lambda asset: asset.name == INDEX):
        path = folder / asset.name
        path.parent.mkdir(parents=True, exist_ok=True)
        with replacing(path) as temporary:
            shutil.copyfile(asset.path, temporary)


def _write_config(folder: Path, sources: Mapping[str, Source]) -> None:
    surfaces = [{"name": source.name, "src": name, "bytes": source.size} for name, source in sources.items()]
    with replacing(folder / _CONFIG) as temporary:
        temporary.write_text(json.dumps({"surfaces": surfaces, "live": False}) + "\n", encoding="utf-8")


def _ours(folder: Path) -> bool:
    """Return whether this module has written the list of the folder."""
    try:
        config = json.loads((folder / _CONFIG).read_text(encoding="utf-8"))
    except (OSError, ValueError):
        return False
    return isinstance(config, dict) and config.keys() == {"surfaces", "live"}
