"""A client that a program has made from the OpenAPI document: it uploads, waits, lists, fetches and deletes."""

from __future__ import annotations

import io
import json
import subprocess
import sys
from collections.abc import Iterator
from importlib import import_module
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import lodestream as ls
from lodestream_server import Settings, create_app, running_server
from lodestream_server.access.tokens import TokenFile
from tests.server.helpers import PATIENCE, hills, npy

PACKAGE = "client_of_the_document"

#: The types of bytes that the generator does not know, and no formatter of its code.
CONFIGURATION = {
    "post_hooks": [],
    "content_type_overrides": dict.fromkeys(
        (
            *("application/vnd.lodestream.container", "application/offset+octet-stream"),
            *("application/vnd.quantized-mesh", "image/png", "image/webp"),
        ),
        "application/octet-stream",
    ),
}


class Generated:
    """The generated package, and a client of it with a token."""

    def __init__(self, url: str, token: str) -> None:
        self.package: Any = import_module(PACKAGE)
        self.models: Any = import_module(f"{PACKAGE}.models")
        self.types: Any = import_module(f"{PACKAGE}.types")
        self.client = self.package.AuthenticatedClient(
            base_url=url, token=token, timeout=PATIENCE, httpx_args={"trust_env": False}
        )

    def ask(self, module: str, *path: Any, **arguments: Any) -> Any:
        """What an operation answers: its status, and what the client made of the body."""
        return import_module(f"{PACKAGE}.api.{module}").sync_detailed(*path, client=self.client, **arguments)

    def file(self, data: bytes, name: str = "file") -> Any:
        return self.types.File(payload=io.BytesIO(data), file_name=name)


@pytest.fixture(scope="module")
def said(tmp_path_factory: pytest.TempPathFactory) -> Iterator[str]:
    """What the generator says while it makes the client, which can then be imported."""
    folder = tmp_path_factory.mktemp("generated")
    (folder / "openapi.json").write_text(json.dumps(create_app(Settings(data=Path("nowhere"))).openapi()))
    (folder / "configuration.json").write_text(json.dumps(CONFIGURATION))
    made = subprocess.run(
        [
            *(sys.executable, "-m", "openapi_python_client", "generate", "--meta", "none", "--path", "openapi.json"),
            *("--config", "configuration.json", "--output-path", PACKAGE),
        ],
        cwd=folder,
        capture_output=True,
        text=True,
        check=True,
    )
    with pytest.MonkeyPatch.context() as patch:
        patch.syspath_prepend(str(folder))
        yield made.stdout + made.stderr


@pytest.fixture(scope="module")
def generated(said: str, tmp_path_factory: pytest.TempPathFactory) -> Iterator[Generated]:
    folder = tmp_path_factory.mktemp("data")
    token, _ = TokenFile(folder / "tokens.json").create("ci", ("write", "read"))
    with running_server(folder / "data", workers=1, token_file=folder / "tokens.json") as url:
        made = Generated(url, token)
        with made.client:
            yield made


def test_the_generator_leaves_nothing_out(said: str) -> None:
    assert "WARNING" not in said.upper(), said


def test_a_generated_client_uploads_waits_lists_fetches_and_deletes(generated: Generated) -> None:
    sent = generated.ask("surfaces.upload_surface", body=generated.file(npy(hills())), name="Hills", precision="0.1%")
    assert (sent.status_code, sent.parsed.name, sent.parsed.owner) == (202, "Hills", "ci")
    ready = generated.ask("surfaces.get_surface", sent.parsed.id, wait=60.0).parsed
    assert isinstance(ready, generated.models.Surface)
    assert (ready.state.value, ready.shape, ready.exact) == ("ready", [40, 30], False)
    assert ready.levels[-1].shape == [40, 30]
    page = generated.ask("surfaces.list_surfaces", limit=10, thumbnails=True).parsed
    assert [it.id for it in page.surfaces] == [ready.id]
    assert page.surfaces[0].thumbnail.startswith("data:image/png")

    held = generated.ask("files.get_surface_container", ready.id).parsed.payload.read()
    assert np.allclose(ls.decode(held).points, hills(), atol=0.001 * ready.extent)

    named = generated.ask("names.point_name", "hills", body=generated.models.Pointing(surface=ready.id))
    assert (named.status_code, named.parsed.id) == (201, ready.id)
    assert [it.name for it in generated.ask("names.list_names").parsed.names] == ["hills"]

    assert generated.ask("surfaces.delete_surface", ready.id).status_code == 204
    gone = generated.ask("surfaces.get_surface", ready.id)
    assert (gone.status_code, gone.parsed.code) == (404, "not-found")
    assert generated.ask("surfaces.list_surfaces").parsed.surfaces == []


def test_a_generated_client_sends_forms_and_options_of_a_format(generated: Generated) -> None:
    archive = io.BytesIO()
    np.savez(archive, low=hills(6, 9), high=hills(8, 5))
    form = generated.models.UploadSurfaceFilesBody(file=[generated.file(archive.getvalue(), "two.npz")])
    sent = generated.ask("surfaces.upload_surface", body=form)
    failed = generated.ask("surfaces.get_surface", sent.parsed.id, wait=60.0).parsed
    assert failed.state.value == "failed"
    options = generated.models.UploadSurfaceOptions.from_dict(failed.choices[1].options.to_dict())
    sent = generated.ask("surfaces.upload_surface", body=form, options=options)
    ready = generated.ask("surfaces.get_surface", sent.parsed.id, wait=60.0).parsed
    assert (ready.state.value, ready.shape, ready.filenames) == ("ready", [8, 5], ["two.npz"])


def test_a_generated_client_sends_a_file_in_parts(generated: Generated) -> None:
    data, version = npy(hills(seed=3)), {"tus_resumable": "1.0.0"}
    begun = generated.ask("resumable_uploads.begin_upload", upload_length=len(data), **version)
    upload = begun.headers["location"].rpartition("/")[2]
    for start in (0, 1000):
        part = generated.file(data[start : start + 1000] if start == 0 else data[start:])
        answer = generated.ask("resumable_uploads.continue_upload", upload, body=part, upload_offset=start, **version)
        assert answer.status_code == 204
    surface = answer.headers["location"].rpartition("/")[2]
    assert generated.ask("surfaces.get_surface", surface, wait=60.0).parsed.shape == [40, 30]
