/** x and y of height fields, which follow rules: the same as `lodestream.coordinate_rules` of the Python library. */

import type { Rule } from "./source";

/**
 * Coordinates by a rule.
 *
 *     [origin, step]                          origin + step k           k: the column for x, the row for y
 *     [origin, step, scale]                   (origin + step k) / scale
 *     [origin, step, false]                   step (k + 0.5) + origin
 *     [origin, last, true]                    origin + (last - origin) / (n - 1) k; at the end, last
 *     [origin, across, down, shift]           across (column + shift) + down (row + shift) + origin
 *     [v0, v1, v2, ..., "values"]             the numbers themselves, linear between them
 *
 * @param rule - One of these.
 * @param down - Whether k is the row.
 * @param length - n, the number of samples of the axis of k at full resolution.
 * @returns a function of row and column, in indices of the full resolution.
 * @throws TypeError if it is none of these.
 */
export function evaluator(rule: Rule, down: boolean, length: number): (row: number, column: number) => number {
  const last = rule.at(-1);
  const along = (of: (k: number) => number) => (row: number, column: number) => of(down ? row : column);
  if (last === "values") {
    const values = numbers(rule.slice(0, -1));
    return along((k) => between(values, k));
  }
  if (last === true) {
    const [origin = 0, end = 0] = numbers(rule.slice(0, -1));
    const step = (end - origin) / Math.max(length - 1, 1);
    return along((k) => (k === length - 1 ? end : k * step + origin));
  }
  if (last === false) {
    const [origin = 0, step = 0] = numbers(rule.slice(0, -1));
    return along((k) => (k + 0.5) * step + origin);
  }
  const [origin = 0, first = 0, second = 0, shift = 0] = numbers(rule);
  if (rule.length === 2) return along((k) => k * first + origin);
  if (rule.length === 3) return along((k) => (k * first + origin) / second);
  if (rule.length === 4) return (row, column) => (column + shift) * first + (row + shift) * second + origin;
  throw new TypeError(`expected a rule of coordinates, got ${JSON.stringify(rule).slice(0, 80)}`);
}

function numbers(values: Rule): number[] {
  return values.map((value) => {
    if (typeof value !== "number") throw new TypeError(`expected a number in a rule, got ${String(value)}`);
    return value;
  });
}

function between(values: readonly number[], at: number): number {
  const below = Math.min(Math.max(Math.floor(at), 0), Math.max(values.length - 2, 0));
  const [a = Number.NaN, b = a] = [values[below], values[below + 1]];
  const part = Math.min(Math.max(at - below, 0), 1);
  return a + (b - a) * part;
}

/**
 * The two rules of a height field.
 *
 * @param metadata - Of the surface: `grid`, `axes` or `geotransform`, else x is the column and y the row.
 * @returns x and y as functions of row and column.
 * @throws TypeError if the metadata hold something else.
 */
export function coordinatesOf(
  metadata: Readonly<Record<string, unknown>>,
  shape: readonly [number, number],
): { x: (row: number, column: number) => number; y: (row: number, column: number) => number } {
  let rules: readonly [Rule, Rule] = [
    [0, 1],
    [0, 1],
  ];
  let swapped = false;
  const axes = metadata.axes as { x: Rule; y: Rule; rows?: string } | undefined;
  const grid = metadata.grid as readonly [Rule, Rule] | undefined;
  const transform = metadata.geotransform as readonly number[] | null | undefined;
  if (grid !== undefined) {
    rules = grid;
  } else if (axes !== undefined) {
    rules = [axes.x, axes.y];
    swapped = axes.rows === "x";
  } else if (transform?.length === 6) {
    const [x0 = 0, xColumn = 0, xRow = 0, y0 = 0, yColumn = 0, yRow = 0] = transform;
    rules = [
      [x0, xColumn, xRow, 0.5],
      [y0, yColumn, yRow, 0.5],
    ];
  }
  const [xDown, yDown] = [swapped, !swapped];
  return {
    x: evaluator(rules[0], xDown, shape[xDown ? 0 : 1]),
    y: evaluator(rules[1], yDown, shape[yDown ? 0 : 1]),
  };
}
