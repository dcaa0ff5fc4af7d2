"""``lodestream view --static``: the page and a container as files, for any host of files with Range."""

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
_SURFACE = "surface.lode"


def write_static(
    folder: Path, pages: Mapping[str, Asset], source: Source, progress: Callable[[float], None] = lambda _: None
) -> None:
    """Write the page, ``view.json`` and ``surface.lode`` into a folder, which is made if it is not there.

    Parameters
    ----------
    folder : Path
        New, empty, or written by this function before; its files of these names are replaced.
    pages : mapping of str to Asset
    source : Source
    progress : callable
        Called with the share of the container that is written.

    Raises
    ------
    LodestreamError
        If the folder holds other files, or the container cannot be read.
    OSError
        If something cannot be written.
    """
    if folder.exists() and not (folder.is_dir() and (_ours(folder) or not any(folder.iterdir()))):
        raise LodestreamError(f"expected a folder that is new, empty, or written by this command before, got {folder}")
    folder.mkdir(parents=True, exist_ok=True)
    with replacing(folder / _SURFACE) as temporary, temporary.open("wb") as file:
        while (done := file.tell()) < source.size:
            file.write(source.read(done, source.size - done))
            progress(file.tell() / source.size)
    config = {"surfaces": [{"name": source.name, "src": _SURFACE, "bytes": source.size}], "live": False}
    with replacing(folder / _CONFIG) as temporary:
        temporary.write_text(json.dumps(config) + "\n", encoding="utf-8")
    # Last, so that there is never a page without a container, and what was interrupted here is known as ours.
    for asset in sorted(pages.values(), key=lambda asset: asset.name == INDEX):
        path = folder / asset.name
        path.parent.mkdir(parents=True, exist_ok=True)
        with replacing(path) as temporary:
            shutil.copyfile(asset.path, temporary)


def _ours(folder: Path) -> bool:
    return (folder / _CONFIG).is_file() and (folder / _SURFACE).is_file()
