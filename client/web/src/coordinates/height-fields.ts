/**
 * Height fields: where the points of heights lie. x and y of a grid follow a rule of the header (`plane`), or of the
 * metadata (`axes`, `geotransform`); those of a coarser level are such that the grid spans what the surface spans.
 */
import { arePlane, type CoordinateRule, type Plane } from "../container/extras";
import { isMap, type Metadata } from "../container/sections";
import { InputError } from "../errors";
import { axisLengths, axisStep, extension, hasTail } from "../grid/axis";
import type { Closed, Region, Shape } from "../types";
import { evaluate, interpolated, type RulePlane } from "./coordinate-rules";

/** h_j of the update step, as many as matter in float64. */
const UPDATE = Array.from({ length: 24 }, (_, j) => (1 - 1 / Math.sqrt(2)) * (2 * Math.sqrt(2) - 3) ** j);
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

/** Metadata, and rules of a plane, of the grid of a coarser level. */
export interface LevelPlacement {
  readonly metadata: Metadata;
  readonly plane: Plane | null;
  readonly nodes: Nodes;
}

/**
 * Metadata of the grid of a coarser level of heights, `halvings` levels below the surface: x and y span what they span
 * in the surface. Where an axis has a gap, `nodes` has the places of the nodes, in steps of the level's even grid.
 */
export function levelPlacement(
  metadata: Metadata,
  plane: Plane | null,
  shape: Shape,
  coarse: Shape,
  closed: Closed,
  halvings: number,
): LevelPlacement {
  const { seam: _seam, turn: _turn, ...result } = metadata;
  const across = ([0, 1] as const).map((axis) =>
    closed[axis] ? shape[axis] / coarse[axis] : (shape[axis] - 1) / Math.max(coarse[axis] - 1, 1),
  ) as [number, number];
  result.geotransform = levelGeotransform(metadata.geotransform ?? null, across);
  if (metadata.axes !== undefined) {
    const { rules, swapped } = axesOf(metadata.axes);
    const x = coarser(rules[0], shape, coarse, across, swapped);
    const y = coarser(rules[1], shape, coarse, across, !swapped);
    result.axes = { ...(metadata.axes as Metadata), x, y };
  }
  const own: Plane | null = plane && [
    coarser(plane[0], shape, coarse, across, false),
    coarser(plane[1], shape, coarse, across, true),
  ];
  const nodes = ([0, 1] as const).map((axis) =>
    hasGap(shape[axis], closed[axis], halvings)
      ? levelCoordinates(shape[axis], closed[axis], halvings).map((place) => place / across[axis])
      : null,
  ) as unknown as Nodes;
  if (plane === null && (nodes[0] || nodes[1])) result.nodes = nodes;
  return { metadata: result, plane: own, nodes };
}

/** The geotransform of a level's grid, which has a node for so many of the full grid's. */
function levelGeotransform(transform: unknown, [down, across]: readonly [number, number]): number[] {
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

function coarser(
  rule: CoordinateRule,
  shape: Shape,
  coarse: Shape,
  ratios: readonly [number, number],
  down: boolean,
): CoordinateRule {
  const axis = down ? 0 : 1;
  const last = rule.at(-1);
  if (rule.length === 4 && last !== "values") {
    const [origin, across, byRow, shift] = rule.map(Number) as [number, number, number, number];
    return [origin + shift * (across + byRow), across * ratios[1], byRow * ratios[0], 0];
  }
  const places = Float64Array.from({ length: shape[axis] }, (_, i) => i);
  const { values } = evaluate(rule, places, places, down);
  if (last === "values") {
    const at = Array.from({ length: coarse[axis] }, (_, i) => interpolated(values, i * ratios[axis]));
    return [...at, "values"];
  }
  return [values[0]!, ((values[values.length - 1]! - values[0]!) / (shape[axis] - 1)) * ratios[axis]];
}

/**
 * Where the nodes of a coarser level lie along an axis, in indices of the full grid: the ramp 0, 1, 2, ... put through
 * the same coarsening as the surface. A closed axis goes on after its end, one turn of `length` further.
 */
function levelCoordinates(length: number, closed: boolean, halvings: number): number[] {
  let nodes = Array.from({ length }, (_, i) => i);
  for (let done = 0; done < halvings; done++) {
    const step = axisStep(nodes.length, closed);
    if (!step.midpoints) break;
    const current = nodes;
    const after = (k: number) => current[2 * k + 2] ?? current[0]! + length;
    const details = Array.from(
      { length: step.midpoints },
      (_, k) => current[2 * k + 1]! - (current[2 * k]! + after(k)) / 2,
    );
    const reach = UPDATE.length;
    const table = extension(step, reach);
    const detail = (k: number) => {
      if (k >= 0 && k < step.midpoints) return details[k]!;
      const beyond = k < 0 ? k + reach : k - step.midpoints + reach;
      return table[2 * beyond + 1]! * details[table[2 * beyond]!]!;
    };
    nodes = Array.from({ length: step.run }, (_, k) =>
      UPDATE.reduce((sum, tap, j) => sum + tap * (detail(k + j) + detail(k - 1 - j)), current[2 * k]!),
    );
    if (hasTail(step)) nodes.push(current.at(-1)!);
  }
  return nodes;
}

/** Whether an axis that is coarsened so often has an interval without a midpoint on the way. */
function hasGap(length: number, closed: boolean, halvings: number): boolean {
  const finer = axisLengths(length, closed).slice(1).reverse().slice(0, halvings);
  return finer.some((own) => own % 2 === (closed ? 1 : 0));
}

/** The plane of a window, whose places are rows and columns of the surface. */
export function windowPlane(plane: Plane, shape: Shape): Plane {
  return plane.map((rule, channel) => {
    if (rule.at(-1) !== true) return rule;
    // Its last number is that of the last place of the surface.
    const places = Float64Array.from({ length: shape[channel ? 0 : 1] }, (_, i) => i);
    return [...evaluate(rule, places, places, channel === 1).values, "values" as const];
  }) as unknown as Plane;
}

/** Metadata of a window of a surface of this shape: a geotransform, or axes, move with it. */
export function windowMetadata(metadata: Metadata, shape: Shape, region: Region): Metadata {
  const { seam: _seam, turn: _turn, poles: _poles, ...values } = metadata;
  const [[top], [left]] = region;
  if (values.geotransform !== undefined && values.geotransform !== null) {
    const [x0, xColumn, xRow, y0, yColumn, yRow] = geotransformOf(values.geotransform);
    const x = x0 + left * xColumn + top * xRow;
    values.geotransform = [x, xColumn, xRow, y0 + left * yColumn + top * yRow, yColumn, yRow];
  }
  if (values.axes !== undefined) {
    const { rules, swapped } = axesOf(values.axes);
    const moved = (rule: CoordinateRule, down: boolean) => {
      const places = Float64Array.from({ length: shape[down ? 0 : 1] }, (_, i) => i);
      const { values: all } = evaluate(
        rule,
        down ? places : new Float64Array(1),
        down ? new Float64Array(1) : places,
        down,
      );
      return [...all.subarray(...region[down ? 0 : 1]), "values"];
    };
    values.axes = { ...(values.axes as Metadata), x: moved(rules[0], swapped), y: moved(rules[1], !swapped) };
  }
  return values;
}
