/**
 * One axis of a grid under coarsening (docs/format.md, section 4): which samples become nodes, which midpoints, and what
 * lies beyond the ends.
 *
 * A *node* is a sample that the coarser level keeps a value for, a *midpoint* one that is predicted from the nodes on
 * either side. Nodes and midpoints alternate along a *run*. An interval between nodes without a midpoint is a *gap*.
 */

/** Details that an update takes on either side of a node. */
export const REACH = 10;

/** One coarsening of one axis. */
export interface AxisStep {
  /** Samples before and after. */
  readonly length: number;
  readonly coarse: number;
  /** Samples predicted; 0 where the axis has stopped. */
  readonly midpoints: number;
  /** Nodes of the run that starts at sample 0: 0, 2, 4, ... */
  readonly run: number;
  /** The last midpoint lies between the last node and node 0. */
  readonly wraps: boolean;
  /** Whether the ends of the run are clamped. */
  readonly left: boolean;
  readonly right: boolean;
}

/** Samples that remain of an axis after one step; the same number where the axis has stopped. */
export function coarseLength(length: number, closed: boolean, stops = false): number {
  if (length < (closed ? 5 : 3) || (stops && !closed && length % 2 === 0)) return length;
  return closed || length % 2 ? Math.floor((length + 1) / 2) : length / 2 + 1;
}

/** Lengths of an axis at every level until it stops, coarsest first, the axis itself last. */
export function axisLengths(length: number, closed: boolean, stops = false): number[] {
  const lengths = [length];
  for (;;) {
    const coarser = coarseLength(length, closed, stops);
    if (coarser === length) return lengths.reverse();
    lengths.push(coarser);
    length = coarser;
  }
}

/** The step from an axis of this length to the next coarser one. `clamped` says of either end whether its node stays. */
export function axisStep(
  length: number,
  closed = false,
  clamped: readonly [boolean, boolean] = [false, false],
  stops = false,
): AxisStep {
  const coarse = coarseLength(length, closed, stops);
  const midpoints = length - coarse;
  const wraps = closed && length % 2 === 0 && midpoints > 0;
  const run = wraps ? midpoints : midpoints ? midpoints + 1 : coarse;
  const [left, right] = closed ? [false, false] : clamped;
  return { length, coarse, midpoints, run, wraps, left, right: right && run === coarse };
}

/** Whether the last sample is a node of its own beyond a gap. */
export function hasTail(step: AxisStep): boolean {
  return step.run < step.coarse;
}

/**
 * Where to find the details beyond the ends of a run, and with which sign.
 *
 * Returns 2 `reach` pairs (index, sign), for d_{-reach} ... d_{-1} and then d_M ... d_{M + reach - 1}: the index inside,
 * and 1, -1 or 0 to multiply with.
 */
export function extension(step: AxisStep, reach = REACH): Int32Array {
  const { midpoints, wraps, left, right } = step;
  const table = new Int32Array(4 * reach);
  for (let place = 0; place < 2 * reach; place++) {
    let index = place < reach ? place - reach : midpoints + place - reach;
    let sign = 1;
    if (wraps) index = ((index % midpoints) + midpoints) % midpoints;
    while (index < 0 || index >= midpoints) {
      let mirror: boolean;
      if (index < 0) {
        mirror = left || index !== -1;
        index = left ? -1 - index : -2 - index;
      } else {
        mirror = right || index !== midpoints;
        index = right ? 2 * midpoints - 1 - index : 2 * midpoints - index;
      }
      if (!mirror) {
        index = 0;
        sign = 0;
      }
      sign = -sign;
    }
    table[2 * place] = index;
    table[2 * place + 1] = sign;
  }
  return table;
}
