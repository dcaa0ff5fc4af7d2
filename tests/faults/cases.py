"""Cases: a step of a scenario, and the call in it that fails."""

from __future__ import annotations

import zlib
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass

from .programs import Program
from .shim import ERRORS, Fault, Site

__all__ = ["Case", "Outcome", "cases_of", "stopped"]


@dataclass(frozen=True)
class Case:
    """One case.

    Attributes
    ----------
    scenario : str
        ``start``, ``operation`` or ``repair``.
    step : str
        What is done in it.
    fault : Fault
    site : Site
        Where the call comes from that was seen in this place.
    """

    scenario: str
    step: str
    fault: Fault
    site: Site

    def __str__(self) -> str:
        return f"{self.scenario}, {self.step}, {self.fault} ({self.site.lines})"


@dataclass(frozen=True)
class Outcome:
    """A case that was tried, and whether the call was made and has failed."""

    case: Case
    reached: bool


def cases_of(scenario: str, step: str, sites: Mapping[Site, Sequence[int]], seen: set[Site]) -> Iterator[Case]:
    """Every site, with every error that its call can return: the first call that it makes, and the last.

    Sites that another step has seen before, which grow by those of this one, fail with one of the errors.
    """
    for site, numbers in sorted(sites.items()):
        errors: Sequence[str] = ERRORS[site.call]
        if site in seen:
            # Not always the same one, and not another one each time.
            number = zlib.crc32(f"{step} {site}".encode()) % len(errors)
            errors = errors[number : number + 1]
        for number in sorted({min(numbers), max(numbers)}):
            for error in errors:
                yield Case(scenario, step, Fault(site.call, site.place, number, error), site)
    seen.update(sites)


def stopped(program: Program) -> str | None:
    """Tell a server to end; what is wrong with how it does."""
    code = program.stop()
    if code is None:
        return "the server does not end when it is told to"
    if code not in (0, -15):
        return f"the server ended with {code}: {program.text()[-300:]}"
    return None
