/** From positions in the plane of a CRS to rows and columns: the inverse of the rules of coordinates. */

import { arePlane, type CoordinateRule, type Plane } from "../container/extras";
import { isMap, type Metadata } from "../container/sections";
import { InputError } from "../errors";
import type { Closed, Shape } from "../types";

/** How far a grid reaches beyond its outer nodes, in cells: half of one, and what rounded geotransforms lack at a pole. */
const EDGE = 0.501;

/** Rows and columns, or x and y, of any number of places. */
export type Pair = readonly [Float64Array, Float64Array];

/** Coordinates of an axis that is not even, ascending, at places that may descend. */
interface Line {
  readonly values: readonly number[];
  readonly places: readonly number[];
}

type Two = readonly [number, number];

/** Where the nodes of a grid lie. Node (0, 0) is at row 0 and column 0; the grid ends half a cell beyond its nodes. */
export class GridPlaces {
  /** x and y of row 0 and column 0; 0 for a coordinate that is listed. */
  readonly #origin: Two;
  /** x, and y, of a step of rows and of columns; 1 where the coordinates of an axis are listed. */
  readonly #matrix: readonly [x: Two, y: Two];
  readonly #inverse: readonly [row: Two, column: Two];
  /** Of rows and of columns, where they are not even: their coordinates, or how many steps they are. */
  readonly #lines: readonly [Line | null, Line | null];
  readonly #west: number;

  /**
   * @param plane Rules of the header; null: those of `axes` or `geotransform` in the metadata hold.
   * @param turn What x repeats after.
   * @throws InputError if there are none, or they have no inverse.
   */
  constructor(
    metadata: Metadata,
    plane: Plane | null,
    readonly shape: Shape,
    readonly closed: Closed,
    readonly turn: number | undefined,
  ) {
    const { rules, swapped } = rulesOf(metadata, plane);
    const nodes = nodesOf(metadata.nodes);
    const lines: [Line | null, Line | null] = [null, null];
    const origin: [number, number] = [0, 0];
    const matrix: [[number, number], [number, number]] = [
      [0, 0],
      [0, 0],
    ];
    for (const channel of [0, 1] as const) {
      const rule = rules[channel];
      const axis = swapped ? channel : ((1 - channel) as 0 | 1);
      if (rule.at(-1) === "values") {
        const around = closed[axis] && channel === 0 ? turn : undefined;
        lines[axis] = lineOf(rule.slice(0, -1).map(Number), shape[axis], around);
        matrix[channel][axis] = 1;
      } else [origin[channel], matrix[channel]] = affine(rule, shape[axis], axis);
    }
    const listed = lines.some((line) => line !== null);
    for (const axis of [0, 1] as const) {
      const at = nodes[axis];
      // A coarser level of another surface, in steps of its even grid.
      if (at !== null) lines[axis] ??= lineOf(at, shape[axis], closed[axis] ? shape[axis] : undefined);
    }
    const [[a, b], [c, d]] = matrix;
    const determinant = a * d - b * c;
    if (!Number.isFinite(determinant) || !origin.every(Number.isFinite) || determinant === 0) {
      throw new InputError(`expected coordinates that differ from node to node, got ${told(rules)}`);
    }
    if (listed && [a, b, c, d].filter((step) => step !== 0).length > 2) {
      throw new InputError("expected listed coordinates of a grid that is not rotated, got one that is");
    }
    this.#origin = origin;
    this.#matrix = matrix;
    this.#inverse = inverseOf(matrix, determinant);
    this.#lines = lines;
    const [rows, columns] = shape;
    const corners = [-0.5, rows - 0.5].flatMap((row) => [-0.5, columns - 0.5].map((column) => [row, column] as const));
    const at = ([0, 1] as const).map((axis) => Float64Array.from(corners, (corner) => corner[axis]));
    this.#west = Math.min(...this.positions([at[0]!, at[1]!])[0]);
  }

  /** The rows and columns of positions; NaN or beyond the grid where it is not. */
  places([x, y]: Pair): Pair {
    const found: Pair = [new Float64Array(x.length), new Float64Array(x.length)];
    const [[a, b], [c, d]] = this.#inverse;
    for (let i = 0; i < x.length; i++) {
      let across = x[i]!;
      if (this.turn !== undefined) across = this.#west + modulo(across - this.#west, this.turn);
      across -= this.#origin[0];
      const up = y[i]! - this.#origin[1];
      // An infinite position times a step of 0 would be no number along the other axis too.
      found[0][i] = a && b ? a * across + b * up : a ? a * across : b * up;
      found[1][i] = c && d ? c * across + d * up : c ? c * across : d * up;
    }
    for (const axis of [0, 1] as const) {
      const line = this.#lines[axis];
      if (line !== null) replaceAll(found[axis], (value) => between(value, line.values, line.places, Number.NaN));
    }
    return found;
  }

  /** x and y at rows and columns; the inverse of `places`. */
  positions(places: Pair): Pair {
    const [rows, columns] = ([0, 1] as const).map((axis) => {
      const line = this.#lines[axis];
      if (line === null) return places[axis];
      const falls = line.places[0]! > line.places.at(-1)!;
      const [at, values] = falls ? [line.places.toReversed(), line.values.toReversed()] : [line.places, line.values];
      return places[axis].map((place) => between(place, at, values));
    }) as unknown as Pair;
    const [x, y] = ([0, 1] as const).map((channel) => {
      const [byRow, byColumn] = this.#matrix[channel];
      return rows.map((row, i) => byRow * row + byColumn * columns[i]! + this.#origin[channel]);
    });
    return [x!, y!];
  }

  /** Whether a place is of the grid, which goes on along closed axes. */
  has(row: number, column: number): boolean {
    return this.#hasAlong(0, row) && this.#hasAlong(1, column);
  }

  #hasAlong(axis: 0 | 1, place: number): boolean {
    if (this.closed[axis]) return Number.isFinite(place);
    return place >= -EDGE && place <= this.shape[axis] - 1 + EDGE;
  }
}

/** The rest of a division, of the sign of what it is divided by. */
export function modulo(value: number, by: number): number {
  const rest = value % by;
  return rest < 0 ? rest + by : rest;
}

/** Linear interpolation between values at ascending places; at their ends, or `outside` where that is given. */
export function between(place: number, places: ArrayLike<number>, values: ArrayLike<number>, outside?: number): number {
  const last = places.length - 1;
  if (!(place >= places[0]!)) return Number.isNaN(place) ? Number.NaN : (outside ?? values[0]!);
  if (place >= places[last]!) return place > places[last]! ? (outside ?? values[last]!) : values[last]!;
  let [low, high] = [0, last];
  while (high - low > 1) {
    const middle = (low + high) >> 1;
    if (places[middle]! <= place) low = middle;
    else high = middle;
  }
  const slope = (values[low + 1]! - values[low]!) / (places[low + 1]! - places[low]!);
  return slope * (place - places[low]!) + values[low]!;
}

function replaceAll(values: Float64Array, by: (value: number) => number): void {
  for (let i = 0; i < values.length; i++) values[i] = by(values[i]!);
}

function rulesOf(metadata: Metadata, plane: Plane | null): { rules: Plane; swapped: boolean } {
  const { axes, geotransform } = metadata;
  let rules: unknown = plane;
  let swapped = false;
  if (plane === null && isMap(axes)) {
    rules = [axes.x, axes.y];
    swapped = axes.rows === "x";
  } else if (plane === null && Array.isArray(geotransform) && geotransform.length === 6) {
    rules = [
      [...geotransform.slice(0, 3), 0.5],
      [...geotransform.slice(3), 0.5],
    ];
  } else if (plane === null) {
    throw new InputError("expected heights with a position, such as a geotransform, got heights without");
  }
  if (arePlane(rules)) return { rules, swapped };
  throw new InputError(`expected two rules of coordinates in the metadata, got ${told(rules)}`);
}

function nodesOf(nodes: unknown): readonly [readonly number[] | null, readonly number[] | null] {
  if (nodes === undefined || nodes === null) return [null, null];
  const lines = Array.isArray(nodes) && nodes.length === 2 ? nodes : [undefined];
  const found = lines.map((line) => (Array.isArray(line) ? line.map(Number) : line));
  if (found.every((line) => line === null || (Array.isArray(line) && line.every(Number.isFinite)))) {
    return [found[0], found[1]];
  }
  throw new InputError(`expected nodes of rows and of columns in the metadata, got ${told(nodes)}`);
}

/** The value of a rule at row 0 and column 0, and its steps from row to row and from column to column. */
function affine(rule: CoordinateRule, length: number, axis: 0 | 1): [number, [number, number]] {
  if (rule.length === 4) {
    const [origin, across, byRow, shift] = rule.map(Number) as [number, number, number, number];
    return [origin + shift * (across + byRow), [byRow, across]];
  }
  let [origin, step] = rule.map(Number) as [number, number];
  const last = rule.at(-1);
  if (last === true) step = (step - origin) / Math.max(length - 1, 1);
  else if (last === false) origin += step / 2;
  else if (rule.length === 3) [origin, step] = [origin / Number(last), step / Number(last)];
  return [origin, axis === 0 ? [step, 0] : [0, step]];
}

/** The listed coordinates of an axis; with `turn` it is closed, and its first place follows its last. */
function lineOf(listed: readonly number[], length: number, turn: number | undefined): Line {
  const values = listed.slice(0, length);
  const steps = values.slice(1).map((value, i) => value - values[i]!);
  const sign = Math.sign(steps[0] ?? 0);
  if (values.length !== length || length < 2 || sign === 0 || !steps.every((step) => step * sign > 0)) {
    throw new InputError("expected coordinates that ascend or descend along each axis, got others");
  }
  const places = values.map((_, i) => i);
  let line: Line;
  if (turn === undefined) {
    const ends = [values[0]! - EDGE * steps[0]!, values.at(-1)! + EDGE * steps.at(-1)!] as const;
    line = { values: [ends[0], ...values, ends[1]], places: [-EDGE, ...places, length - 1 + EDGE] };
  } else line = { values: [...values, values[0]! + sign * turn], places: [...places, length] };
  return sign > 0 ? line : { values: line.values.toReversed(), places: line.places.toReversed() };
}

/** Of a matrix of which whole lines or columns may be 0, without rounding more than a division does. */
function inverseOf([[a, b], [c, d]]: readonly [Two, Two], determinant: number): readonly [Two, Two] {
  if (b === 0 && c === 0) {
    return [
      [1 / a, 0],
      [0, 1 / d],
    ];
  }
  if (a === 0 && d === 0) {
    return [
      [0, 1 / c],
      [1 / b, 0],
    ];
  }
  return [
    [d / determinant, -b / determinant],
    [-c / determinant, a / determinant],
  ];
}

function told(value: unknown): string {
  return String(JSON.stringify(value, (_, part: unknown) => (typeof part === "bigint" ? Number(part) : part))).slice(
    0,
    80,
  );
}
