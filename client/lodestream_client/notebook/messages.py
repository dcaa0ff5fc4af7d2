"""Questions of a widget's page over the comm, and their answers.

Each question is a mapping with ``kind`` and ``id``, and so is its answer, which has the same ``id``:

=========  ====================  ==========================================================
question   keys                  answer
=========  ====================  ==========================================================
read       offset, length        part: ``size`` and ``tag`` of the container, bytes beside it
program                          program: the viewer's element, bytes beside it
any                              refused: ``detail``, a sentence, and ``code``
=========  ====================  ==========================================================

A page asks for the next part when it has used the one before. So nothing is sent that was not asked for, what is under
way is bounded, and a page that stops gets no more than the parts it has asked for.
"""

from __future__ import annotations

import logging
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from lodestream.errors import LodestreamError, RemoteError
from lodestream.opening.byte_sources import ByteSource

__all__ = ["LONGEST", "Answers", "Message"]

_log = logging.getLogger(__name__)

#: The most bytes of one answer.
LONGEST = 1 << 20

#: A message, and the bytes beside it.
Message = tuple[dict[str, Any], list[bytes]]


class Answers:
    """Answers questions about one container.

    Parameters
    ----------
    source : ByteSource
    program : Path
        The module of the viewer's element.

    Attributes
    ----------
    sent : int
        Bytes of the container in all answers so far.
    """

    def __init__(self, source: ByteSource, program: Path) -> None:
        self.sent = 0
        self._source = source
        self._program = program

    def to(self, question: Any) -> Message | None:
        """Return the answer to a question; None where it has no ``id`` to answer to.

        Parameters
        ----------
        question : any
            What came over the comm.
        """
        if not isinstance(question, Mapping) or not isinstance(question.get("id"), str):
            return None
        try:
            content, data = self._answer(question)
        except (LodestreamError, OSError) as error:
            code = error.code if isinstance(error, RemoteError) else ""
            content, data = {"kind": "refused", "detail": str(error), "code": code}, []
        except Exception as error:  # the page waits for an answer, whatever it is
            _log.exception("a question of the page of a widget failed")
            detail = f"the kernel failed, see its log: {type(error).__name__}: {error}"
            content, data = {"kind": "refused", "detail": detail, "code": ""}, []
        return {**content, "id": question["id"]}, data

    def _answer(self, question: Mapping[str, Any]) -> Message:
        kind = question.get("kind")
        if kind == "program":
            return {"kind": "program"}, [self._program.read_bytes()]
        if kind != "read":
            raise LodestreamError(f"expected a question of kind read or program, got {kind!r}")
        source = self._source
        offset, length = (_natural(question, key) for key in ("offset", "length"))
        # Beyond the end there is nothing, and the size that comes with it says so.
        wanted = max(min(length, LONGEST, source.size - offset), 0)
        data = source.read(offset, wanted) if wanted else b""
        self.sent += len(data)
        return {"kind": "part", "size": source.size, "tag": source.tag}, [data]


def _natural(question: Mapping[str, Any], key: str) -> int:
    value = question.get(key)
    if isinstance(value, bool) or not isinstance(value, int) or value < 0:
        raise LodestreamError(f"expected {key} to be a number of bytes, got {value!r}")
    return value
