/** Masks of holes, decoded (docs/format.md, sections 3.3 and 7.5). */
import type { Header } from "../container/header";
import { CorruptStreamError } from "../errors";
import type { Arena } from "../kernels/arena";
import { accepted } from "../kernels/instance";
import type { Shape } from "../types";

/** Points outside the mask that contexts see: above, and at either side. */
const [ABOVE, BESIDE] = [2, 2];
/** Points of a row that are coded together. */
const GROUP = 16;
const MODEL = (1 << 10) + 4;

/** For each block which points are valid: (rows, columns), 1 or 0; null: all. */
export type BlockMasks = readonly (Uint8Array | null)[];

/** A mask from its bytes; `offset` is for the error where bytes are left over. Bytes missing count as 0. */
export function decodeMask(arena: Arena, data: Uint8Array, [rows, columns]: Shape, offset: number): Uint8Array {
  return arena.scope(() => {
    const width = columns + 2 * BESIDE;
    const count = (rows + ABOVE) * width;
    const field = arena.zeros(count);
    const model = arena.take(4 * MODEL);
    const bytes = arena.put(data);
    const state = arena.zeros(4 * 8);
    const groups = rows * Math.ceil(columns / GROUP);
    const result = arena.kernels.mask(rows, columns, 0, groups, field, count, model, bytes, data.length, state);
    const read = accepted(result, "mask");
    if (data.length > read) {
      throw new CorruptStreamError(`expected a mask of at most ${read} bytes, got ${data.length}`, offset + read);
    }
    const mask = new Uint8Array(rows * columns);
    const decoded = arena.u8(field, count);
    for (let row = 0; row < rows; row++) {
      const start = (row + ABOVE) * width + BESIDE;
      mask.set(decoded.subarray(start, start + columns), row * columns);
    }
    return mask;
  });
}

/** For each block which points are valid. */
export function decodeMasks(arena: Arena, header: Header): BlockMasks {
  return header.blocks.map(({ shape }, block) => {
    const data = header.masks.coded[block];
    return data?.length ? decodeMask(arena, data, shape, header.length) : null;
  });
}

/** For each block which holes have values that come back. Throws where these are not so many holes. */
export function decodeKept(arena: Arena, header: Header, masks: BlockMasks): BlockMasks {
  return header.blocks.map(({ shape }, block) => {
    const mask = masks[block];
    const count = header.masks.kept[block];
    if (!mask || !count) return null;
    const data = header.masks.keptCoded[block]!;
    const kept = data.length ? decodeMask(arena, data, shape, header.length) : mask.map((valid) => 1 - valid);
    let [all, holes] = [0, 0];
    for (let i = 0; i < kept.length; i++) {
      all += kept[i]!;
      if (kept[i] && !mask[i]) holes++;
    }
    if (all !== holes || holes !== count) {
      throw new CorruptStreamError(`expected ${count} holes that are kept, got ${holes}`, header.length);
    }
    return kept;
  });
}
