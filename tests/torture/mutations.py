"""Which golden files notice that a rule of the format is changed: a survey of mutants of the reference decoder."""

from __future__ import annotations

import functools
import importlib
import os
import sys
import tempfile
import time
import warnings
from collections.abc import Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass
from multiprocessing import get_context
from pathlib import Path
from types import ModuleType

from tests import reference
from tests.golden.comparison import EXPECTED, compared, values_of

from .mutants import MUTANTS, Mutant

__all__ = ["SOURCES", "Outcome", "outcome_of", "survey"]

#: The modules that mutants change.
SOURCES = Path(reference.__file__).parent


@dataclass(frozen=True)
class Outcome:
    """What became of a mutant.

    Attributes
    ----------
    mutant : Mutant
    file : str or None
        A golden file that it decodes otherwise, or not at all; None where there is none.
    what : str
        What differs there.
    """

    mutant: Mutant
    file: str | None
    what: str

    @property
    def told(self) -> str:
        """The file, or why there is none."""
        return f"`{self.file}`" if self.file is not None else f"none: {self.mutant.equivalent}"


def survey(mutants: Sequence[Mutant] = MUTANTS, seconds: float | None = None) -> Iterator[Outcome]:
    """Try mutants, in as many processes as there are processors; no more of them after so many seconds."""
    end = time.monotonic() + (float("inf") if seconds is None else seconds)
    with ProcessPoolExecutor(os.cpu_count(), mp_context=get_context("spawn")) as pool:
        begun = [pool.submit(outcome_of, mutant) for mutant in mutants]
        for future in begun:
            if time.monotonic() > end:
                pool.shutdown(wait=False, cancel_futures=True)
                return
            yield future.result()


def outcome_of(mutant: Mutant) -> Outcome:
    """Run a mutant against the golden files up to the first that notices it: the one it names, then the quick ones."""
    with tempfile.TemporaryDirectory() as folder, warnings.catch_warnings():
        warnings.simplefilter("ignore")  # a mutant may leave the range of a type
        decoder = _imported(mutant, Path(folder))
        for name in sorted(_names(), key=lambda name: name != mutant.first):
            try:
                for what, found, expected in compared(decoder, name):
                    if found != expected:
                        return Outcome(mutant, name, what)
            except Exception as error:
                return Outcome(mutant, name, f"{type(error).__name__}: {error}")
    return Outcome(mutant, None, "")


@functools.cache
def _names() -> list[str]:
    """The golden files by the time that they take."""
    return sorted(EXPECTED, key=lambda name: values_of(name) * (len(EXPECTED[name]["layers"]) + 4))


def _imported(mutant: Mutant, folder: Path) -> ModuleType:
    """Import a copy of the reference with a rule changed, as a package of its own.

    Raises
    ------
    ValueError
        If what the mutant replaces does not stand exactly once in its module.
    """
    package = "mutated_" + str(abs(hash(mutant)))
    for path in SOURCES.glob("*.py"):
        text = path.read_text()
        if path.stem == mutant.file:
            if text.count(mutant.old) != 1:
                raise ValueError(f"expected {mutant.old!r} once in {path.name}, got it {text.count(mutant.old)} times")
            text = text.replace(mutant.old, mutant.new)
        copy = folder / package / SOURCES.name / path.name
        copy.parent.mkdir(parents=True, exist_ok=True)
        copy.write_text(text)
    (folder / package / "errors.py").write_text("from lodestream.errors import *\n")
    sys.path.insert(0, str(folder))
    try:
        importlib.invalidate_caches()
        return importlib.import_module(f"{package}.{SOURCES.name}")
    finally:
        sys.path.remove(str(folder))
        for name in [name for name in sys.modules if name.split(".")[0] == package]:
            del sys.modules[name]
