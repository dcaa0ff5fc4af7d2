/**
 * Height fields: where the points of heights lie. x and y of a grid follow a rule of the header (`plane`), or of the
 * metadata (`axes`, `geotransform`); nodes of a coarser level lie where they stand in the grid.
 */
import { arePlane, type CoordinateRule, type Plane } from "../container/extras";
import { isMap, type Metadata } from "../container/sections";
import { InputError } from "../errors";
import type { Positions } from "../grid/patches";
import type { Closed, Region, Shape, Span } from "../types";
import { evaluate, type RulePlane } from "./coordinate-rules";

/** Heights without a place of their own are drawn over their indices. */
const INDICES = [-0.5, 1, 0, -0.5, 0, 1] as const;

/** Places of rows and of columns in the rules of a grid; null: 0, 1, 2, ... */
export type Nodes = readonly [rows: readonly number[] | null, columns: readonly number[] | null];

/** What says where the points of heights lie. */
export interface Placement {
  readonly rules: Plane;
  /** x runs along the rows. */
  readonly swapped: boolean;
  readonly nodes: Nodes;
}

/** x and y of a grid of heights of this shape. */
export function coordinatesOf(
  { rules, swapped, nodes }: Placement,
  shape: Shape,
): readonly [x: RulePlane, y: RulePlane] {
  const [rows, columns] = ([0, 1] as const).map((axis) =>
    Float64Array.from({ length: shape[axis] }, (_, i) => nodes[axis]?.[i] ?? i),
  ) as [Float64Array, Float64Array];
  return [evaluate(rules[0], rows, columns, swapped), evaluate(rules[1], rows, columns, !swapped)];
}

/**
 * Where heights with these metadata lie: by `axes` or `geotransform` (of the centres of the cells), else x is the column
 * and y the row; at the places that `nodes` gives for a coarser level. Throws `InputError` where metadata are no rules.
 */
export function placementOf(metadata: Metadata): Placement {
  const nodes = nodesOf(metadata.nodes);
  if (metadata.axes !== undefined) {
    const { rules, swapped } = axesOf(metadata.axes);
    return { rules, swapped, nodes };
  }
  const transform = metadata.geotransform ?? null;
  if (transform === null) {
    return {
      rules: [
        [0, 1],
        [0, 1],
      ],
      swapped: false,
      nodes,
    };
  }
  const [x0, xColumn, xRow, y0, yColumn, yRow] = geotransformOf(transform);
  const rules: Plane = [
    [x0, xColumn, xRow, 0.5],
    [y0, yColumn, yRow, 0.5],
  ];
  return { rules, swapped: false, nodes };
}

function nodesOf(value: unknown): Nodes {
  if (!Array.isArray(value)) return [null, null];
  const [rows, columns] = value.map((places) => (Array.isArray(places) ? places.map(Number) : null));
  return [rows ?? null, columns ?? null];
}

function axesOf(axes: unknown): { rules: Plane; swapped: boolean } {
  const rules = isMap(axes) ? [axes.x, axes.y] : null;
  if (!arePlane(rules)) throw new InputError("expected axes of x and y in the metadata, got others");
  return { rules, swapped: isMap(axes) && axes.rows === "x" };
}

type Geotransform = readonly [number, number, number, number, number, number];

function geotransformOf(value: unknown): Geotransform {
  const numbers = Array.isArray(value) ? value.map(Number) : [];
  if (numbers.length !== 6 || numbers.some(Number.isNaN)) {
    throw new InputError(`expected a geotransform of six numbers in the metadata, got ${String(value)}`);
  }
  return numbers as unknown as Geotransform;
}

/** Samples of the full axis from one node of a level to the next, if all of these steps were equal. */
export function evenStep(length: number, nodes: number, closed: boolean): number {
  return closed ? length / nodes : (length - 1) / Math.max(nodes - 1, 1);
}

/**
 * Metadata of the grid of a coarser level of heights: its nodes lie where they stand in the full grid.
 *
 * `axes` have the coordinates of the nodes; without them `geotransform` is that of the level's even grid. Where the nodes
 * are not evenly spaced, since an axis had a gap, `nodes` has the places of rows and of columns in steps of that grid, or
 * null for an even axis; a geotransform beside `axes` is then left out.
 *
 * @param placed - The heights have an x and a y of their own.
 * @param places - The rows and the columns of the full grid at which the nodes stand, increasing.
 */
export function levelMetadata(
  metadata: Metadata,
  placed: boolean,
  shape: Shape,
  closed: Closed,
  places: Positions,
): Metadata {
  const { seam: _seam, turn: _turn, nodes: _nodes, ...result } = metadata;
  const transform = metadata.geotransform ?? null;
  const before = nodesOf(metadata.nodes);
  const steps = ([0, 1] as const).map((axis) => evenStep(shape[axis], places[axis].length, closed[axis]));
  const nodes = ([0, 1] as const).map((axis) => {
    const line = Array.from(places[axis], (place) => before[axis]?.[place] ?? place);
    const step = steps[axis]!;
    return line.every((place, k) => place === step * k) ? null : line.map((place) => place / step);
  });
  const uneven = nodes[0] || nodes[1];
  if (metadata.axes !== undefined) {
    result.axes = axesAt(metadata.axes, shape, places, closed);
    if (uneven || transform === null) delete result.geotransform;
    else result.geotransform = levelGeotransform(transform, steps);
    return result;
  }
  if (placed && transform === null) return result;
  result.geotransform = levelGeotransform(transform, steps);
  if (uneven && !placed) result.nodes = nodes;
  return result;
}

/** The geotransform of a level's grid, whose nodes are so many samples of the full one apart. */
function levelGeotransform(transform: unknown, steps: readonly number[]): number[] {
  const [down, across] = steps as [number, number];
  const [x0, xColumn, xRow, y0, yColumn, yRow] = transform === null ? INDICES : geotransformOf(transform);
  return [
    x0 + 0.5 * xColumn * (1 - across) + 0.5 * xRow * (1 - down),
    xColumn * across,
    xRow * down,
    y0 + 0.5 * yColumn * (1 - across) + 0.5 * yRow * (1 - down),
    yColumn * across,
    yRow * down,
  ];
}

/**
 * `axes` of some rows and columns of a grid, with the same coordinates there. Along a closed axis places may go on after
 * its end, where the coordinates of the first ones follow, one turn further. A list with one number more than the axis has
 * places says how long the step across the seam is; otherwise it is as long as the one before it. A list of places whose
 * axis is closed has that number again.
 */
function axesAt(axes: unknown, shape: Shape, places: Positions, closed: Closed = [false, false]): Metadata {
  const { rules, swapped } = axesOf(axes);
  const at = (rule: CoordinateRule, down: boolean): CoordinateRule => {
    const axis = down ? 0 : 1;
    const thin = thinned(rule, shape[axis], places[axis], down);
    if (thin !== null) return thin;
    const all = Float64Array.from({ length: shape[axis] }, (_, i) => i);
    const still = new Float64Array(1);
    const { values } = evaluate(rule, down ? all : still, down ? still : all, down);
    const line = values.length === all.length ? values : new Float64Array(all.length).fill(values[0]!);
    const after = afterTurn(rule, all.length);
    const turn = (after ?? 2 * line.at(-1)! - line.at(-2)!) - line[0]!;
    const wanted = [...places[axis]];
    if (closed[axis] && after !== null) wanted.push(wanted[0]! + all.length);
    const listed = wanted.map((k) => (k < all.length ? line[k]! : line[k - all.length]! + turn));
    return [...listed, "values" as const];
  };
  return { ...(axes as Metadata), x: at(rules[0], swapped), y: at(rules[1], !swapped) };
}

/** The first number of a closed axis of this length once more, one turn further; null: its rule does not list it. */
function afterTurn(rule: CoordinateRule, length: number): number | null {
  return rule.at(-1) === "values" && rule.length - 1 > length ? Number(rule[length]) : null;
}

/** Of x (0) or y (1), which runs along a closed axis of this length, the full turn that `axes` list; null: they do not. */
export function turnOfAxes(axes: unknown, axis: 0 | 1, length: number): { channel: 0 | 1; turn: number } | null {
  if (axes === undefined) return null;
  const { rules, swapped } = axesOf(axes);
  const channel = (axis === 1) !== swapped ? 0 : 1;
  const after = afterTurn(rules[channel], length);
  return after === null ? null : { channel, turn: after - Number(rules[channel][0]) };
}

/** The rule of every so many places of an axis, from the first one on; null where they, or the rule, are others. */
function thinned(rule: CoordinateRule, length: number, places: Int32Array, down: boolean): CoordinateRule | null {
  const step = places.length > 1 ? places[1]! : 1;
  const kind = rule.at(-1);
  if (step & (step - 1) || kind === "values" || !places.every((place, k) => place === step * k)) return null;
  if (kind === true) return places.at(-1) === length - 1 ? rule : null;
  if (rule.length === 4 || kind === false) {
    const own = kind === false ? [rule[0], ...(down ? [0, rule[1]] : [rule[1], 0]), 0.5] : rule;
    const [origin, across, byRow, shift] = own.map(Number) as [number, number, number, number];
    return [origin, across * step, byRow * step, shift / step];
  }
  const [origin, by, ...scale] = rule.map(Number) as [number, number, ...number[]];
  return [origin, by * step, ...scale] as CoordinateRule;
}

/** The rules of a plane of this shape for any of its rows and columns, which are the places then. */
export function planeAnywhere(plane: Plane, shape: Shape): Plane {
  return plane.map((rule, channel) => {
    if (rule.at(-1) !== true) return rule;
    // Its last number is that of the last place of the surface.
    const places = Float64Array.from({ length: shape[channel ? 0 : 1] }, (_, i) => i);
    return [...evaluate(rule, places, places, channel === 1).values, "values" as const];
  }) as unknown as Plane;
}

/** A window of the grid of a level of one block. */
export interface LevelWindow {
  /** Of the level's grid. */
  readonly shape: Shape;
  /** Rows and columns of the level's grid; across the seam of a closed axis they go on beyond its end. */
  readonly inside: Region;
  /** Which axes of the window are closed. */
  readonly closed: Closed;
  /** Shape and `axes` of the whole surface. */
  readonly full: Shape;
  readonly axes: unknown;
  /** The rows and columns of the whole surface at which those of the window stand, beyond its end across the seam. */
  readonly places: Positions;
}

/**
 * Metadata of a window of a level, from those of the level's grid: a geotransform with its nodes, or axes, move with it.
 * Across the seam of a closed axis all go on, beyond the end of the surface.
 */
export function windowMetadata(metadata: Metadata, window: LevelWindow): Metadata {
  const { seam: _seam, turn: _turn, poles: _poles, nodes, ...values } = metadata;
  const { shape, inside, closed, full, axes, places } = window;
  const [[top], [left]] = inside;
  const lines = ([0, 1] as const).map((axis) => lineOf(nodesOf(nodes)[axis], inside[axis], shape[axis]));
  if (lines.some((line) => line !== null)) values.nodes = lines;
  if (values.geotransform !== undefined && values.geotransform !== null) {
    const [x0, xColumn, xRow, y0, yColumn, yRow] = geotransformOf(values.geotransform);
    const x = x0 + left * xColumn + top * xRow;
    values.geotransform = [x, xColumn, xRow, y0 + left * yColumn + top * yRow, yColumn, yRow];
  }
  if (values.axes !== undefined) {
    // Of the whole surface: a step of a level across the seam may be shorter than the others.
    values.axes = axesAt(axes, full, places, closed);
  }
  return values;
}

/** Where the rows or columns of a window stand, in steps of the even grid from its first; null where evenly. */
function lineOf(nodes: readonly number[] | null, [start, stop]: Span, length: number): number[] | null {
  if (nodes === null) return null;
  const line = Array.from({ length: stop - start }, (_, i) => {
    const place = start + i;
    return nodes[place % length]! + Math.floor(place / length) * length - start;
  });
  return line.every((place, i) => place === i) ? null : line;
}
