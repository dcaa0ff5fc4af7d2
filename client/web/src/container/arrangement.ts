/** The part of a header that says how blocks are cut into patches and interfaces (docs/format.md, section 3.1). */
import { CorruptStreamError } from "../errors";
import { type Arrangement, covers, type Interface, type Patch, type Side } from "../grid/multiblock";
import type { Closed, Shape, Span } from "../types";
import { type FieldReader, LARGEST } from "./fields";
import { checkCount, LIMITS } from "./limits";

/** A block's rows and columns, and which of its axes wrap. */
export interface BlockShape {
  readonly shape: Shape;
  readonly closed: Closed;
}

/** Blocks, interfaces and patches; checks that patches cover the blocks and fit their interfaces. */
export function parseArrangement(fields: FieldReader): { blocks: BlockShape[]; arrangement: Arrangement } {
  const start = fields.at;
  const blocks: BlockShape[] = [];
  let points = 0;
  for (let left = countOf(fields, "blocks", 1); left > 0; left--) {
    const shape: Shape = [fields.varint(), fields.varint()];
    const flags = fields.byte();
    points += shape[0] * shape[1];
    if (shape[0] * shape[1] < 2 || points > LARGEST || flags > 3) {
      throw new CorruptStreamError(`expected blocks of points, got ${shape[0]} x ${shape[1]}`, start);
    }
    blocks.push({ shape, closed: [(flags & 1) !== 0, (flags & 2) !== 0] });
  }
  const interfaces: Interface[] = [];
  for (let left = countOf(fields, "interfaces", 0); left > 0; left--) {
    const number = fields.varint();
    interfaces.push({ length: Math.floor(number / 4), closed: number % 2 === 1, stops: number % 4 >= 2 });
  }
  const patches: Patch[] = [];
  for (let left = countOf(fields, "patches", 1); left > 0; left--) {
    patches.push(parsePatch(fields, blocks, interfaces));
  }
  const used = new Set(patches.flatMap((patch) => patch.sides.flatMap((side) => (side ? [side.interface] : []))));
  if (used.size !== interfaces.length) {
    const others = interfaces.length - used.size;
    throw new CorruptStreamError(`expected interfaces that are sides of patches, got ${others} others`, start);
  }
  const own: Patch[][] = blocks.map(() => []);
  for (const patch of patches) own[patch.block]!.push(patch);
  blocks.forEach(({ shape, closed }, number) => {
    if (!covers(shape, closed, own[number]!)) {
      throw new CorruptStreamError(`expected patches that cover block ${number} once, got others`, start);
    }
  });
  return { blocks, arrangement: { patches, interfaces } };
}

function countOf(fields: FieldReader, what: "blocks" | "interfaces" | "patches", least: number): number {
  const start = fields.at;
  const count = fields.varint();
  checkCount(count, LIMITS[what], what, start);
  // Each takes a byte at least: nothing is made that was not sent.
  if (count < least || count > fields.data.length) {
    throw new CorruptStreamError(`expected ${least} to ${fields.data.length} ${what}, got ${count}`, start);
  }
  return count;
}

function parsePatch(fields: FieldReader, blocks: readonly BlockShape[], interfaces: readonly Interface[]): Patch {
  const start = fields.at;
  const block = fields.varint(blocks.length - 1);
  const flags = fields.byte();
  const ends = fields.byte();
  const { shape, closed: whole } = blocks[block]!;
  const spans = ([0, 1] as const).map((axis): Span => {
    if (!(flags & 64)) return [0, shape[axis]];
    const first = fields.varint(shape[axis] - 1);
    // Along an axis that wraps, a window may go on from the last sample to the first, and to that one again.
    return [first, first + fields.varint(whole[axis] ? shape[axis] + 1 : shape[axis] - first)];
  });
  const [rows, columns] = spans as [Span, Span];
  const closed: Closed = [(flags & 1) !== 0, (flags & 2) !== 0];
  const lengths = [columns[1] - columns[0], rows[1] - rows[0]] as const;
  const stops = [(flags & 16) !== 0, (flags & 32) !== 0] as const;
  const sides = ([0, 1, 2, 3] as const).map((number): Side | null => {
    if (!(ends & (16 << number))) return null;
    const value = fields.varint(2 * LIMITS.interfaces);
    const side = { interface: value >> 1, reversed: value % 2 === 1 };
    const along = number < 2 ? 1 : 0;
    const shared = interfaces[side.interface];
    const length = lengths[number < 2 ? 0 : 1];
    const pole = shared?.length === 1;
    const same = shared?.length === length && shared.closed === closed[along] && shared.stops === stops[along];
    if (!(pole || same) || closed[1 - along] || !(ends & (1 << number))) {
      const got = shared ? `one of ${shared.length}` : "none";
      throw new CorruptStreamError(`expected an interface of ${length} points at a clamped side, got ${got}`, start);
    }
    return side;
  });
  const [top, bottom, left, right] = sides as [Side | null, Side | null, Side | null, Side | null];
  const wraps = [whole[0] && lengths[1] === shape[0], whole[1] && lengths[0] === shape[1]];
  if (flags > 127 || Math.min(...lengths) < 1 || (closed[0] && !wraps[0]) || (closed[1] && !wraps[1])) {
    throw new CorruptStreamError(`expected a patch of a block of ${shape[0]} x ${shape[1]}, got another`, start);
  }
  return {
    block,
    rows,
    columns,
    closed,
    flipped: [(flags & 4) !== 0, (flags & 8) !== 0],
    sides: [top, bottom, left, right],
    clamped: [(ends & 1) !== 0, (ends & 2) !== 0, (ends & 4) !== 0, (ends & 8) !== 0],
    stops,
  };
}
