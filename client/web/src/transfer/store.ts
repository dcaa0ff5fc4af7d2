/** Bytes of one container that have come and are not decoded yet, or are kept by the caller. */

import { RangeSet } from "../planning/ranges";

/** Storage for the bytes of one container. */
export interface Store {
  /** The bytes that are stored. */
  readonly ranges: RangeSet;
  /** Read stored bytes. */
  read(offset: number, length: number): Uint8Array;
  /** Store bytes that are not stored yet. */
  write(offset: number, data: Uint8Array): void;
  /** Called when the decoder has been given these bytes; they are not read again. */
  used(offset: number, length: number): void;
}

/** Bytes in memory; those that are used are forgotten, unless all are to be kept. */
export class MemoryStore implements Store {
  readonly ranges = new RangeSet();
  private pieces: [offset: number, data: Uint8Array][] = [];
  private readonly done = new RangeSet();

  constructor(private readonly keepAll = false) {}

  read(offset: number, length: number): Uint8Array {
    const found = new Uint8Array(length);
    for (const [start, data] of this.pieces) {
      const first = Math.max(start, offset);
      const last = Math.min(start + data.length, offset + length);
      if (first < last) found.set(data.subarray(first - start, last - start), first - offset);
    }
    return found;
  }

  write(offset: number, data: Uint8Array): void {
    this.ranges.add(offset, data.length);
    this.pieces.push([offset, data]);
  }

  used(offset: number, length: number): void {
    if (this.keepAll) return;
    this.done.add(offset, length);
    this.pieces = this.pieces.filter(([at, data]) => !this.done.covers(at, data.length));
  }

  /** Everything that is stored, as [offset, bytes] in the order in which it came. */
  all(): readonly (readonly [offset: number, data: Uint8Array])[] {
    return this.pieces;
  }
}
