/** The numbers by which a surface is coloured. */

import type { Component, Field } from "./geometry-messages";
import { between, type Frame, interpolated, type Lattice, placesOf } from "./lattice";
import { slopes } from "./normals";
import type { AttributeGrid, Grid } from "./source";

/** What stands in the place of a value that there is not. */
export const NO_VALUE = -1e30;

/** A part of a lattice: everything but its outermost lines. */
export function inner(lattice: Lattice): Lattice {
  const [rows, columns] = [lattice.rows - 2, lattice.columns - 2];
  const points = new Float64Array(rows * columns * 3);
  const valid = new Uint8Array(rows * columns);
  for (let i = 0; i < rows; i += 1) {
    const from = (i + 1) * lattice.columns + 1;
    points.set(lattice.points.subarray(3 * from, 3 * (from + columns)), 3 * i * columns);
    valid.set(lattice.valid.subarray(from, from + columns), i * columns);
  }
  return { rows, columns, points, valid };
}

/** What a field is computed from, for the nodes of one patch. */
export interface FieldInput {
  readonly grid: Grid;
  /** Lines of nodes. */
  readonly rows: readonly number[];
  readonly columns: readonly number[];
  readonly nodes: Lattice;
  /** Where the same nodes were a picture before; null: there was none. */
  readonly before: Lattice | null;
  /** [node, xyz], not normalised. */
  readonly normals: Float64Array;
  readonly frame: Frame;
  /** By how much z are drawn higher than x and y of the same length. */
  readonly rise: number;
}

/** The values of a field, [node]; NaN where there is none. */
export function fieldValues(field: Field, input: FieldInput): Float64Array {
  const { nodes, frame } = input;
  switch (field.kind) {
    case "none":
      return new Float64Array(nodes.valid.length);
    case "height":
      return heights(nodes, frame);
    case "slope":
      return slopes(input.normals, input.rise);
    case "change":
      return changes(input);
    case "attribute":
      return attributeAt(field, input.grid, input.rows, input.columns);
  }
}

/**
 * The values of a field where the same nodes were a picture before; null: as now.
 *
 * @param normals - Of the nodes as they were before: [node, xyz], not normalised.
 */
export function fieldBefore(field: Field, old: Grid, normals: Float64Array, input: FieldInput): Float64Array | null {
  if (field.kind === "height" && input.before !== null) return heights(input.before, input.frame);
  if (field.kind === "slope") return slopes(normals, input.rise);
  if (field.kind !== "attribute") return null;
  const { grid } = input;
  const down = between(
    placesOf(input.rows, grid.rowsAt, grid.full[0], grid.closed[0]),
    old.rowsAt,
    old.full[0],
    old.closed[0],
  );
  const across = between(
    placesOf(input.columns, grid.columnsAt, grid.full[1], grid.closed[1]),
    old.columnsAt,
    old.full[1],
    old.closed[1],
  );
  const found = old.attributes.find(({ name }) => name === field.name);
  if (found === undefined) return null;
  return interpolated(down, across, old.columnsAt.length, reading(found, field.component));
}

function heights(nodes: Lattice, { origin, scale }: Frame): Float64Array {
  return Float64Array.from(nodes.valid, (valid, node) =>
    valid ? nodes.points[3 * node + 2]! / scale[2] + origin[2] : Number.NaN,
  );
}

/** How far nodes have moved along their normals, in the surface's unit. */
function changes({ nodes, before, normals, frame }: FieldInput): Float64Array {
  return Float64Array.from(nodes.valid, (valid, node) => {
    if (!valid || before?.valid[node] !== 1) return valid ? 0 : Number.NaN;
    let [sum, length] = [0, 0];
    for (let k = 0; k < 3; k += 1) {
      const normal = normals[3 * node + k]!;
      sum += ((nodes.points[3 * node + k]! - before.points[3 * node + k]!) / frame.scale[k]!) * normal;
      length += normal * normal;
    }
    return length > 0 ? sum / Math.sqrt(length) : 0;
  });
}

/** Reads a component of an attribute, or the length of all of them, by nodes. */
function reading({ components, values }: AttributeGrid, component: Component): (node: number) => number {
  if (component !== "magnitude")
    return component < components ? (node) => values[node * components + component]! : () => Number.NaN;
  return (node) => {
    let sum = 0;
    for (let k = 0; k < components; k += 1) sum += values[node * components + k]! ** 2;
    return Math.sqrt(sum);
  };
}

function attributeAt(
  field: { readonly name: string; readonly component: Component },
  grid: Grid,
  rows: readonly number[],
  columns: readonly number[],
): Float64Array {
  const found = grid.attributes.find(({ name }) => name === field.name);
  const values = new Float64Array(rows.length * columns.length).fill(Number.NaN);
  if (found === undefined) return values;
  const read = reading(found, field.component);
  const [height, width] = [grid.rowsAt.length, grid.columnsAt.length];
  rows.forEach((row, i) => {
    columns.forEach((column, j) => {
      const node = (row % height) * width + (column % width);
      if (grid.mask?.[node] === 0) return;
      values[i * columns.length + j] = read(node);
    });
  });
  return values;
}

/**
 * The range of some values.
 *
 * @param trimmed - Leave out the most extreme hundredth at either end, so that single values do not decide.
 */
export function extremes(values: Float64Array, trimmed: boolean): [number, number] {
  const finite = values.filter((value) => Number.isFinite(value));
  if (finite.length === 0) return [Number.NaN, Number.NaN];
  if (trimmed) {
    finite.sort();
    const cut = Math.floor(finite.length / 100);
    return [finite[cut]!, finite[finite.length - 1 - cut]!];
  }
  let [low, high] = [finite[0]!, finite[0]!];
  for (const value of finite) {
    if (value < low) low = value;
    else if (value > high) high = value;
  }
  return [low, high];
}
