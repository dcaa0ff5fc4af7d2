"""The page that shows surfaces in a browser: static files that `client/web` builds into the folder ``static``.

Server and client both serve them, and neither needs Node for it: a wheel and a source distribution hold the built
files. In a working tree they are there after ``make page``. Widgets in notebooks show the same element, from the same
file.
"""

from __future__ import annotations

import functools
import hashlib
from dataclasses import dataclass
from pathlib import Path

__all__ = ["FOLDER", "HEADERS", "HOW_TO_BUILD", "INDEX", "Asset", "assets", "widget_modules"]

FOLDER = Path(__file__).with_name("static")
INDEX = "index.html"
_WIDGET = "notebook.js"
_ELEMENT = "assets/view-*.js"

HOW_TO_BUILD = (
    "The page of the viewer is not built. In a clone, make page builds it with Node 20 or newer; after that, install "
    "Lodestream again. Pictures need no page: lodestream view --png."
)

#: Of every answer with a file of the page. Scripts compile the decoder's WebAssembly and run it in workers, one of
#: which begins as a blob; nothing comes from another host, and no other page may frame this one.
HEADERS = {
    "content-security-policy": "default-src 'self'; script-src 'self' 'wasm-unsafe-eval'; worker-src 'self' blob:; "
    "img-src 'self' data:; base-uri 'none'; form-action 'none'; frame-ancestors 'none'",
    "referrer-policy": "no-referrer",
    "x-content-type-options": "nosniff",
}

#: Types by suffix; the machine's own table may call scripts text/plain, which browsers then refuse.
_TYPES = {
    ".css": "text/css; charset=utf-8",
    ".html": "text/html; charset=utf-8",
    ".js": "text/javascript; charset=utf-8",
    ".json": "application/json",
    ".map": "application/json",
    ".svg": "image/svg+xml",
    ".txt": "text/plain; charset=utf-8",
    ".wasm": "application/wasm",
}


@dataclass(frozen=True)
class Asset:
    """A file of the page.

    Attributes
    ----------
    name : str
        Its address, relative to the page: ``index.html``, or ``assets/...``.
    path : Path
    media_type : str
    etag : str
        A strong entity tag, with its quotes.
    lasting : bool
        Whether a file of this name never changes: its name holds a hash of what is in it.
    """

    name: str
    path: Path
    media_type: str
    etag: str
    lasting: bool

    @property
    def headers(self) -> dict[str, str]:
        """What is sent with the file, beside its type and its length."""
        lasts = "public, max-age=31536000, immutable" if self.lasting else "no-cache"
        return {**HEADERS, "etag": self.etag, "cache-control": lasts}


@functools.lru_cache(maxsize=8)
def assets(folder: Path = FOLDER) -> dict[str, Asset]:
    """Return the files of the page by name; none where it is not built.

    Parameters
    ----------
    folder : Path
        Where they are.
    """
    if not (folder / INDEX).is_file():
        return {}
    found = {}
    for path in sorted(folder.rglob("*")):
        name = path.relative_to(folder).as_posix()
        if path.is_file() and path.suffix in _TYPES and name != _WIDGET:
            digest = hashlib.sha256(path.read_bytes()).hexdigest()
            found[name] = Asset(name, path, _TYPES[path.suffix], f'"{digest[:32]}"', name.startswith("assets/"))
    return found


def widget_modules(folder: Path = FOLDER) -> tuple[Path, Path] | None:
    """Return the module of a widget in notebooks, and that of the viewer's element, which it loads; None: not built.

    Parameters
    ----------
    folder : Path
        Where they are.
    """
    widget, elements = folder / _WIDGET, sorted(folder.glob(_ELEMENT))
    return (widget, elements[0]) if widget.is_file() and len(elements) == 1 else None
