/** What few surfaces have, a MessagePack map in the header: attributes, a plane, joints (docs/format.md, section 3.2). */
import { CorruptStreamError } from "../errors";
import { type AttributeKind, DTYPES } from "../types";
import { checkCount, LIMITS } from "./limits";
import { isMap, reason, unpack } from "./sections";

/**
 * A rule of x or y of a height field (docs/format.md, section 8): numbers, of which the last may be true, false or
 * "values".
 */
export type CoordinateRule = readonly (number | boolean | "values")[];

/** The rules of x and of y. */
export type Plane = readonly [x: CoordinateRule, y: CoordinateRule];

/** [dissolved, joined]: runs of points, and runs of pairs of points. */
export type JointChange = readonly [dissolved: readonly number[], joined: readonly number[]];

/** What few surfaces have. */
export interface Extras {
  readonly attributes: readonly AttributeKind[];
  /** Of heights that came with the x and y of a lattice. */
  readonly plane: Plane | null;
  /** From points that are one by the arrangement to places, and from these to vertices; null: nothing changes. */
  readonly jointChanges: readonly [JointChange, JointChange] | null;
}

/** Those of a surface that has none. */
export const NO_EXTRAS: Extras = { attributes: [], plane: null, jointChanges: null };

/** Extras from their bytes; the header's payload stands at `offset`, and the surface has so many points. */
export function parseExtras(data: Uint8Array, offset: number, points: number): Extras {
  checkCount(data.length, LIMITS.extras, "bytes of extras", offset);
  const extras = extrasOf(data, offset, points);
  let names = 0;
  for (const kind of extras.attributes) {
    names += new TextEncoder().encode(kind.name).length * Math.max(kind.components, 1);
  }
  const what = "bytes of names of attributes, each counted for all of its components";
  checkCount(names, LIMITS.names, what, offset);
  return extras;
}

function extrasOf(data: Uint8Array, offset: number, points: number): Extras {
  try {
    const values = unpack(data);
    if (!isMap(values)) throw new TypeError("no map");
    const attributes = listOf(values.attributes ?? []).map(attributeKind);
    let plane: Plane | null = null;
    if (values.plane !== undefined && values.plane !== null) {
      const grid = isMap(values.plane) ? values.plane.grid : undefined;
      if (!arePlane(grid)) throw new TypeError("a plane without two rules of coordinates");
      plane = grid;
    }
    if (new Set(attributes.map((kind) => kind.name)).size !== attributes.length) {
      throw new TypeError("two attributes of one name");
    }
    let jointChanges: Extras["jointChanges"] = null;
    if (values.joints !== undefined) {
      const changes = listOf(values.joints).map((change): JointChange => {
        const [dissolved, joined, ...others] = listOf(change);
        if (others.length) throw new TypeError("joints of another form");
        return [checkedRuns(dissolved, 1, points), checkedRuns(joined, 2, points)];
      });
      const [one, two, ...others] = changes;
      if (!one || !two || others.length) throw new TypeError("joints of another form");
      jointChanges = [one, two];
    }
    return { attributes, plane, jointChanges };
  } catch (error) {
    const got = reason(error);
    throw new CorruptStreamError(`expected attributes, a plane and joints in MessagePack, got ${got}`, offset);
  }
}

function listOf(value: unknown): unknown[] {
  if (!Array.isArray(value)) throw new TypeError("no list");
  return value;
}

function attributeKind(value: unknown): AttributeKind {
  const [name, code, components, ...others] = listOf(value);
  const dtype = Number.isInteger(code) ? DTYPES.at(code as number) : undefined;
  if (others.length || dtype === undefined || !Number.isInteger(components)) throw new TypeError("another attribute");
  if ((components as number) < 0 || (components as number) >= 1 << 16)
    throw new TypeError("another number of components");
  return { name: String(name), dtype, components: components as number };
}

/** Whether these are two rules, of x and of y. */
export function arePlane(rules: unknown): rules is Plane {
  return Array.isArray(rules) && rules.length === 2 && rules.every(isRule);
}

function isRule(rule: unknown): rule is CoordinateRule {
  if (!Array.isArray(rule) || rule.length < 2) return false;
  const last: unknown = rule.at(-1);
  const named = typeof last === "boolean" || last === "values";
  const numbers = named ? rule.slice(0, -1) : rule;
  if (!numbers.every((number) => typeof number === "number" || typeof number === "bigint")) return false;
  if (last === "values") return true;
  if (named) return numbers.length === 2;
  return rule.length === 2 || rule.length === 4 || (rule.length === 3 && Number(last) !== 0);
}

/** Runs of rows of `width` numbers from 0 to points - 1, and no more rows than points. */
function checkedRuns(runs: unknown, width: number, points: number): number[] {
  const one = 2 * width + 1;
  const numbers = listOf(runs);
  if (numbers.length % one || !numbers.every((number) => Number.isSafeInteger(number))) {
    throw new TypeError(`expected runs of ${one} whole numbers, got others`);
  }
  const found = numbers as number[];
  let total = 0;
  for (let start = 0; start < found.length; start += one) {
    const count = found[start + one - 1]!;
    total += Math.max(count, 1);
    let inside = count >= 1 && total <= points;
    for (let k = 0; k < width; k++) {
      const first = found[start + k]!;
      const last = first + (count - 1) * found[start + width + k]!;
      inside &&= first >= 0 && first < points && last >= 0 && last < points;
    }
    if (!inside) throw new TypeError(`expected runs of points below ${points}, got ${found.slice(start, start + one)}`);
  }
  return found;
}
