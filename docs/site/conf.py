"""Sphinx settings of the documentation site: ``make docs`` builds it from the Markdown pages, as they are on GitHub."""

from __future__ import annotations

import re

from sphinx.application import Sphinx

project = "Lodestream"
author = "The Lodestream authors"

extensions = ["myst_parser"]
source_suffix = {".md": "markdown"}
myst_heading_anchors = 4  # the anchors of headings are those of GitHub
suppress_warnings = ["myst.header"]  # output of benchmarks has headings of the third order only

html_theme = "furo"
html_title = "Lodestream"
html_show_sphinx = False
html_copy_source = False
pygments_style = "friendly"
pygments_dark_style = "native"

_ANCHOR = re.compile(r'<a id="([^"]+)"></a>')


def name_anchors(app: Sphinx, page: str, source: list[str]) -> None:
    """Make anchors in HTML, which docs/api.md has for GitHub, targets whose links Sphinx can check."""
    source[0] = _ANCHOR.sub(r"(\1)=", source[0])


def setup(app: Sphinx) -> None:
    """Connect what changes a page before it is parsed."""
    app.connect("source-read", name_anchors)
