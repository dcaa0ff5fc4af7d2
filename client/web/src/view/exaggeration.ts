/** By how much heights are exaggerated where nothing is said. */

import { roundBelow } from "./format";

/**
 * 1 where heights are between a 25th and all of the horizontal extent; otherwise a round number that brings them to about
 * a sixth of it, so that the relief can be seen.
 *
 * @param half - Half the drawn extent along each axis.
 */
export function defaultExaggeration(half: readonly [number, number, number], heights: boolean): number {
  const across = Math.max(half[0], half[1]);
  if (!heights || !(half[2] > 0) || !(across > 0)) return 1;
  const ratio = half[2] / across;
  if (ratio >= 0.04 && ratio <= 1) return 1;
  return roundBelow(Math.min(Math.max(0.16 / ratio, 1e-6), 1e6));
}
