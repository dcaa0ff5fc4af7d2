"""Attributes of files as tags of a surface and back: texts as GDAL has them, and the types that numbers had.

Tags are texts. The key ``types`` of the metadata maps the name of a tag to the type that its numbers have, such as
"float32", or to "json" for what is neither a text nor a number.
"""

from __future__ import annotations

import json
from collections.abc import Mapping
from typing import Any

import numpy as np

from ...surface import DTYPES

__all__ = ["TYPES", "attributes_of", "plain_of", "text_of", "value_of"]

#: The key of the metadata with the types.
TYPES = "types"

_JSON = "json"


def text_of(value: Any) -> tuple[str, str | None]:
    """Write the value of an attribute as text, several numbers in braces; and the type that `value_of` needs."""
    if isinstance(value, str):
        return value, None
    array = np.asarray(value)
    if array.dtype.name not in DTYPES:
        return json.dumps(plain_of(value), default=str), _JSON
    if array.size == 1:
        return str(array.item()), array.dtype.name
    return "{" + ",".join(map(str, array.ravel().tolist())) + "}", array.dtype.name


def value_of(text: str, type_name: object) -> Any:
    """Make an attribute of a text again: a number or an array of numbers of its type, or the text itself.

    A container may say anything: what does not fit its type is a text.
    """
    try:
        if type_name == _JSON:
            return json.loads(text)
        if not isinstance(type_name, str) or type_name not in DTYPES:
            return text
        dtype = np.dtype(type_name)
        words = text[1:-1].split(",") if text.startswith("{") and text.endswith("}") else [text]
        numbers = [int(word) if dtype.kind in "iu" else float(word) for word in words if word.strip()]
        array = np.array(numbers, dtype)
    except (ValueError, OverflowError, RecursionError):
        return text
    return array[0] if len(words) == 1 and not text.startswith("{") else array


def plain_of(value: Any) -> Any:
    """Give the value of an attribute as JSON has it."""
    return value.tolist() if isinstance(value, np.ndarray | np.generic) else value


def attributes_of(metadata: Mapping[str, Any], owner: str) -> dict[str, Any]:
    """Find the attributes that the tags of a surface have for a variable, for x or y, or for the file (NC_GLOBAL)."""
    tags, types = metadata.get("tags"), metadata.get(TYPES)
    texts = tags.get("") if isinstance(tags, Mapping) else None
    kinds = types if isinstance(types, Mapping) else {}
    start = f"{owner}#"
    return {
        str(key).removeprefix(start): value_of(text, kinds.get(key))
        for key, text in (texts.items() if isinstance(texts, Mapping) else ())
        if str(key).startswith(start) and isinstance(text, str)
    }
