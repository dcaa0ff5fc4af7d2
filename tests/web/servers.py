"""Servers for the tests of `client/web`, until standard input ends; ``python -m tests.web.servers FOLDER``.

Prints one line of JSON: URLs of a surface, of the same surface on a server that wants a token, with the token, and of
its container on a web server that knows Range and on one that does not; and the path of the container.
"""

from __future__ import annotations

import json
import sys
from pathlib import Path

import numpy as np

import lodestream as ls
from lodestream_client import Client
from lodestream_server import running_server
from lodestream_server.access.tokens import TokenFile
from tests.client.files import plain, ranged
from tests.core.surfaces import terrain


def main(folder: Path) -> None:
    """Serve a terrain of 361 x 281 integers."""
    files = folder / "files"
    files.mkdir(parents=True)
    container = files / "terrain.lode"
    heights = np.rint(10 * terrain((361, 281), 4)).astype(np.int16)
    container.write_bytes(ls.encode(ls.Surface(heights, metadata={"name": "terrain"})))
    token, _ = TokenFile(folder / "closed" / "tokens.json").create("tests", ("read", "write"))
    with (
        running_server(folder / "open", workers=1) as server,
        running_server(folder / "closed", workers=1) as closed,
        ranged(files) as static,
        plain(files) as whole,
    ):
        said = {
            "surface": Client(server).upload(container).url,
            "closed": Client(closed, token=token).upload(container).url,
            "token": token,
            "static": f"{static.url}/terrain.lode",
            "whole": f"{whole}/terrain.lode",
            "container": str(container),
        }
        print(json.dumps(said), flush=True)
        sys.stdin.read()


if __name__ == "__main__":
    main(Path(sys.argv[1]))
