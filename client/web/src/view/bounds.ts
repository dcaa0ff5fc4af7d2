/** Boxes around grids and patches, and the frame in which a surface is drawn. */

import type { Box } from "./geometry-messages";
import { type Frame, latticeOf } from "./lattice";
import { linesOf, type Patch } from "./patches";
import type { Grid } from "./source";
import type { PatchBounds } from "./strides";

/** Metres of a degree of latitude. */
export const DEGREE = 111_320;

/** The box around the valid points of all grids; a point at 0 if there is none. */
export function boxOf(grids: readonly Grid[]): Box {
  const low: [number, number, number] = [Infinity, Infinity, Infinity];
  const high: [number, number, number] = [-Infinity, -Infinity, -Infinity];
  for (const { points, mask } of grids) {
    for (let node = 0; 3 * node < points.length; node += 1) {
      if (mask?.[node] === 0) continue;
      for (const k of [0, 1, 2] as const) {
        const value = points[3 * node + k]!;
        if (value < low[k]) low[k] = value;
        if (value > high[k]) high[k] = value;
      }
    }
  }
  return low[0] <= high[0]
    ? [low, high]
    : [
        [0, 0, 0],
        [0, 0, 0],
      ];
}

/** What decides a frame beside the box. */
export interface FrameOptions {
  /** x and y are degrees, z metres: all are drawn in metres. */
  readonly geographic: boolean;
  readonly heights: boolean;
  /** Of the box of the whole surface; 0 where it is not known: a coarse picture may be smaller. */
  readonly diagonal: number;
  /** Range of z of the whole surface; 0 where it is not known. */
  readonly relief: number;
}

/** So many times higher than wide are surfaces of x, y, z whose z has another unit. */
const OTHER_UNIT = 10;

/** How high relief of an unknown unit is drawn, where 2 is the largest extent of x and y. */
const FITTED = 0.4;

/**
 * The frame in which what lies in a box is drawn about 2 units large around 0.
 *
 * Heights that range over more than x and y have another unit than these, such as metres over degrees, and so have z that
 * range over ten times as much: they are drawn so that the relief can be seen.
 */
export function frameOf(box: Box, { geographic, heights, diagonal, relief }: FrameOptions): Frame {
  const origin = ([0, 1, 2] as const).map((k) => (box[0][k] + box[1][k]) / 2) as [number, number, number];
  const metres = geographic ? [DEGREE * Math.max(Math.cos((origin[1] * Math.PI) / 180), 0.01), DEGREE, 1] : [1, 1, 1];
  const sides = Math.max(...[0, 1].map((k) => (box[1][k]! - box[0][k]!) * metres[k]!));
  const height = relief || box[1][2] - box[0][2];
  const fitted = sides > 0 && height > sides * (heights ? 1 : OTHER_UNIT);
  const across = (fitted ? sides : Math.max(sides, diagonal / 2)) || height || 1;
  const scale = metres.map((unit) => (2 * unit) / across) as [number, number, number];
  if (fitted) scale[2] *= FITTED / (height * scale[2]);
  return { origin, scale };
}

/** Box and average edge of a patch, as it is drawn. */
export function boundsOf(grid: Grid, patch: Patch, frame: Frame): PatchBounds {
  const [rows, columns] = [linesOf(patch.rows, 1), linesOf(patch.columns, 1)];
  const { points, valid } = latticeOf(grid, rows, columns, frame);
  const low = [Infinity, Infinity, Infinity];
  const high = [-Infinity, -Infinity, -Infinity];
  let [sum, count] = [0, 0];
  const add = (a: number, b: number): void => {
    if (valid[b] === 0) return;
    sum += Math.hypot(
      points[3 * a]! - points[3 * b]!,
      points[3 * a + 1]! - points[3 * b + 1]!,
      points[3 * a + 2]! - points[3 * b + 2]!,
    );
    count += 1;
  };
  for (let i = 0; i < rows.length; i += 1) {
    for (let j = 0; j < columns.length; j += 1) {
      const node = i * columns.length + j;
      if (valid[node] === 0) continue;
      for (let k = 0; k < 3; k += 1) {
        low[k] = Math.min(low[k]!, points[3 * node + k]!);
        high[k] = Math.max(high[k]!, points[3 * node + k]!);
      }
      if (j + 1 < columns.length) add(node, node + 1);
      if (i + 1 < rows.length) add(node, node + columns.length);
    }
  }
  if (!(low[0]! <= high[0]!)) return { patch, centre: [0, 0, 0], half: [0, 0, 0], edge: 1 };
  const triple = (of: (k: number) => number): [number, number, number] => [of(0), of(1), of(2)];
  return {
    patch,
    centre: triple((k) => (low[k]! + high[k]!) / 2),
    half: triple((k) => (high[k]! - low[k]!) / 2),
    edge: count > 0 ? sum / count : 1,
  };
}

/** Whether a picture can be blended in from an earlier one: they have the same blocks, at whatever levels. */
export function gridsFit(before: readonly Grid[], now: readonly Grid[]): boolean {
  return (
    before.length === now.length &&
    before.every(({ full, closed }, k) => {
      const other = now[k]!;
      return [0, 1].every((axis) => full[axis] === other.full[axis] && closed[axis] === other.closed[axis]);
    })
  );
}
