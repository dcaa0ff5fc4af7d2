/** The inverse transform of one channel in integers: all levels, in place (docs/format.md, section 8). */

import type { Plane } from "../entropy/tiles";
import { type AxisStep, extension, REACH } from "../grid/axis";
import type { Layout, Source } from "../grid/layout";
import type { Arena } from "../kernels/arena";
import { accepted } from "../kernels/instance";
import type { Shape } from "../types";
import type { Predictor, Predictors } from "./predictors";

/** Binary places between lattice steps in which reconstructions of incomplete levels are computed. */
export const FRACTION_BITS = 3;
/** Largest magnitude that the inverse hands on after each axis. */
const CLAMP = 2 ** 27;
/** Columns that are stepped together, and how many there must be. */
const [STRIP, NARROW] = [64, 16];
/** Unused columns, so that rows never lie a power of two apart and compete for the same lines of the cache. */
const PADDING = 24;

/** Zeros for a plane of this shape. */
export function allocatePlane(arena: Arena, [rows, columns]: Shape): Plane {
  const pitch = columns + PADDING;
  return { address: arena.zeros(4 * rows * pitch), rows, columns, pitch };
}

/** A plane that is the first rows and columns of another. */
export function corner(plane: Plane, [rows, columns]: Shape): Plane {
  return { address: plane.address, rows, columns, pitch: plane.pitch };
}

/** Where the first number of a plane stands among all of the arena's, and these. */
function numbersOf(arena: Arena, plane: Plane): { words: Int32Array; at: number } {
  return { words: arena.i32(0, arena.bytes / 4), at: plane.address / 4 };
}

/** Undo one step along an axis of a plane, in place. */
export function inverseStep(arena: Arena, plane: Plane, axis: 0 | 1, step: AxisStep, [a, b]: Predictor): void {
  const { midpoints, run } = step;
  if (!midpoints || !plane.rows || !plane.columns) return;
  const bundle = axis === 1 || plane.columns < NARROW ? 1 : STRIP;
  const room = (midpoints + run + 2 * REACH + 5) * bundle + 16;
  arena.scope(() => {
    const table = arena.putI64(extension(step));
    const work = arena.take(4 * room);
    const { address, rows, columns, pitch } = plane;
    for (let done = 0; done < run; ) {
      const result = arena.kernels.lift(
        axis,
        address,
        rows,
        columns,
        pitch,
        midpoints,
        run,
        table,
        a,
        b,
        done,
        work,
        room,
      );
      done = accepted(result, "lift");
    }
  });
}

/** One forward step of a line of points; returns nodes, then details. */
export function forwardStep(arena: Arena, points: Int32Array, step: AxisStep, [a, b]: Predictor): Int32Array {
  const { midpoints, run } = step;
  return arena.scope(() => {
    const table = arena.putI64(extension(step));
    const line = arena.take(4 * points.length);
    const work = arena.take(4 * (points.length + 2 * REACH));
    arena.i32(line, points.length).set(points);
    arena.kernels.forward(line, points.length, midpoints, run, table, a, b, work);
    return arena.i32(line, points.length).slice();
  });
}

/** Clamp the numbers of a level whose finer ones are not complete, and count them in eighths. */
export function toEighths(arena: Arena, plane: Plane): void {
  const { words, at } = numbersOf(arena, plane);
  const most = CLAMP >> FRACTION_BITS;
  for (let row = 0; row < plane.rows; row++) {
    const start = at + row * plane.pitch;
    for (let place = start; place < start + plane.columns; place++) {
      const number = words[place]!;
      words[place] = Math.max(-most, Math.min(number, most)) << FRACTION_BITS;
    }
  }
}

/**
 * Turn coefficients into the grids of `level`, in place, in the first rows and columns of the planes.
 *
 * Details of the levels up to `whole` count lattice steps, those above eighths of them; so does the result where `whole`
 * is less than `level`. Of a channel that is no `coordinate` no side comes from an interface, and interfaces mean
 * nothing.
 */
export function inverse(
  arena: Arena,
  planes: readonly Plane[],
  layout: Layout,
  predictors: Predictors,
  level: number,
  whole: number,
  coordinate: boolean,
): void {
  const sides = new Sides(arena, planes, layout, predictors);
  if (coordinate) sides.takeNodes();
  for (let finer = 1; finer <= level; finer++) {
    for (const [number, grid] of layout.grids.entries()) {
      if (grid.interface && !coordinate) continue;
      const plane = planes[number]!;
      if (finer === whole + 1) toEighths(arena, corner(plane, layout.shape(number, whole)));
      if (coordinate) sides.takeDetails(number, finer);
      const made = corner(plane, layout.shape(number, finer));
      const steps = layout.steps(number, finer);
      for (const axis of [1, 0] as const) {
        if (steps[axis].midpoints) {
          inverseStep(arena, made, axis, steps[axis], predictors.of(grid, steps[axis], finer, axis));
        }
      }
    }
  }
}

/** What interfaces and patches take from other interfaces. */
class Sides {
  readonly #arena: Arena;
  readonly #planes: readonly Plane[];
  readonly #layout: Layout;
  readonly #predictors: Predictors;

  constructor(arena: Arena, planes: readonly Plane[], layout: Layout, predictors: Predictors) {
    this.#arena = arena;
    this.#planes = planes;
    this.#layout = layout;
    this.#predictors = predictors;
  }

  /** Level 0 of what comes from interfaces: their common ends first, then the sides of patches. */
  takeNodes(): void {
    if (!this.#layout.shared) return;
    for (const [number, grid] of this.#layout.grids.entries()) {
      const [rows, columns] = this.#layout.shape(number, 0);
      const plane = this.#planes[number]!;
      const { words, at } = numbersOf(this.#arena, plane);
      for (const [side, source] of grid.sources.entries()) {
        if (source === null) continue;
        const points = this.#points(source, 0);
        if (grid.interface) {
          words[at + (side === 0 ? 0 : rows - 1) * plane.pitch] = points[0]!;
          continue;
        }
        const { start, stride } = sideOf(plane, side, rows, columns);
        const count = side < 2 ? columns : rows;
        for (let i = 0; i < count; i++) words[at + start + i * stride] = points[points.length === 1 ? 0 : i]!;
      }
    }
  }

  /** The details along a patch's sides that come from interfaces, which are at `level` already. */
  takeDetails(patch: number, level: number): void {
    const grid = this.#layout.grids[patch]!;
    if (grid.interface) return;
    const steps = this.#layout.steps(patch, level);
    const plane = this.#planes[patch]!;
    for (const [side, source] of grid.sources.entries()) {
      const axis = side < 2 ? 1 : 0;
      const step = steps[axis];
      if (source === null || !step.midpoints) continue;
      const points = this.#points(source, level);
      const pole = points.length === 1;
      const line = pole ? null : forwardStep(this.#arena, points, step, this.#predictors.of(grid, step, level, axis));
      const { words, at } = numbersOf(this.#arena, plane);
      const { start, stride } = sideOf(plane, side, steps[0].coarse, steps[1].coarse);
      for (let i = step.coarse; i < step.length; i++) words[at + start + i * stride] = line?.[i] ?? 0;
    }
  }

  /** Points of an interface at a level, in the order of the side, or the interface's end, that takes them. */
  #points(source: Source, level: number): Int32Array {
    const plane = this.#planes[source.grid]!;
    const { words, at } = numbersOf(this.#arena, plane);
    const [count] = this.#layout.shape(source.grid, level);
    const points = new Int32Array(count);
    for (let i = 0; i < count; i++) {
      points[source.reversed ? count - 1 - i : i] = words[at + i * plane.pitch]!;
    }
    return points;
  }
}

/** Where a side of so many rows and columns of a plane begins, and from one number to the next. */
function sideOf(plane: Plane, side: number, rows: number, columns: number): { start: number; stride: number } {
  const start = [0, (rows - 1) * plane.pitch, 0, columns - 1][side]!;
  return { start, stride: side < 2 ? 1 : plane.pitch };
}
