/** The chunks of a residual section: one for each channel in each window of each block (docs/format.md, section 9). */
import type { Span } from "../types";
import type { Header } from "./header";

/** A chunk's channel and place: rows and columns, half-open, of a block; whether it is of holes that are kept. */
export interface ChunkPlace {
  readonly channel: number;
  readonly block: number;
  readonly rows: Span;
  readonly columns: Span;
  readonly kept: boolean;
}

/** All chunks in the order of the file: block by block, row by row of windows, channel by channel. */
export function* chunkPlaces(header: Header): Generator<ChunkPlace> {
  const [height, width] = [2 ** header.chunk[0], 2 ** header.chunk[1]];
  for (const [block, { shape }] of header.blocks.entries()) {
    for (const kept of header.masks.kept[block] ? [false, true] : [false]) {
      for (let top = 0; top < shape[0]; top += height) {
        for (let left = 0; left < shape[1]; left += width) {
          const rows: Span = [top, Math.min(top + height, shape[0])];
          const columns: Span = [left, Math.min(left + width, shape[1])];
          for (let channel = 0; channel < header.channels; channel++) yield { channel, block, rows, columns, kept };
        }
      }
    }
  }
}

/** How many windows there are, each with a chunk for every channel; those of kept holes count for themselves. */
export function countWindows(header: Header): number {
  let count = 0;
  for (const [block, { shape }] of header.blocks.entries()) {
    const down = Math.ceil(shape[0] / 2 ** header.chunk[0]);
    const across = Math.ceil(shape[1] / 2 ** header.chunk[1]);
    count += down * across * (header.masks.kept[block] ? 2 : 1);
  }
  return count;
}
