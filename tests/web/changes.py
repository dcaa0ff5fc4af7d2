"""Print how far random pictures are apart, and estimates of what will change, for the tests of the npm package."""

from __future__ import annotations

import base64
import json

import numpy as np

from lodestream.planning.plan import Mark
from lodestream_client.viewer.picture_change import Stage, picture_change, remaining_share, share_above


def main() -> None:
    """Print a JSON object for each pair of pictures."""
    random = np.random.default_rng(39)
    layers = [Mark(k, k, min(k, 5), 10 * k, rms, 3 * rms) for k, rms in enumerate((9.0, 4.0, 4.0, 1.5, 1.0, 0.2, 0.0))]
    for noise in (0, 1, 3, 10, 40, 255):
        before = random.integers(0, 256, (24, 30, 4), np.uint8)
        before[..., 3] = 255 * (random.random((24, 30)) < 0.8)
        now = np.clip(before + np.rint(random.normal(0, noise, before.shape)), 0, 255).astype(np.uint8)
        now[..., 3] = np.where(random.random((24, 30)) < 0.02, 255 - before[..., 3], before[..., 3])
        change = picture_change(before, now)
        steps = [(0, 1, 1, 5), (1, 3, 3, 3), (3, 4, 4, 5), (1, 2, 2, 5), (4, 6, 5, 5), (2, 1, 1, 5)]
        shares = [
            remaining_share(change, Stage(first, finest), Stage(last, finest), layers)
            for first, last, level, finest in steps
        ]
        print(
            json.dumps(
                {
                    "before": base64.b64encode(before.tobytes()).decode(),
                    "now": base64.b64encode(now.tobytes()).decode(),
                    "drawn": change.drawn,
                    "bins": change.bins.tolist(),
                    "above": [share_above(change, distance) for distance in (0.01, 0.1, 2.0, 5.0, 37.0, 1e4)],
                    "layers": [[mark.rms, mark.level] for mark in layers[:-1]],
                    "steps": [
                        [*step, None if np.isnan(share) else share] for step, share in zip(steps, shares, strict=True)
                    ],
                }
            )
        )


if __name__ == "__main__":
    main()
