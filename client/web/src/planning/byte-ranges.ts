/** Sets of byte ranges of a file: which bytes of a container are cached, and which are missing. */

/** Bytes `offset` to `offset + length` of a file. */
export type Place = readonly [offset: number, length: number];

/** A set of bytes as sorted ranges that neither overlap nor touch; iteration gives [offset, length]. */
export class RangeSet implements Iterable<Place> {
  private starts: number[] = [];
  private ends: number[] = [];

  /** The ranges may come in any order and overlap; empty ones are ignored. */
  constructor(ranges: Iterable<Place> = []) {
    const sorted = [...ranges].sort((a, b) => a[0] - b[0]);
    for (const [offset, length] of sorted) {
      if (length <= 0) continue;
      // In order, so that nothing is searched for or moved.
      const last = this.ends.length - 1;
      if (last >= 0 && offset <= this.ends[last]!) {
        this.ends[last] = Math.max(this.ends[last]!, offset + length);
      } else {
        this.starts.push(offset);
        this.ends.push(offset + length);
      }
    }
  }

  /** Add bytes; some or all of them may be in the set already. */
  add(offset: number, length: number): void {
    if (length <= 0) return;
    let start = offset;
    let end = offset + length;
    const first = bisectLeft(this.ends, start);
    const last = bisectRight(this.starts, end);
    if (first < last) {
      start = Math.min(start, this.starts[first]!);
      end = Math.max(end, this.ends[last - 1]!);
    }
    this.starts.splice(first, last - first, start);
    this.ends.splice(first, last - first, end);
  }

  /** Number of bytes from `offset` on that are in the set without a gap. */
  run(offset: number): number {
    const number = bisectRight(this.starts, offset) - 1;
    return number >= 0 ? Math.max(this.ends[number]! - offset, 0) : 0;
  }

  /** The parts of a range that are not in the set, in order. */
  *missing(offset: number, length: number): Generator<Place> {
    let position = offset;
    const end = offset + length;
    let number = bisectRight(this.ends, position);
    while (position < end) {
      const start = this.starts[number] ?? end;
      if (position < start) yield [position, Math.min(start, end) - position];
      if (start >= end) return;
      position = this.ends[number]!;
      number += 1;
    }
  }

  /** The parts of a range that are in the set, in order. */
  *overlap(offset: number, length: number): Generator<Place> {
    let position = offset;
    for (const [start, size] of this.missing(offset, length)) {
      if (position < start) yield [position, start - position];
      position = start + size;
    }
    if (position < offset + length) yield [position, offset + length - position];
  }

  /** Whether a whole range is in the set. */
  covers(offset: number, length: number): boolean {
    return this.run(offset) >= length;
  }

  /** Number of bytes in the set. */
  get total(): number {
    let sum = 0;
    for (let number = 0; number < this.ends.length; number++) sum += this.ends[number]! - this.starts[number]!;
    return sum;
  }

  /** The offset after the last byte; 0 for an empty set. */
  get end(): number {
    return this.ends[this.ends.length - 1] ?? 0;
  }

  /** Number of ranges. */
  get size(): number {
    return this.starts.length;
  }

  /** A copy that can change independently. */
  copy(): RangeSet {
    const made = new RangeSet();
    made.starts = this.starts.slice();
    made.ends = this.ends.slice();
    return made;
  }

  *[Symbol.iterator](): Generator<Place> {
    for (let number = 0; number < this.starts.length; number++) {
      yield [this.starts[number]!, this.ends[number]! - this.starts[number]!];
    }
  }
}

/** The first place of a sorted array whose value is not less than `value`. */
export function bisectLeft(sorted: ArrayLike<number>, value: number): number {
  let low = 0;
  let high = sorted.length;
  while (low < high) {
    const middle = (low + high) >>> 1;
    if (sorted[middle]! < value) low = middle + 1;
    else high = middle;
  }
  return low;
}

/** The first place of a sorted array whose value is greater than `value`. */
export function bisectRight(sorted: ArrayLike<number>, value: number): number {
  let low = 0;
  let high = sorted.length;
  while (low < high) {
    const middle = (low + high) >>> 1;
    if (sorted[middle]! <= value) low = middle + 1;
    else high = middle;
  }
  return low;
}
