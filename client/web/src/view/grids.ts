/** Blocks of a decoded surface as grids to draw: float64 coordinates, also of heights whose x and y follow rules. */

import type { CoordinateRule, Plane } from "../container/extras";
import type { Header } from "../container/header";
import type { Metadata } from "../container/sections";
import { evaluate, type RulePlane } from "../coordinates/coordinate-rules";
import { coordinatesOf, type Placement, placementOf } from "../coordinates/height-fields";
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
export function gridOf(block: Block, number: number, header: Header, metadata: Metadata): Grid {
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
    const { placement, at } = placed(block, header, metadata);
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

/** Rules of x and y, and the rows and columns of the full grid where those of a block stand. */
function placed(
  block: Block,
  header: Header,
  metadata: Metadata,
): { placement: Placement; at: [Float64Array, Float64Array] } {
  const at: [Float64Array, Float64Array] = [Float64Array.from(block.rows), Float64Array.from(block.columns)];
  const placement = placementOf(metadata);
  if (block.shape.every((length, axis) => length === header.shape[axis as 0 | 1])) return { placement, at };
  const { swapped } = placement;
  const rules = placement.rules.map((rule, channel) =>
    anywhere(rule, header.shape[(channel === 1) !== swapped ? 0 : 1]),
  ) as unknown as Plane;
  const nodes = at.map((line, axis) => Array.from(line, (place) => placement.nodes[axis]?.[place] ?? place));
  return { placement: { rules, swapped, nodes: [nodes[0]!, nodes[1]!] }, at };
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
