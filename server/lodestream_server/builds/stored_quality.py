"""A quality among the options of a surface, as records keep them: texts by key."""

from __future__ import annotations

from collections.abc import Mapping

from lodestream.quality import Quality

__all__ = ["ATTRIBUTE", "stored", "without_quality"]

#: What stands before the name of an attribute in the key of its precision.
ATTRIBUTE = "precision="


def stored(quality: Quality) -> dict[str, str]:
    """Return the quality among the options of a surface, see `SurfaceOptions.chosen`."""
    precisions, rms = quality.texts()
    chosen = {}
    for text in precisions:
        attribute, equals, tolerance = text.rpartition("=")
        chosen[f"precision{equals}{attribute}"] = tolerance
    if rms is not None:
        chosen["rms"] = rms
    if quality.effort != Quality.effort:
        chosen["effort"] = quality.effort
    return chosen


def without_quality(chosen: Mapping[str, str]) -> tuple[Quality, dict[str, str]]:
    """Split the options of a surface into its quality and the other options.

    Raises
    ------
    OptionError
        If these are not what `SurfaceOptions.parse` has made.
    """
    precisions, others = [], dict(chosen)
    for key in chosen:
        if key == "precision":
            precisions.append(others.pop(key))
        elif key.startswith(ATTRIBUTE):
            precisions.append(f"{key.removeprefix(ATTRIBUTE)}={others.pop(key)}")
    return Quality.parse(precisions, others.pop("rms", None), others.pop("effort", Quality.effort)), others
