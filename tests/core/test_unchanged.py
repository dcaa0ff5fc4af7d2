"""A sample of random surfaces has the containers and values that it had, see `tests.unchanged`."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

import lodestream as ls
from tests.unchanged.cases import KINDS, random_case
from tests.unchanged.digests import digests

#: Digests of the first random surfaces: two of each kind. A change of an encoder's choices writes them anew, by
#: ``python -m tests.core.test_unchanged``; a change of the code alone never does.
SAMPLE = Path(__file__).parents[1] / "unchanged" / "sample.json"
SEEDS = range(2 * len(KINDS))

#: What a container does not keep is another matter, see test_losses.
pytestmark = pytest.mark.filterwarnings("ignore:values of attributes at:lodestream.FormatWarning")


def digests_of(seed: int) -> dict[str, str]:
    case = random_case(seed)
    return digests(ls.encode(case.surface, **case.options))


@pytest.mark.parametrize("seed", SEEDS)
@pytest.mark.long
def test_containers_and_values_are_those_of_before(seed: int) -> None:
    assert digests_of(seed) == json.loads(SAMPLE.read_text())[str(seed)]


if __name__ == "__main__":
    SAMPLE.write_text(json.dumps({str(seed): digests_of(seed) for seed in SEEDS}, indent=1) + "\n")
