"""The frame of every HTML page: no scripts, no resources of other hosts, and a policy that says so."""

from __future__ import annotations

import base64
import hashlib
from html import escape

from fastapi.responses import HTMLResponse, Response

__all__ = ["html_page"]

_STYLE = """
:root { color-scheme: light dark; --line: #8884; --soft: #8881 }
body { font: 1rem/1.5 system-ui, sans-serif; max-width: 52rem; margin: 3rem auto; padding: 0 1rem }
h2 { margin-top: 2.5rem; border-bottom: 1px solid var(--line) }
code, pre { font: .9em/1.5 ui-monospace, monospace }
code, pre { background: var(--soft); border-radius: .3em; padding: .1em .3em }
pre { padding: .8em 1em; overflow-x: auto }
details { border: 1px solid var(--line); border-radius: .4em; margin: .6em 0; padding: .5em 1em }
summary { cursor: pointer }
summary code { background: none }
.method { display: inline-block; min-width: 4.5em; font-weight: 600 }
table { border-collapse: collapse; width: 100%; margin: .8em 0 }
th, td { text-align: left; vertical-align: top; padding: .3em .8em .3em 0; border-bottom: 1px solid var(--line) }
"""

_STYLE_HASH = base64.b64encode(hashlib.sha256(_STYLE.encode()).digest()).decode()
_HEADERS = {
    "content-security-policy": f"default-src 'none'; style-src 'sha256-{_STYLE_HASH}'; base-uri 'none'; "
    "form-action 'none'; frame-ancestors 'none'",
    "referrer-policy": "no-referrer",
    "x-content-type-options": "nosniff",
}


def html_page(title: str, body: str) -> Response:
    """Return an HTML page.

    Parameters
    ----------
    title : str
        Plain text.
    body : str
        HTML without scripts, styles and images; the page's policy forbids them.
    """
    page = (
        f'<!doctype html>\n<html lang="en">\n<meta charset="utf-8">\n<title>{escape(title)}</title>\n'
        f'<meta name="viewport" content="width=device-width">\n<style>{_STYLE}</style>\n{body}</html>\n'
    )
    return HTMLResponse(page, headers=_HEADERS)
