"""What a check of a server's data finds."""

from __future__ import annotations

from dataclasses import asdict, dataclass, field
from typing import Any, Literal

__all__ = ["Finding", "Report", "What"]

What = Literal["identity", "manifest", "built", "figures", "upload", "container", "version", "name"]


@dataclass(frozen=True)
class Finding:
    """Something that is wrong.

    Attributes
    ----------
    what : str
        ``identity``, ``manifest``, ``built``, ``upload``, ``container``, ``name``: damaged, missing, or not to be read
        now.
        ``figures``: ``built`` describes its container otherwise than it is. ``version``: a sound container of another
        format version than this server reads, which does not count as damage.
    key : str
        Of the object; of an upload that of its first file.
    surface : str or None
        The surface that it belongs to.
    problem : str
        What was expected and what was found.
    repair : str or None
        What was done about it.
    repaired : bool
    lost : bool
        Whether the surface can neither be served nor built again from these data; of a name, whether nobody knows where
        it led.
    """

    what: What
    key: str
    surface: str | None
    problem: str
    repair: str | None = None
    repaired: bool = False
    lost: bool = False


@dataclass
class Report:
    """What was checked, and what was found.

    Attributes
    ----------
    data : str
        Address of the store.
    surfaces : int
        Manifests, including damaged ones.
    containers, uploads : int
        Containers and uploads that exist and that a surface has, whole or damaged; shared ones count once.
    bytes : int
        Their size.
    strays, stray_bytes : int
        Objects that no small object refers to, of any age. They are no damage.
    queued : int
        Surfaces that the next start of a server builds.
    seconds : float
    findings : list of Finding
    """

    data: str
    surfaces: int = 0
    containers: int = 0
    uploads: int = 0
    bytes: int = 0
    strays: int = 0
    stray_bytes: int = 0
    queued: int = 0
    seconds: float = 0.0
    findings: list[Finding] = field(default_factory=list)

    @property
    def damage(self) -> list[Finding]:
        """The findings that count as damage: all but other versions."""
        return [finding for finding in self.findings if finding.what != "version"]

    @property
    def lost(self) -> int:
        """The number of surfaces and names that are lost."""
        return len({finding.surface or finding.key for finding in self.damage if finding.lost})

    @property
    def clean(self) -> bool:
        """Whether nothing is damaged, or all damage has been repaired."""
        return all(finding.repaired for finding in self.damage)

    def to_json(self) -> dict[str, Any]:
        """Return plain values for JSON."""
        return {**asdict(self), "clean": self.clean, "seconds": round(self.seconds, 3)}
