/** When a picture looks done: an estimate of how much of it will still change, from what the last step has changed. */

import type { Field } from "./geometry-messages";
import { type PictureChange, shareAbove, VISIBLE } from "./picture-change";
import type { Moment, Price, SurfaceInfo } from "./source";

/**
 * A picture looks done where less than this share of its pixels is expected to change visibly: somewhat below 1 %, since
 * it is estimated. See docs/viewer.md for how it was chosen.
 */
export const DONE = 0.008;

/** A stream that has stopped goes on where this share is expected to change: what is just done stays done. */
export const AGAIN = 1.5 * DONE;

/** A step that is so much smaller than what is missing changes colours by less than the 8 bits of a picture show. */
const MOST_RATIO = 50;

/** Pixels that are compared at most: a hundredth of them is enough to be counted. */
export const COMPARED = 130_000;

/** Two moments of one view, the second drawn after the first. */
export interface Step {
  readonly before: Moment;
  readonly now: Moment;
  /** The finest level that shows a difference in the view. */
  readonly finest: number;
}

/**
 * Estimates which share of the drawn pixels still changes visibly.
 *
 * Two states with RMS errors e1 > e2 differ by about sqrt(e1^2 - e2^2), since what is still missing does not depend on
 * what has come. So what the step has changed in the picture is scaled by e2 / sqrt(e1^2 - e2^2).
 *
 * @param change - What the step has changed in the picture.
 * @returns NaN where the errors do not say how large the step was, it was too small to tell, or nothing is drawn.
 */
export function remainingShare(change: PictureChange, step: Step, info: SurfaceInfo, field: Field): number {
  const surface =
    info.prices === null ? plainRatio(step.before.rms, step.now.rms) : slopeRatio(step, info.prices, info.exact);
  let ratio = surface;
  if (field.kind === "attribute") {
    const number = info.attributes.findIndex(({ name }) => name === field.name);
    const [e1 = Number.NaN, e2 = Number.NaN] = [step.before, step.now].map(({ attributes }) => attributes[number]);
    ratio = Math.max(ratio, plainRatio(e1, e2));
  }
  if (change.drawn === 0) return Number.NaN; // nothing of the surface is in the view
  if (ratio === 0) return 0;
  return ratio <= MOST_RATIO ? shareAbove(change, VISIBLE / ratio) : Number.NaN;
}

function plainRatio(e1: number, e2: number): number {
  return e2 === 0 ? 0 : e2 / Math.sqrt(e1 ** 2 - e2 ** 2);
}

/**
 * The ratio of slopes, which shading shows: what a layer changes counts more, the finer the level that it brings. A level
 * has cells of half the size, so the same height is twice the slope there.
 */
function slopeRatio({ before, now, finest }: Step, prices: readonly Price[], exact: boolean): number {
  const slopes = (from: number, to: number): number => {
    let sum = 0;
    for (let layer = from + 1; layer <= to; layer += 1) {
      const { rms, level } = prices[layer]!;
      sum += Math.max(prices[layer - 1]!.rms ** 2 - rms ** 2, 0) * 4 ** Math.min(level, finest);
    }
    return sum;
  };
  // Of a state that is no layer nothing is known; the states of a region come in the order of layers.
  if (!(before.layer < now.layer && now.layer < prices.length)) return Number.NaN;
  // What the last layer leaves, the residual of an exact surface brings, at the finest level.
  const residual = exact ? prices.at(-1)!.rms ** 2 * 4 ** finest : 0;
  const missing = slopes(now.layer, prices.length - 1) + residual;
  return missing === 0 ? 0 : Math.sqrt(missing / slopes(before.layer, now.layer));
}
