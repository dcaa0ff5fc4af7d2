/** Positions of the nodes that a patch draws, with one line around them, from the grid in hand or from the one before. */

import type { Grid } from "./source";

/** What is drawn of coordinates p: (p - origin) * scale, computed in float64. */
export interface Frame {
  readonly origin: readonly [number, number, number];
  readonly scale: readonly [number, number, number];
}

/** Positions of nodes, and which of them may be drawn. */
export interface Lattice {
  readonly rows: number;
  readonly columns: number;
  /** [row, column, xyz] as a frame says. */
  readonly points: Float64Array;
  /** [row, column], 0 at holes and outside the grid. */
  readonly valid: Uint8Array;
}

/** A line of nodes as an index of the grid; NaN outside it. Beyond the end of a closed axis it begins again. */
function inside(line: number, length: number, closed: boolean): number {
  if (closed) return ((line % length) + length) % length;
  return line < 0 || line >= length ? Number.NaN : line;
}

/**
 * Nodes of a grid.
 *
 * @param rows - Lines of nodes, which may lie outside the grid or, on a closed axis, beyond its end.
 */
export function latticeOf(
  grid: Grid,
  rows: readonly number[],
  columns: readonly number[],
  { origin, scale }: Frame,
): Lattice {
  const [height, width] = [grid.rowsAt.length, grid.columnsAt.length];
  const points = new Float64Array(rows.length * columns.length * 3);
  const valid = new Uint8Array(rows.length * columns.length);
  const at = columns.map((column) => inside(column, width, grid.closed[1]));
  rows.forEach((line, i) => {
    const row = inside(line, height, grid.closed[0]);
    at.forEach((column, j) => {
      const from = row * width + column;
      const to = i * columns.length + j;
      if (Number.isNaN(from) || grid.mask?.[from] === 0) return;
      for (let k = 0; k < 3; k += 1) points[3 * to + k] = (grid.points[3 * from + k]! - origin[k]!) * scale[k]!;
      valid[to] = 1;
    });
  });
  return { rows: rows.length, columns: columns.length, points, valid };
}

/** Where a line lies between lines of another grid: the line below, the line above, and the share of the latter. */
export interface Between {
  readonly below: Int32Array;
  readonly above: Int32Array;
  readonly share: Float64Array;
}

/**
 * Places along an axis between the lines of a grid.
 *
 * @param places - In indices of the full resolution; beyond the end of a closed axis it begins again. NaN, a line
 * outside the grid, has no share.
 * @param at - Where the grid's lines stand, rising.
 * @param full - Samples of the axis at full resolution.
 */
export function between(places: readonly number[], at: Float64Array, full: number, closed: boolean): Between {
  const count = at.length;
  const below = new Int32Array(places.length);
  const above = new Int32Array(places.length);
  const share = new Float64Array(places.length);
  places.forEach((place, k) => {
    if (closed) place = ((place % full) + full) % full;
    let [low, high] = [0, count];
    while (low < high) {
      const middle = (low + high) >> 1;
      if (at[middle]! <= place) low = middle + 1;
      else high = middle;
    }
    let [start, end] = [low - 1, low];
    let [a, b] = [at[start]!, at[end]!];
    if (closed && (start < 0 || end >= count)) {
      [start, end] = [count - 1, 0];
      a = at[start]!;
      b = at[0]! + full;
      if (place < a) place += full;
    } else if (start < 0) {
      [start, end, a, b] = [0, 0, place, place];
    } else if (end >= count) {
      [start, end, a, b] = [count - 1, count - 1, place, place];
    }
    below[k] = start;
    above[k] = end;
    share[k] = Number.isNaN(place) ? Number.NaN : b > a ? (place - a) / (b - a) : 0;
  });
  return { below, above, share };
}

/** A number at each node of a grid that is left out where there is none, such as one component of an array. */
type Reader = (node: number) => number;

/**
 * Bilinear interpolation in a grid.
 *
 * @param reader - The value at a node; NaN where there is none.
 * @returns [row, column]; of the corners that have a value the mean by their shares, NaN where none has one and outside
 * the grid.
 */
export function interpolated(rows: Between, columns: Between, width: number, reader: Reader): Float64Array {
  const [height, across] = [rows.share.length, columns.share.length];
  const values = new Float64Array(height * across);
  for (let i = 0; i < height; i += 1) {
    const [up, down, part] = [rows.below[i]! * width, rows.above[i]! * width, rows.share[i]!];
    for (let j = 0; j < across; j += 1) {
      const [left, right, share] = [columns.below[j]!, columns.above[j]!, columns.share[j]!];
      let sum = 0;
      let weight = 0;
      const add = (node: number, by: number): void => {
        const value = by > 0 ? reader(node) : Number.NaN;
        if (Number.isNaN(value)) return;
        sum += by * value;
        weight += by;
      };
      add(up + left, (1 - part) * (1 - share));
      add(up + right, (1 - part) * share);
      add(down + left, part * (1 - share));
      add(down + right, part * share);
      values[i * across + j] = weight > 0 ? sum / weight : Number.NaN;
    }
  }
  return values;
}

/**
 * Nodes as `latticeOf`, at places between those of an earlier grid of the same block.
 *
 * @param rows - Places, see `placesOf`.
 */
export function latticeBetween(
  grid: Grid,
  rows: readonly number[],
  columns: readonly number[],
  { origin, scale }: Frame,
): Lattice {
  const down = between(rows, grid.rowsAt, grid.full[0], grid.closed[0]);
  const across = between(columns, grid.columnsAt, grid.full[1], grid.closed[1]);
  const points = new Float64Array(rows.length * columns.length * 3);
  const valid = new Uint8Array(rows.length * columns.length);
  for (let k = 0; k < 3; k += 1) {
    const values = interpolated(down, across, grid.columnsAt.length, (node) =>
      grid.mask?.[node] === 0 ? Number.NaN : (grid.points[3 * node + k]! - origin[k]!) * scale[k]!,
    );
    values.forEach((value, node) => {
      if (Number.isNaN(value)) return;
      points[3 * node + k] = value;
      valid[node] = 1;
    });
  }
  return { rows: rows.length, columns: columns.length, points, valid };
}

/** Where lines of nodes stand, in indices of the full resolution; NaN outside the grid. */
export function placesOf(lines: readonly number[], at: Float64Array, full: number, closed: boolean): number[] {
  return lines.map((line) => {
    if (!closed) return at[line] ?? Number.NaN;
    const turns = Math.floor(line / at.length);
    return at[line - turns * at.length]! + turns * full;
  });
}
