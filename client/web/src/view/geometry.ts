/** The drawn surface: which patches there are, at which strides, and their buffers. Runs in a worker. */

import { type BoundaryNormals, boundaryNormals } from "./boundary-normals";
import { boundsOf, boxOf, DEGREE, type FrameOptions, frameOf, gridsFit } from "./bounds";
import { extremes, type FieldInput, fieldBefore, fieldValues, inner, NO_VALUE } from "./fields";
import type { Box, Colouring, Eye, Field, Hit, PatchBuffers } from "./geometry-messages";
import { type Frame, latticeBetween, latticeOf, placesOf } from "./lattice";
import { withoutJumps } from "./maps";
import { normalSums, packedNormals } from "./normals";
import { isLine, linesOf, type Patch, patchesOf, patchSize, piecesOf, quadsOf } from "./patches";
import { pick } from "./picking";
import type { Grid, Region } from "./source";
import { type StridesBeside, stitched } from "./stitching";
import { chooseStrides, type PatchBounds, type Strides } from "./strides";

/** What a new picture or view has changed. */
export interface Change {
  readonly patches: PatchBuffers[];
  readonly triangles: number;
}

/** What is said of a picture. */
export interface PictureOptions extends FrameOptions {
  /** Sides of blocks coincide, so that all of it is drawn at one stride. */
  readonly joined: boolean;
  /** Forget all before. */
  readonly fresh: boolean;
}

/** Triangles on the graphics card where nothing else is said. */
export const DEFAULT_TRIANGLES = 4_000_000;

/** The picture in hand and the one before, cut into patches. */
export class Geometry {
  private grids: readonly Grid[] = [];
  private before: readonly Grid[] | null = null;
  private patches: Patch[] = [];
  private bounds: PatchBounds[] = [];
  private size = 1;
  private strides: Int32Array = new Int32Array();
  private ends: BoundaryNormals = new Map();
  private joined = false;
  private geographic = false;
  private field: Field = { kind: "height" };
  private known: [number, number] | null = null;
  private base: { low: number; span: number } | null = null;
  private fixed: Frame | null = null;
  private eye: Eye | null = null;
  private most = DEFAULT_TRIANGLES;
  private chosen: Strides | null = null;

  /** How coordinates are drawn; the same for all pictures, unless early ones are of quite another size. */
  get frame(): Frame {
    if (this.fixed === null) throw new Error("expected a picture first");
    return this.fixed;
  }

  /** The box around all valid points, in the surface's coordinates. */
  get box(): Box {
    return boxOf(this.grids);
  }

  /**
   * Takes a new picture; the one in hand becomes the one before, from which the new one is blended in.
   *
   * @returns the buffers of all patches.
   */
  setPicture(grids: readonly Grid[], { joined, fresh, ...options }: PictureOptions): Change {
    if (fresh) {
      this.fixed = null;
      this.base = null;
    }
    this.known = null;
    this.before = !fresh && gridsFit(this.grids, grids) ? this.grids : null;
    this.grids = grids;
    this.joined = joined;
    this.geographic = options.geographic;
    const fitting = frameOf(this.box, options);
    if (this.fixed === null || isOther(this.fixed, fitting)) this.fixed = fitting;
    this.ends = boundaryNormals(grids, this.fixed);
    const shapes = grids.map(({ rowsAt, columnsAt }) => [rowsAt.length, columnsAt.length] as const);
    this.size = patchSize(shapes.map((shape, k) => quadsOf(shape, grids[k]!.closed)));
    this.patches = [];
    shapes.forEach((shape, block) => {
      this.patches.push(...patchesOf(block, shape, grids[block]!.closed, this.size, this.patches.length));
    });
    this.bounds = this.patches.map((patch) => boundsOf(grids[patch.block]!, patch, this.frame));
    this.strides = this.wishedStrides();
    return this.built(this.patches.map((_, k) => k));
  }

  /** Takes another view. @returns the buffers of patches that are drawn in another way now. */
  setEye(eye: Eye): Change {
    this.eye = eye;
    if (this.grids.length === 0) return { patches: [], triangles: 0 };
    const strides = this.wishedStrides();
    const changed = (patch: number): boolean => patch >= 0 && strides[patch] !== this.strides[patch];
    const again = this.patches.flatMap(({ beside }, patch) => (changed(patch) || beside.some(changed) ? [patch] : []));
    this.strides = strides;
    return this.built(again);
  }

  /** Colours by another field. @returns the buffers of all patches. */
  setField(field: Field): Change {
    this.field = field;
    this.known = null;
    this.base = null;
    return this.built(this.patches.map((_, k) => k));
  }

  /** Draws other numbers of triangles from the next view on. */
  setMost(triangles: number): void {
    this.most = triangles;
  }

  /** Whether a view is known. */
  get sees(): boolean {
    return this.eye !== null;
  }

  /** How many levels finer or coarser a grid the view would show, see `Strides.finer`. */
  get finer(): number {
    return this.chosen?.finer ?? 0;
  }

  /** What of the only block is in the view, at full resolution; null: more than half of it, or there are more blocks. */
  get region(): Region | null {
    const grid = this.grids[0];
    if (this.grids.length !== 1 || grid === undefined || this.chosen === null || this.joined) return null;
    const seen = this.patches.filter((_, k) => this.chosen?.seen[k]);
    if (seen.length === 0) return null;
    const span = (axis: 0 | 1): [number, number] => {
      const at = axis === 0 ? grid.rowsAt : grid.columnsAt;
      const lines = seen.map((patch) => (axis === 0 ? patch.rows : patch.columns));
      const places = (line: number): number => (line < at.length ? at[line]! : grid.full[axis] - 1);
      const first = Math.floor(places(Math.min(...lines.map(([a]) => a))));
      const last = Math.ceil(places(Math.max(...lines.map(([, b]) => b))));
      return [first, Math.min(last + 1, grid.full[axis])];
    };
    const region: Region = [span(0), span(1)];
    const [inside, whole] = [
      region,
      [
        [0, grid.full[0]],
        [0, grid.full[1]],
      ],
    ].map(([rows, columns]) => Math.max(1, rows![1]! - rows![0]!) * Math.max(1, columns![1]! - columns![0]!));
    return 2 * inside! > whole! ? null : region;
  }

  /** Where a ray of drawn coordinates (before exaggeration) meets the surface. */
  pick(origin: readonly [number, number, number], direction: readonly [number, number, number]): Hit | null {
    return this.grids.length === 0 ? null : pick(this.grids, this.bounds, this.frame, origin, direction);
  }

  /** What the values of buffers mean. */
  colouring(): Colouring {
    const { low, span } = this.spanned();
    return { low, span, range: this.range() };
  }

  /** By how much z are drawn higher than x and y of the same length. */
  private get rise(): number {
    const { scale } = this.frame;
    return scale[2] / (this.geographic ? scale[1] / DEGREE : scale[1]);
  }

  private wishedStrides(): Int32Array {
    const everywhere = (stride: number): Int32Array => new Int32Array(this.patches.length).fill(stride);
    if (this.eye === null) return everywhere(1);
    this.chosen = chooseStrides(this.bounds, this.eye, this.most, this.size);
    return this.joined ? everywhere(1) : this.chosen.strides;
  }

  private built(numbers: readonly number[]): Change {
    const patches = numbers.map((patch) => this.buffers(patch));
    const triangles = this.patches.reduce((sum, patch, k) => {
      const lines = (of: readonly [number, number]): number => Math.ceil((of[1] - of[0]) / this.strides[k]!);
      return sum + 2 * lines(patch.rows) * lines(patch.columns);
    }, 0);
    return { patches, triangles };
  }

  private buffers(number: number): PatchBuffers {
    const patch = this.patches[number]!;
    const grid = this.grids[patch.block]!;
    const old = this.before?.[patch.block];
    const stride = this.strides[number]!;
    const [rows, columns] = [linesOf(patch.rows, stride), linesOf(patch.columns, stride)];
    const around = (lines: number[]): number[] => [lines[0]! - stride, ...lines, lines.at(-1)! + stride];
    const lattice = latticeOf(grid, around(rows), around(columns), this.frame);
    const normals = normalSums(lattice);
    this.joinNormals(patch, rows, columns, normals);
    let beforeAround = null;
    if (old !== undefined) {
      const places = (lines: number[], axis: 0 | 1): number[] =>
        placesOf(around(lines), axis === 0 ? grid.rowsAt : grid.columnsAt, grid.full[axis], grid.closed[axis]);
      beforeAround = latticeBetween(old, places(rows, 0), places(columns, 1), this.frame);
    }
    const nodes = inner(lattice);
    const before = beforeAround === null ? null : inner(beforeAround);
    const normalsBefore = beforeAround === null ? null : normalSums(beforeAround);
    const input: FieldInput = { grid, rows, columns, nodes, before, normals, frame: this.frame, rise: this.rise };
    const values = this.packed(fieldValues(this.field, input));
    const valuesBefore =
      normalsBefore !== null && old !== undefined ? fieldBefore(this.field, old, normalsBefore, input) : null;
    const beside = patch.beside.map((other) => (other < 0 ? 0 : this.strides[other]!)) as unknown as StridesBeside;
    const whole = stitched(patch, stride, beside, grid.mask === null ? null : nodes.valid);
    const triangles = withoutJumps(whole, nodes.points, this.frame.scale, grid.periods);
    const { centre, half } = this.bounds[number]!;
    const line = isLine(patch);
    return {
      patch: number,
      pieces: line ? piecesOf(nodes.valid) : null,
      positions: Float32Array.from(nodes.points),
      from: before === null ? null : merged(before.points, before.valid, nodes.points),
      normals: packedNormals(normals, line),
      fromNormals: normalsBefore === null ? null : packedNormals(normalsBefore, line),
      values,
      fromValues: valuesBefore === null ? null : this.packed(valuesBefore),
      places: placesOfNodes(rows, columns),
      triangles: nodes.valid.length > 65535 ? triangles : Uint16Array.from(triangles),
      sphere: [...centre, Math.hypot(...half)],
    };
  }

  private joinNormals(patch: Patch, rows: number[], columns: number[], normals: Float64Array): void {
    const ends = this.ends.get(patch.block);
    if (ends === undefined) return;
    const grid = this.grids[patch.block]!;
    const [height, width] = [grid.rowsAt.length, grid.columnsAt.length];
    rows.forEach((row, i) => {
      columns.forEach((column, j) => {
        const sum = ends.get((row % height) * width + (column % width));
        if (sum !== undefined) normals.set(sum, 3 * (i * columns.length + j));
      });
    });
  }

  private packed(values: Float64Array): Float32Array {
    const { low, span } = this.spanned();
    return Float32Array.from(values, (value) => (Number.isFinite(value) ? (value - low) / span : NO_VALUE));
  }

  /** The span that values are relative to; chosen once for a field, since buffers of several pictures are blended. */
  private spanned(): { low: number; span: number } {
    if (this.base === null) {
      const [low, high] = this.range();
      this.base = high > low ? { low, span: high - low } : { low: Number.isFinite(low) ? low : 0, span: 1 };
    }
    return this.base;
  }

  private range(): [number, number] {
    this.known ??= this.measured();
    return this.known;
  }

  private measured(): [number, number] {
    const trimmed = this.field.kind === "slope" || this.field.kind === "change";
    const parts = this.grids.map((grid, block) => {
      const lines = (length: number): number[] => {
        const stride = trimmed ? Math.max(1, Math.floor(length / 128)) : 1;
        return linesOf([0, length - 1], stride);
      };
      const [rows, columns] = [lines(grid.rowsAt.length), lines(grid.columnsAt.length)];
      const { frame, rise } = this;
      const all = (of: number[]): number[] => [2 * of[0]! - (of[1] ?? 1), ...of, 2 * of.at(-1)! - (of.at(-2) ?? 0)];
      if (this.field.kind === "attribute" || this.field.kind === "none") {
        const empty = new Float64Array();
        const nodes = { rows: 0, columns: 0, points: empty, valid: new Uint8Array() };
        return fieldValues(this.field, { grid, rows, columns, nodes, before: null, normals: empty, frame, rise });
      }
      const lattice = latticeOf(grid, all(rows), all(columns), this.frame);
      const old = this.field.kind === "change" ? this.before?.[block] : undefined;
      const places = (of: number[], axis: 0 | 1): number[] =>
        placesOf(of, axis === 0 ? grid.rowsAt : grid.columnsAt, grid.full[axis], grid.closed[axis]);
      const before = old === undefined ? null : latticeBetween(old, places(rows, 0), places(columns, 1), this.frame);
      const normals = this.field.kind === "height" ? new Float64Array() : normalSums(lattice);
      const nodes = inner(lattice);
      return fieldValues(this.field, {
        grid,
        rows,
        columns,
        nodes,
        before,
        normals,
        frame: this.frame,
        rise: this.rise,
      });
    });
    const ranges = parts.map((values) => extremes(values, trimmed)).filter(([low]) => !Number.isNaN(low));
    if (ranges.length === 0) return [Number.NaN, Number.NaN];
    return [Math.min(...ranges.map(([low]) => low)), Math.max(...ranges.map(([, high]) => high))];
  }
}

/** Whether a surface has turned out so much larger or smaller that it has to be drawn anew in another frame. */
function isOther(before: Frame, now: Frame): boolean {
  return before.scale.some((scale, k) => now.scale[k]! > 2.5 * scale || now.scale[k]! < 0.4 * scale);
}

/** Points of the picture before where it has them, else those of now. */
function merged(before: Float64Array, valid: Uint8Array, now: Float64Array): Float32Array {
  return Float32Array.from(now, (value, k) => (valid[Math.floor(k / 3)] === 1 ? before[k]! : value));
}

function placesOfNodes(rows: readonly number[], columns: readonly number[]): Float32Array {
  const places = new Float32Array(rows.length * columns.length * 2);
  rows.forEach((row, i) => {
    columns.forEach((column, j) => {
      places.set([row, column], 2 * (i * columns.length + j));
    });
  });
  return places;
}
