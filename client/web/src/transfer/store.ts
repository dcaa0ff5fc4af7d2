/** Bytes of one container that have come and are not decoded yet, or are kept by the caller. */

import { bisectLeft, bisectRight, RangeSet } from "../planning/byte-ranges";

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
  // By where they begin; they do not overlap.
  private readonly starts: number[] = [];
  private readonly slices: Uint8Array[] = [];
  private readonly done = new RangeSet();

  constructor(private readonly keepAll = false) {}

  read(offset: number, length: number): Uint8Array {
    const found = new Uint8Array(length);
    const end = offset + length;
    for (let number = this.before(offset); number < this.starts.length && this.starts[number]! < end; number++) {
      const [start, data] = [this.starts[number]!, this.slices[number]!];
      const first = Math.max(start, offset);
      const last = Math.min(start + data.length, end);
      if (first < last) found.set(data.subarray(first - start, last - start), first - offset);
    }
    return found;
  }

  write(offset: number, data: Uint8Array): void {
    this.ranges.add(offset, data.length);
    const number = bisectRight(this.starts, offset);
    this.starts.splice(number, 0, offset);
    this.slices.splice(number, 0, data);
  }

  used(offset: number, length: number): void {
    if (this.keepAll) return;
    this.done.add(offset, length);
    const first = this.before(offset);
    for (let number = bisectLeft(this.starts, offset + length) - 1; number >= first; number--) {
      if (!this.done.covers(this.starts[number]!, this.slices[number]!.length)) continue;
      this.starts.splice(number, 1);
      this.slices.splice(number, 1);
    }
  }

  /** Everything that is stored, as [offset, bytes] by rising offsets. */
  all(): (readonly [offset: number, data: Uint8Array])[] {
    return this.starts.map((start, number) => [start, this.slices[number]!] as const);
  }

  /** The last slice that begins at an offset or before it; the first one if there is none. */
  private before(offset: number): number {
    return Math.max(bisectRight(this.starts, offset) - 1, 0);
  }
}
