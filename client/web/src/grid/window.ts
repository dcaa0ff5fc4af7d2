/**
 * Windows of a grid: rows and columns, half-open, which along a closed axis may go on across its seam.
 *
 * Along an open axis of N samples a window runs from `start` to before `stop` with 0 <= start < stop <= N. Along a closed
 * one `start` is below N and `stop` at most `start + N`: sample N is sample 0 again. Everything that treats a window of a
 * closed axis unlike others is here.
 */
import { OptionError } from "../errors";
import type { Closed, Region, Shape, Span } from "../types";

/** Refuse a window that a grid does not have: no point, points outside, or a point twice. Throws `OptionError`. */
export function checkRegion(region: Region, shape: Shape, closed: Closed = [false, false]): void {
  for (const axis of [0, 1] as const) {
    const [start, stop] = region[axis];
    const length = shape[axis];
    const crosses = closed[axis] && 0 <= start && start < length;
    if (!(0 <= start && start < stop && stop <= (crosses ? start + length : length))) {
      const name = axis ? "columns" : "rows";
      const seam = crosses ? `, or across the seam up to ${start}:${start + length}` : "";
      throw new OptionError(`expected ${name} within 0:${length}${seam}, at least one, got ${start}:${stop}`);
    }
  }
}

/** The parts of a window along an axis that do not cross the seam, in the window's order: one or two. */
export function spansOf([start, stop]: Span, length: number): Span[] {
  if (stop <= length) return [[start, stop]];
  return [
    [start, length],
    [0, stop - length],
  ];
}

/** The samples of an axis in a window, in the window's order. */
export function placesOf([start, stop]: Span, length: number): Int32Array {
  return Int32Array.from({ length: stop - start }, (_, i) => (start + i) % length);
}

/** Which samples of an axis are in a window: 1 or 0 for each. */
export function samplesOf(span: Span, length: number): Uint8Array {
  const inside = new Uint8Array(length);
  for (const part of spansOf(span, length)) inside.fill(1, ...part);
  return inside;
}

/** Whether a window has samples of a part of the axis, which does not cross the seam. */
export function meets(span: Span, part: Span, length: number): boolean {
  return spansOf(span, length).some(([start, stop]) => start < part[1] && part[0] < stop);
}

/** Whether all points of a window are in another one of the same grid. */
export function contains(outer: Region, inner: Region, shape: Shape): boolean {
  return ([0, 1] as const).every((axis) => {
    const [[first, last], [start, stop], length] = [outer[axis], inner[axis], shape[axis]];
    const offset = (start - first + length) % length;
    return last - first >= length || offset + stop - start <= last - first;
  });
}

/** The smallest window around another one that is made of whole cells of so many rows and columns. */
export function aligned(region: Region, shape: Shape, sizes: readonly [number, number]): Region {
  const [rows, columns] = ([0, 1] as const).map((axis): Span => {
    const [[start, stop], length, size] = [region[axis], shape[axis], sizes[axis]];
    const begin = Math.floor(start / size) * size;
    const turn = stop > length ? length : 0;
    const end = turn + Math.min(Math.ceil((stop - turn) / size) * size, length);
    return end - begin >= length ? [0, length] : [begin, end];
  });
  return [rows!, columns!];
}

/**
 * The window of a coarser grid that has the points of it that stand in a window of this one, which is of `shape`; null
 * where none does. `nodes` are the rows and the columns of this grid at which those of the coarser one stand, increasing.
 */
export function among(region: Region, shape: Shape, nodes: readonly [Int32Array, Int32Array]): Region | null {
  const found: Span[] = [];
  for (const axis of [0, 1] as const) {
    const line = nodes[axis];
    const parts = spansOf(region[axis], shape[axis]).map((part) => part.map((end) => firstFrom(line, end)));
    const count = parts.reduce((sum, [start, stop]) => sum + stop! - start!, 0);
    if (!count) return null;
    const start = parts[0]![0]! % line.length; // the first one may stand beyond the seam
    found.push([start, start + count]);
  }
  return [found[0]!, found[1]!];
}

/** The number of the first of increasing places that is not before a place. */
function firstFrom(line: Int32Array, place: number): number {
  const number = line.findIndex((node) => node >= place);
  return number < 0 ? line.length : number;
}

/** The smallest window around another one that crosses no seam: all of an axis along which that one does. */
export function hullOf(region: Region, shape: Shape): Region {
  const [rows, columns] = ([0, 1] as const).map((axis): Span => {
    return region[axis][1] <= shape[axis] ? region[axis] : [0, shape[axis]];
  });
  return [rows!, columns!];
}
