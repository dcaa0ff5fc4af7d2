/**
 * What a window of a surface needs: the tiles whose coefficients have a part in its points.
 *
 * From the finest level down, an axis is followed by the indices that are needed: of samples first, then of the nodes and
 * details that give them back. An update takes ten details on either side, a third step two nodes to the left of a detail
 * and three to the right.
 */
import type { Region } from "../types";
import { type AxisStep, extension, hasTail, REACH } from "./axis";
import type { Layout } from "./layout";
import { samplesOf } from "./window";

/** Which tiles of a surface of one grid the points of a window of a level need, parents included: 1 or 0 for each. */
export function neededTiles(layout: Layout, region: Region, finest: number): Uint8Array {
  const { tiles } = layout;
  const needed = new Uint8Array(tiles.length);
  needed[0] = 1;
  const shape = layout.shape(0, finest);
  let samples: Uint8Array[] = ([0, 1] as const).map((axis) => samplesOf(region[axis], shape[axis]));
  for (let level = finest; level > 0; level--) {
    const steps = layout.steps(0, level);
    // Coefficients along each axis: nodes first, details after them.
    const lines = samples.map((own, axis) => coefficientsNeeded(own, steps[axis]!));
    const [rows, columns] = lines.map(counts);
    const [first, stop] = layout.tilesOf(level);
    for (let number = first; number < stop; number++) {
      for (const band of tiles[number]!.bands) {
        const down = rows![band.rows[1]]! > rows![band.rows[0]]!;
        if (down && columns![band.columns[1]]! > columns![band.columns[0]]!) needed[number] = 1;
      }
    }
    samples = lines.map((line, axis) => line.subarray(0, steps[axis]!.coarse));
  }
  for (let number = tiles.length - 1; number >= 0; number--) {
    // The contexts of a tile's segments look at its parent.
    const { parent } = tiles[number]!;
    if (needed[number] && parent >= 0) needed[parent] = 1;
  }
  return needed;
}

/** How many marks stand before each place, and at the end. */
function counts(line: Uint8Array): Int32Array {
  const found = new Int32Array(line.length + 1);
  for (let place = 0; place < line.length; place++) found[place + 1] = found[place]! + line[place]!;
  return found;
}

/** Which nodes (first) and details (after them) of a step give samples of an axis back: marks of the axis's length. */
export function coefficientsNeeded(samples: Uint8Array, step: AxisStep): Uint8Array {
  if (!step.midpoints) return samples.slice();
  const { length, coarse, run, wraps } = step;
  const line = new Uint8Array(length);
  const inside = hasTail(step) ? length - 1 : length;
  if (hasTail(step)) {
    line[coarse - 1] = samples[length - 1]!;
    if (!samples.subarray(0, inside).includes(1)) return line;
  }
  const nodes = line.subarray(0, run);
  const details = line.subarray(coarse);
  for (let place = 0; place < inside; place++) {
    if (!samples[place]) continue;
    const k = place >> 1;
    nodes[k] = 1;
    if (place % 2) {
      details[k] = 1;
      if (k + 1 < run) nodes[k + 1] = 1;
      else if (wraps) nodes[0] = 1;
    }
  }
  markUpdates(nodes, details, step);
  markThirdSteps(nodes, details, step);
  return line;
}

/** Mark the details that the updates of nodes take. */
function markUpdates(nodes: Uint8Array, details: Uint8Array, step: AxisStep): void {
  const table = extension(step);
  const { midpoints } = step;
  const marked = details.slice();
  for (let node = 0; node < nodes.length; node++) {
    if (!nodes[node]) continue;
    for (let place = node - REACH; place < node + REACH; place++) {
      if (place >= 0 && place < midpoints) {
        marked[place] = 1;
        continue;
      }
      const beyond = place < 0 ? place + REACH : place - midpoints + REACH;
      if (table[2 * beyond + 1]) marked[table[2 * beyond]!] = 1;
    }
  }
  details.set(marked);
}

/** Mark the nodes that the third steps of details take. */
function markThirdSteps(nodes: Uint8Array, details: Uint8Array, step: AxisStep): void {
  const { run, wraps } = step;
  for (let detail = 0; detail < details.length; detail++) {
    if (!details[detail]) continue;
    for (let place = detail - 2; place <= detail + 3; place++) {
      if (wraps) nodes[(place + 2 * run) % run] = 1;
      // Nodes beyond an end are extrapolated from the three within it, which the same detail reaches.
      else if (place >= 0 && place < run) nodes[place] = 1;
    }
  }
}
