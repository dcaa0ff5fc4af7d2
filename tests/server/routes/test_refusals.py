"""Whatever is wrong in a request is told in a sentence: which field, what it must be, and what came; no Python."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any
from urllib.parse import quote

import httpx
import pytest

from lodestream_server import Settings, create_app
from tests.server.helpers import hills, npy, problem, push

#: What only Python's own words have, or pydantic's.
FOREIGN = ("<class", "{'", "None", "Traceback", "pydantic", " b'", "nput should", "tring should", "parse", "pattern")

#: How it is said what would be right.
EXPECTED = (
    " must be ",
    " must have ",
    " must say ",
    " may be ",
    " may have ",
    " is one of ",
    " is no number ",
    " is missing: it is ",
    "it has levels ",
    "write 0 or more",
)

#: What no parameter of this kind can be.
WRONG: dict[str, tuple[str, ...]] = {
    "integer": ("", "x", "1.5", "[]", "NaN", "1e999", "9" * 30, "9" * 5000),
    "number": ("", "x", "[]", "{}", "NaN", "1e999", "-1e999", "9" * 400),
    "boolean": ("", "x", "2", "[]"),
    "enum": ("", "x", "[]", "9" * 300),
    "pattern": ("/", "\N{LATIN SMALL LETTER A WITH DIAERESIS}", "[]", "x" * 300),
    "maxLength": ("x" * 300,),
}
#: Parameters that are texts in the document, and numbers in what is made of them.
TEXTS = {
    "precision": "tolerance",
    "rms": "tolerance",
    "nodata": "text",
    "Upload-Length": "integer",
    "Upload-Offset": "integer",
}
WRONG |= {"text": ("", "x", "[]"), "tolerance": ("", "x", "[]", "NaN", "1e999", "-1", "x" * 300)}

PATHS: dict[str, Any] = create_app(Settings(data=Path("nowhere"))).openapi()["paths"]

OPERATIONS = [
    (method, path, parameter)
    for path, operations in PATHS.items()
    for method, operation in operations.items()
    for parameter in operation.get("parameters", [])
]


def kind_of(parameter: dict[str, Any]) -> str | None:
    """The key of `WRONG`; None where any text will do."""
    schema = parameter["schema"]
    schema = schema.get("anyOf", [schema])[0]
    if schema == {"type": "string"}:
        return TEXTS.get(parameter["name"])
    for key in ("enum", "pattern", "maxLength"):
        if key in schema:
            return key
    return str(schema["type"])


@pytest.fixture(scope="module")
def real(http: httpx.Client) -> dict[str, str]:
    """Parameters of paths, and headers, that are right."""
    surface = push(http, npy(hills(6, 5)))
    http.put("/v1/names/stays", json={"surface": surface["id"]}).raise_for_status()
    begun = http.post("/v1/uploads", headers={"tus-resumable": "1.0.0", "upload-length": "1000"})
    return {
        **{"surface": surface["id"], "name": "stays", "sha256": surface["container_sha256"], "level": "0"},
        **{"z": "0", "x": "0", "y": "0", "image": "png", "upload": begun.headers["location"].rpartition("/")[2]},
        **{"Tus-Resumable": "1.0.0", "Upload-Length": "1000", "Upload-Offset": "0"},
        "Content-Type": "application/offset+octet-stream",
        "X-HTTP-Method-Override": "PATCH",
    }


def ask(http: httpx.Client, real: dict[str, str], method: str, path: str, wrong: dict[str, Any]) -> httpx.Response:
    """Answer to a request in which one parameter is wrong: `wrong` has where it is, its name and value."""
    values = {**real, **({"surface": real["name"]} if path.startswith("/v1/names/{surface}") else {})}
    query, place, name, value = dict[str, str](), wrong["in"], wrong["name"], wrong["value"]
    if place == "query":
        query[name] = value
    else:
        values[name] = value
    headers = {key: it for key, it in values.items() if key[0].isupper() and "uploads" in path}
    address = path.format(**{key: quote(it, safe="") for key, it in values.items() if not key[0].isupper()})
    content = b"1,2\n3,4\n" if method in ("post", "patch") else None
    return http.request(method.upper(), address, params=query, headers=headers, content=content)


def wrongs(values: slice) -> Iterator[tuple[str, str, dict[str, Any]]]:
    for method, path, parameter in OPERATIONS:
        kind = kind_of(parameter)
        for value in WRONG.get(kind or "", ())[values]:
            # An empty segment is another path, and one with a slash too.
            if parameter["in"] != "path" or value not in ("", "/"):
                yield method, path, {"in": parameter["in"], "name": parameter["name"], "value": value}


@pytest.mark.parametrize("values", [slice(1, 2), pytest.param(slice(None), marks=pytest.mark.long)], ids=["one", "all"])
def test_what_is_wrong_with_a_parameter_is_told_by_its_name(
    http: httpx.Client, real: dict[str, str], values: slice
) -> None:
    refused = 0
    for method, path, wrong in wrongs(values):
        answer = ask(http, real, method, path, wrong)
        case = f"{method} {path} {wrong['name']}={wrong['value'][:20]}: {answer.status_code} {answer.text[:300]}"
        if method == "head":
            assert 400 <= answer.status_code < 500, case
            continue
        assert problem(answer)[0] in (412, 413, 415, 422), case
        detail = answer.json()["detail"]
        assert not [word for word in FOREIGN if word in detail], case
        assert wrong["name"].lower() in detail.lower(), case
        assert any(word in detail for word in EXPECTED), case
        assert len(detail) < 400, case
        refused += 1
    assert refused > 60


@pytest.mark.parametrize(
    ("body", "words"),
    [
        (b"", "The body is no JSON; it must be "),
        (b"surface=x", "The body is no JSON; "),
        (b"{'surface': 'x'}", "The body is no JSON; "),
        (b"\xff", "The body is no JSON; "),
        (b"[" * 1000, "The body is no JSON; "),
        (b"[]", "The body is no object in JSON; "),
        (b'["x"]', "The body is no object in JSON; "),
        (b"null", "The body is no object in JSON; "),
        (b"NaN", "The body is no object in JSON; "),
        (b"9" * 900, "The body is no object in JSON; "),
        (b"{}", "The key 'surface' of the body is missing; "),
        (b'{"surfac": "x"}', "The key 'surface' of the body is missing; "),
        (b'{"surface": null, "x\\u0007": 1}', "The key 'x\\x07' of the body is not known; "),
        (b'{"surface": 3}', "The key 'surface' of the body must be text; "),
        (b'{"surface": NaN}', "The key 'surface' of the body must be text; "),
        (b'{"surface": ' + b"9" * 900 + b"}", "The key 'surface' of the body must be text; "),
        (b'{"surface": ["x"]}', "The key 'surface' of the body must be text; "),
        (b'{"surface": {"id": "x"}}', "The key 'surface' of the body must be text; "),
        (b'{"surface": true}', "The key 'surface' of the body must be text; "),
    ],
)
def test_what_is_wrong_with_a_body_is_told_by_its_key(http: httpx.Client, body: bytes, words: str) -> None:
    answer = http.put("/v1/names/dem", content=body)
    assert problem(answer) == (422, "bad-input")
    detail = answer.json()["detail"]
    assert (
        detail == f'{words.partition(";")[0]}; it must be {{"surface": ID}}, with the id or url of a surface, or null'
    )


def test_an_unknown_parameter_is_told_with_those_that_there_are(http: httpx.Client, real: dict[str, str]) -> None:
    for path in (path for path, operations in PATHS.items() if "get" in operations):
        answer = ask(http, real, "get", path, {"in": "query", "name": "nope", "value": "1"})
        if path.endswith("/stream"):
            assert problem(answer)[0] == 426
            continue
        assert problem(answer) == (422, "bad-option"), path
        assert "There is no parameter 'nope' here, " in answer.json()["detail"], path
