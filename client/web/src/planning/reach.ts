/**
 * What a window of a surface needs: the tiles whose coefficients have a part in its points.
 *
 * From the finest level down, an axis is followed by the indices that are needed: of samples first, then of the nodes
 * and details that give them back (`docs/mathematics.md`: an update takes ten details on either side, a third step two
 * nodes to the left of a detail and three to the right).
 */

import { OptionError } from "../errors";
import { type AxisStep, extension, hasTail, REACH } from "../grid/axis";
import type { Layout } from "../grid/layout";
import type { Region, Shape, Span } from "../types";

/** Nodes that a third step takes, counted from the detail: from the first to before the last. */
const PREDICT: Span = [-2, 4];

/**
 * Refuse a region that is not inside a surface.
 *
 * @throws OptionError if it has no point, or points outside.
 */
export function checkRegion(region: Region, shape: Shape): void {
  for (const [axis, name] of (["rows", "columns"] as const).entries()) {
    const [start, stop] = region[axis as 0 | 1];
    const length = shape[axis as 0 | 1];
    if (!(0 <= start && start < stop && stop <= length)) {
      throw new OptionError(`expected ${name} within 0:${length}, at least one, got ${start}:${stop}`);
    }
  }
}

/**
 * Which tiles of a surface of one grid the points of a region need, parents included; an array (tile) of 0 and 1.
 *
 * Parents are there because the contexts of a tile's segments look at them.
 */
export function neededTiles(layout: Layout, region: Region): Uint8Array {
  const { tiles, levels } = layout;
  const needed = new Uint8Array(tiles.length);
  needed[0] = 1;
  let samples = layout.shape(0, levels).map((length, axis) => {
    const line = new Uint8Array(length);
    line.fill(1, ...region[axis as 0 | 1]);
    return line;
  });
  // Tiles are listed from the coarsest level to the finest.
  let number = tiles.length - 1;
  for (let level = levels; level > 0; level--) {
    const steps = layout.steps(0, level);
    // Coefficients along each axis: nodes first, details after them.
    const lines = samples.map((line, axis) => coefficientsNeeded(line, steps[axis as 0 | 1]));
    const sums = lines.map(counted);
    for (; number >= 0 && tiles[number]!.level === level; number--) {
      for (const band of tiles[number]!.bands) {
        if (anyOf(sums[0]!, band.rows) && anyOf(sums[1]!, band.columns)) needed[number] = 1;
      }
    }
    samples = lines.map((line, axis) => line.subarray(0, steps[axis as 0 | 1].coarse));
  }
  for (let tile = tiles.length - 1; tile >= 0; tile--) {
    const { parent } = tiles[tile]!;
    if (needed[tile] && parent >= 0) needed[parent] = 1;
  }
  return needed;
}

/** How many are needed before each index; length one more than the line's. */
function counted(line: Uint8Array): Int32Array {
  const sums = new Int32Array(line.length + 1);
  for (let index = 0; index < line.length; index++) sums[index + 1] = sums[index]! + line[index]!;
  return sums;
}

function anyOf(sums: Int32Array, [start, stop]: Span): boolean {
  return sums[stop]! > sums[start]!;
}

/**
 * Which nodes (first) and details (after them) of a step give samples of an axis back.
 *
 * @param samples An array (length) of 0 and 1.
 * @returns An array (length) of 0 and 1.
 */
export function coefficientsNeeded(samples: Uint8Array, step: AxisStep): Uint8Array {
  const { midpoints, wraps, run: nodes } = step;
  if (midpoints === 0) return samples.slice();
  const line = new Uint8Array(step.length);
  const tail = hasTail(step);
  const run = tail ? samples.subarray(0, -1) : samples;
  if (tail) {
    line[step.coarse - 1] = samples[samples.length - 1]!;
    if (!run.includes(1)) return line;
  }
  const nodeNeeded = new Uint8Array(nodes);
  const detailNeeded = new Uint8Array(midpoints);
  for (let index = 0; index < run.length; index++) {
    if (!run[index]) continue;
    const half = index >> 1;
    if (index % 2 === 0) nodeNeeded[half] = 1;
    else {
      // A midpoint stands between two nodes; the last one of a closed axis between the last node and the first.
      detailNeeded[half] = 1;
      nodeNeeded[half] = 1;
      if (half + 1 < nodes) nodeNeeded[half + 1] = 1;
      else if (wraps) nodeNeeded[0] = 1;
    }
  }
  const table = extension(step);
  spread(nodeNeeded, [-REACH, REACH], (place) => {
    if (place >= 0 && place < midpoints) detailNeeded[place] = 1;
    else {
      const entry = 2 * (place < 0 ? place + REACH : place - midpoints + REACH);
      if (table[entry + 1] !== 0) detailNeeded[table[entry]!] = 1;
    }
  });
  const wanted = new Uint8Array(nodeNeeded);
  spread(detailNeeded, PREDICT, (place) => {
    if (wraps) wanted[((place % nodes) + nodes) % nodes] = 1;
    else if (place >= 0 && place < nodes) wanted[place] = 1;
    // From the three at an end, those beyond it are extrapolated.
    else if (place < 0) wanted.fill(1, 0, Math.min(3, nodes));
    else wanted.fill(1, Math.max(nodes - 3, 0));
  });
  line.set(wanted);
  line.set(detailNeeded, step.coarse);
  return line;
}

/** Visit every place that is so far from a needed one; each run of needed ones is visited once. */
function spread(needed: Uint8Array, [from, to]: Span, visit: (place: number) => void): void {
  let next = from;
  for (let index = 0; index < needed.length; index++) {
    if (!needed[index]) continue;
    for (let place = Math.max(next, index + from); place < index + to; place++) visit(place);
    next = index + to;
  }
}
