/** Blocks of a decoded surface as grids to draw: float64 coordinates, also of heights whose x and y follow rules. */

import type { CoordinateRule, Plane } from "../container/extras";
import type { Header } from "../container/header";
import type { Metadata } from "../container/sections";
import { evaluate, type RulePlane } from "../coordinates/coordinate-rules";
import { coordinatesOf, levelPlacement, type Placement, placementOf } from "../coordinates/height-fields";
import type { Block, PointArray } from "../types";
import { unrolled } from "./maps";
import type { AttributeGrid, AttributeInfo, Grid } from "./source";

/** Whether the points are heights that the header gives no x and y for. */
export function areHeights(header: Header): boolean {
  return header.pointChannels === 1 && header.plane === null && header.blocks.length === 1;
}

/** Values as float64; integers of 64 bits are rounded. */
function numbers({ values }: PointArray): Float64Array {
  if (values instanceof BigInt64Array || values instanceof BigUint64Array) return Float64Array.from(values, Number);
  return Float64Array.from(values);
}

/**
 * A block as a grid to draw; where a closed axis is that of a map, the grid goes on to the end of the turn.
 *
 * @param metadata - Of the whole surface, which may be known before its container's have come.
 */
export function gridOf(block: Block, number: number, header: Header, level: number, metadata: Metadata): Grid {
  const [rows, columns] = block.shape;
  const full = header.blocks[number]!.shape;
  const values = numbers(block.points);
  const { components } = block.points;
  const points = new Float64Array(3 * rows * columns);
  let [rowsAt, columnsAt]: [Float64Array, Float64Array] = [
    Float64Array.from(block.rows),
    Float64Array.from(block.columns),
  ];
  if (areHeights(header)) {
    const { placement, at } = placed(block, header, level, metadata);
    [rowsAt, columnsAt] = at;
    const [x, y] = coordinatesOf(placement, block.shape);
    fill(points, 0, x, rows, columns);
    fill(points, 1, y, rows, columns);
    for (let node = 0; node < rows * columns; node += 1) points[3 * node + 2] = values[node]!;
  } else {
    const first = components === 1 ? 2 : 0;
    for (let node = 0; node < rows * columns; node += 1) {
      for (let k = 0; k < Math.min(components, 3); k += 1)
        points[3 * node + first + k] = values[node * components + k]!;
      if (components === 1) {
        points[3 * node] = columnsAt[node % columns]!;
        points[3 * node + 1] = rowsAt[Math.floor(node / columns)]!;
      }
    }
  }
  const { closed, mask } = block;
  const grid: Grid = { rowsAt, columnsAt, full, closed, points, mask, attributes: attributesOf(block, values) };
  return unrolled(grid, areHeights(header) || header.plane !== null, metadata);
}

/** Rules of x and y at a level, and where its rows and columns stand. */
function placed(
  block: Block,
  header: Header,
  level: number,
  metadata: Metadata,
): { placement: Placement; at: [Float64Array, Float64Array] } {
  const halvings = header.levels - level;
  if (halvings === 0) {
    const at: [Float64Array, Float64Array] = [Float64Array.from(block.rows), Float64Array.from(block.columns)];
    const whole = block.shape.every((length, axis) => length === header.shape[axis as 0 | 1]);
    const placement = placementOf(metadata);
    if (whole) return { placement, at };
    const { swapped } = placement;
    const rules = placement.rules.map((rule, channel) =>
      anywhere(rule, header.shape[(channel === 1) !== swapped ? 0 : 1]),
    );
    return { placement: { rules: rules as unknown as Plane, swapped, nodes: [[...at[0]], [...at[1]]] }, at };
  }
  const coarse = levelPlacement(metadata, null, header.shape, block.shape, header.closed, halvings);
  const placement: Placement = { ...placementOf(coarse.metadata), nodes: coarse.nodes };
  const at = ([0, 1] as const).map((axis) => {
    const [length, nodes] = [header.shape[axis], block.shape[axis]];
    const step = header.closed[axis] ? length / nodes : (length - 1) / Math.max(nodes - 1, 1);
    const last = header.closed[axis] ? length : length - 1;
    // Beside a gap nodes may stand slightly outside.
    const place = (k: number): number => Math.min(Math.max(step * (coarse.nodes[axis]?.[k] ?? k), 0), last);
    return Float64Array.from({ length: nodes }, (_, k) => place(k));
  }) as [Float64Array, Float64Array];
  return { placement, at };
}

/** A rule that does not depend on how many places it is asked for: the one that names the last value of its axis. */
function anywhere(rule: CoordinateRule, length: number): CoordinateRule {
  if (rule.at(-1) !== true) return rule;
  const [first, last] = [Number(rule[0]), Number(rule[1])];
  return [first, (last - first) / Math.max(length - 1, 1)];
}

function fill(points: Float64Array, channel: number, plane: RulePlane, rows: number, columns: number): void {
  for (let i = 0; i < rows; i += 1) {
    const row = plane.rows === 1 ? 0 : i * plane.columns;
    for (let j = 0; j < columns; j += 1) {
      points[3 * (i * columns + j) + channel] = plane.values[row + (plane.columns === 1 ? 0 : j)]!;
    }
  }
}

/** Channels beyond x, y, z, and the arrays beside the points. */
function attributesOf(block: Block, values: Float64Array): AttributeGrid[] {
  const { components } = block.points;
  const result: AttributeGrid[] = [];
  if (components > 3) {
    const nodes = block.shape[0] * block.shape[1];
    for (let k = 3; k < components; k += 1) {
      const channel = Float64Array.from({ length: nodes }, (_, node) => values[node * components + k]!);
      result.push({ name: `channel ${k}`, components: 1, values: channel });
    }
  }
  for (const [name, array] of block.attributes) {
    result.push({ name, components: Math.max(array.components, 1), values: numbers(array) });
  }
  return result;
}

/** Names and components of `attributesOf`, from the header alone. */
export function attributesIn(header: Header): AttributeInfo[] {
  const channels = Array.from({ length: Math.max(0, header.pointChannels - 3) }, (_, k) => `channel ${k + 3}`);
  return [
    ...channels.map((name) => ({ name, components: 1 })),
    ...header.attributes.map(({ name, components }) => ({ name, components: Math.max(components, 1) })),
  ];
}

/** x and y of one node of heights at full resolution. */
export function placeOf(metadata: Metadata, header: Header, row: number, column: number): [number, number] {
  const { rules, swapped } = placementOf(metadata);
  return rules.map((rule, channel) => {
    const down = (channel === 1) !== swapped;
    const single = (value: number): Float64Array => Float64Array.of(value);
    if (rule.at(-1) !== true) return evaluate(rule, single(row), single(column), down).values[0]!;
    const all = Float64Array.from({ length: header.shape[down ? 0 : 1] }, (_, k) => k);
    return evaluate(rule, all, all, down).values[down ? row : column]!;
  }) as [number, number];
}
