/** Coordinates that follow their index by a rule (docs/format.md, section 8, "x and y of heights"). */
import type { CoordinateRule } from "../container/extras";

/** Numbers in (rows, columns), of which one that does not change along an axis has length 1 there. */
export interface RulePlane {
  readonly rows: number;
  readonly columns: number;
  readonly values: Float64Array;
}

/**
 * Float64 values of a rule at these rows and columns of the full grid: all of them, where a rule names the last.
 * `down`: the coordinate runs along the rows.
 */
export function evaluate(rule: CoordinateRule, rows: Float64Array, columns: Float64Array, down: boolean): RulePlane {
  const places = down ? rows : columns;
  const last = rule.at(-1);
  const shape = down ? { rows: rows.length, columns: 1 } : { rows: 1, columns: columns.length };
  if (last === "values") {
    const values = Float64Array.from(rule.slice(0, -1), Number);
    return { ...shape, values: places.map((place) => interpolated(values, place)) };
  }
  const [first, second, third, shift] = rule.map(Number) as [number, number, number, number];
  if (rule.length === 2) return { ...shape, values: places.map((place) => place * second + first) };
  if (last === true) {
    const step = (second - first) / Math.max(places.length - 1, 1);
    const values = places.map((place) => place * step + first);
    values[values.length - 1] = second;
    return { ...shape, values };
  }
  if (last === false) return { ...shape, values: places.map((place) => (place + 0.5) * second + first) };
  if (rule.length === 3) return { ...shape, values: places.map((place) => (place * second + first) / third) };
  const values = new Float64Array(rows.length * columns.length);
  for (let i = 0; i < rows.length; i++) {
    for (let j = 0; j < columns.length; j++) {
      values[i * columns.length + j] = (columns[j]! + shift) * second + (rows[i]! + shift) * third + first;
    }
  }
  return { rows: rows.length, columns: columns.length, values };
}

/** Linear interpolation between values at 0, 1, 2, ...; the nearest of them outside. */
export function interpolated(values: Float64Array, place: number): number {
  const below = Math.floor(place);
  if (below < 0) return values[0]!;
  if (below >= values.length - 1) return values[values.length - 1]!;
  const low = values[below]!;
  return place === below ? low : (values[below + 1]! - low) * (place - below) + low;
}

/** To the nearest whole number, ties to even. */
export function rint(value: number): number {
  const rounded = Math.round(value);
  if (Math.abs(value % 1) !== 0.5) return Object.is(rounded, 0) && value < 0 ? -0 : rounded;
  return 2 * Math.round(value / 2);
}
