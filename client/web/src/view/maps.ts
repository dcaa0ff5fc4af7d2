/**
 * Closed axes of maps. A map that goes once round the Earth ends a full turn further than it begins: its last row or
 * column is followed by the first at x + 360, and not joined back to it across the whole map.
 */

import { isMap, type Metadata } from "../container/sections";
import { turnOfAxes } from "../coordinates/height-fields";
import type { AttributeGrid, Grid } from "./source";

/** Degrees of a full turn. */
const DEGREES = 360;

/** By how many steps of the full grid a way round may differ from a full turn of degrees. */
const NEAR = 0.5;

/** Full turns of x, y and z by the metadata; 0: no angle. */
export function periodsOf(metadata: Metadata): [number, number, number] {
  const periods: [number, number, number] = [0, 0, 0];
  const angles = Array.isArray(metadata.angles) ? metadata.angles : [];
  for (const angle of angles) {
    if (!isMap(angle)) continue;
    const [channel, period] = [Number(angle.channel), Number(angle.period)];
    if ((channel === 0 || channel === 1 || channel === 2) && period > 0) periods[channel] = period;
  }
  // By how much the last row or column, which repeats the first, differed from it.
  const [channel, by] = Array.isArray(metadata.turn) ? metadata.turn.map(Number) : [];
  if (channel === 0 || channel === 1 || channel === 2) periods[channel] ||= Math.abs(by || 0);
  return periods;
}

/**
 * A grid as it is drawn: an axis that is closed, but along which coordinates go on by a turn, is open, and has one more
 * line, the first one a turn further.
 *
 * @param flat - x and y follow rules, so that no axis leads back to where it began.
 */
export function unrolled(grid: Grid, flat: boolean, metadata: Metadata): Grid {
  const periods = flat ? ([0, 0, 0] as const) : periodsOf(metadata);
  for (const axis of [0, 1] as const) {
    if (!grid.closed[axis]) continue;
    const turns = flat ? goingOn(grid, axis, metadata.axes) : turnsOf(grid, axis, periods);
    if (turns === null) continue;
    grid = opened(grid, axis, turns);
  }
  return periods.some((period) => period > 0) ? { ...grid, periods } : grid;
}

/** By how much the coordinates of the first node of each line along an axis differ once round; [line, xyz]. */
type Turns = Float64Array;

/** Nodes along an axis, lines across it, and the first node of each with the step to the next. */
function linesAlong({ rowsAt, columnsAt, full }: Grid, axis: 0 | 1) {
  const [height, width] = [rowsAt.length, columnsAt.length];
  const at = axis === 0 ? rowsAt : columnsAt;
  const [first, step, count] = axis === 0 ? [1, width, width] : [width, 1, height];
  const span = at.at(-1)! - at[0]!;
  return { nodes: at.length, count, first, step, round: span > 0 ? full[axis] / span : 0, full: full[axis] };
}

/** Where coordinates would be after the last node of each line: as `axes` say, otherwise if they go on as they do. */
function goingOn(grid: Grid, axis: 0 | 1, axes: unknown): Turns {
  const { nodes, count, first, step, round, full } = linesAlong(grid, axis);
  const turns = new Float64Array(3 * count);
  const listed = turnOfAxes(axes, axis, full);
  for (let line = 0; line < count; line += 1) {
    for (const k of [0, 1]) {
      if (k === listed?.channel) {
        turns[3 * line + k] = listed.turn;
        continue;
      }
      const [start, end] = [3 * line * first + k, 3 * (line * first + (nodes - 1) * step) + k];
      const turn = (grid.points[end]! - grid.points[start]!) * round;
      // Longitudes that are not quite even go round once all the same.
      const isTurn = Math.abs(Math.abs(turn) - DEGREES) * full <= NEAR * DEGREES;
      turns[3 * line + k] = isTurn ? Math.sign(turn) * DEGREES : turn;
    }
  }
  return turns;
}

/** Full turns by which angles go on along each line; null: there are none, the surface is closed in space. */
function turnsOf(grid: Grid, axis: 0 | 1, periods: readonly [number, number, number]): Turns | null {
  const { nodes, count, first, step, round } = linesAlong(grid, axis);
  const turns = new Float64Array(3 * count);
  for (let line = 0; line < count; line += 1) {
    const [start, end] = [line * first, line * first + (nodes - 1) * step];
    if (grid.mask?.[start] === 0 || grid.mask?.[end] === 0) continue;
    periods.forEach((period, k) => {
      const turn = (grid.points[3 * end + k]! - grid.points[3 * start + k]!) * round;
      if (period > 0) turns[3 * line + k] = period * Math.round(turn / period);
    });
  }
  if (periods[0] === 0 && periods[1] === 0) return degreesAround(grid, axis);
  return turns.some((turn) => turn !== 0) ? turns : null;
}

/** Likewise of x or y that rise or fall all the way, and would be 360 further after one more step; null: they do not. */
function degreesAround(grid: Grid, axis: 0 | 1): Turns | null {
  const { nodes, count, first, step, round, full } = linesAlong(grid, axis);
  for (const k of [0, 1]) {
    let [seen, around, sum] = [0, 0, 0];
    for (let line = 0; line < count; line += 1) {
      const along = (node: number): number => grid.points[3 * (line * first + node * step) + k]!;
      const known = (node: number): boolean => grid.mask?.[line * first + node * step] !== 0;
      if (!known(0) || !known(nodes - 1)) continue;
      const turn = (along(nodes - 1) - along(0)) * round;
      let isEven = Math.abs(Math.abs(turn) - DEGREES) * full <= 2 * NEAR * DEGREES;
      for (let node = 1; isEven && node < nodes; node += 1) {
        if (known(node) && known(node - 1)) isEven = (along(node) - along(node - 1)) * turn > 0;
      }
      seen += 1;
      if (isEven) {
        around += 1;
        sum += Math.sign(turn);
      }
    }
    if (seen === 0 || 2 * around <= seen) continue;
    const turns = new Float64Array(3 * count);
    for (let line = 0; line < count; line += 1) turns[3 * line + k] = Math.sign(sum) * DEGREES;
    return turns;
  }
  return null;
}

/** A grid with its first line once more after its last, by these turns further. */
function opened(grid: Grid, axis: 0 | 1, turns: Turns): Grid {
  const [height, width] = [grid.rowsAt.length, grid.columnsAt.length];
  const [rows, columns] = axis === 0 ? [height + 1, width] : [height, width + 1];
  const longer = (values: Float64Array, components: number): Float64Array => {
    const result = new Float64Array(rows * columns * components);
    for (let i = 0; i < rows; i += 1) {
      for (let j = 0; j < columns; j += 1) {
        const from = components * ((i % height) * width + (j % width));
        result.set(values.subarray(from, from + components), components * (i * columns + j));
      }
    }
    return result;
  };
  const points = longer(grid.points, 3);
  const lines = axis === 0 ? width : height;
  for (let line = 0; line < lines; line += 1) {
    const node = axis === 0 ? height * columns + line : line * columns + width;
    for (let k = 0; k < 3; k += 1) points[3 * node + k] = points[3 * node + k]! + turns[3 * line + k]!;
  }
  const { mask } = grid;
  const at = (own: Float64Array, of: 0 | 1): Float64Array =>
    of === axis ? Float64Array.from([...own, grid.full[of]]) : own;
  return {
    ...grid,
    rowsAt: at(grid.rowsAt, 0),
    columnsAt: at(grid.columnsAt, 1),
    closed: axis === 0 ? [false, grid.closed[1]] : [grid.closed[0], false],
    points,
    mask: mask === null ? null : Uint8Array.from(longer(Float64Array.from(mask), 1)),
    attributes: grid.attributes.map(
      ({ name, components, values }): AttributeGrid => ({ name, components, values: longer(values, components) }),
    ),
  };
}

/**
 * Leaves out triangles across which an angle changes by more than half a turn, as where a curvilinear grid goes round a
 * pole: its nodes are neighbours on the sphere, and not on the map.
 *
 * @param points - [node, xyz] of drawn coordinates.
 * @param scale - Of these.
 */
export function withoutJumps(
  triangles: Uint32Array,
  points: Float64Array,
  scale: readonly [number, number, number],
  periods: readonly [number, number, number] | undefined,
): Uint32Array {
  if (periods === undefined) return triangles;
  const kept: number[] = [];
  for (let t = 0; t < triangles.length; t += 3) {
    const corners = [triangles[t]!, triangles[t + 1]!, triangles[t + 2]!] as const;
    if (!jumps(points, corners, scale, periods)) kept.push(...corners);
  }
  return Uint32Array.from(kept);
}

/** Whether an angle changes by more than half a turn between the corners of a triangle. */
export function jumps(
  points: Float64Array,
  corners: readonly [number, number, number],
  scale: readonly [number, number, number],
  periods: readonly [number, number, number],
): boolean {
  return periods.some((period, k) => {
    if (period === 0) return false;
    const [a, b, c] = corners.map((node) => points[3 * node + k]!) as [number, number, number];
    return Math.max(a, b, c) - Math.min(a, b, c) > (period / 2) * scale[k]! * (1 + 1e-9);
  });
}
