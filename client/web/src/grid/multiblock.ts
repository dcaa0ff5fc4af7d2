/**
 * The grids of a surface of several blocks: interfaces along which patches meet, and patches of blocks (docs/format.md,
 * section 3.1).
 */
import type { Closed, Shape, Span } from "../types";
import type { Grid, Sides, Source } from "./layout";

/** A side of a patch that is an interface; `reversed`: the patch's order along the side runs against the interface's. */
export interface Side {
  readonly interface: number;
  readonly reversed: boolean;
}

/** What is coded as one grid: a window of a block, perhaps turned round. */
export interface Patch {
  /** Number of its block. */
  readonly block: number;
  /** First and past-the-last index in the block; along a closed axis they count modulo its length. */
  readonly rows: Span;
  readonly columns: Span;
  readonly closed: Closed;
  /** Stored back to front along that axis. */
  readonly flipped: readonly [boolean, boolean];
  readonly sides: Sides<Side | null>;
  readonly clamped: Sides<boolean>;
  readonly stops: readonly [boolean, boolean];
}

/** Points that are a side of patches. */
export interface Interface {
  readonly length: number;
  readonly closed: boolean;
  readonly stops: boolean;
}

/** Patches of all blocks, and the interfaces that they share. */
export interface Arrangement {
  readonly patches: readonly Patch[];
  readonly interfaces: readonly Interface[];
}

/** A block as its only patch, which shares no side. */
export function wholePatch(block: number, shape: Shape, closed: Closed): Patch {
  return {
    block,
    rows: [0, shape[0]],
    columns: [0, shape[1]],
    closed,
    flipped: [false, false],
    sides: [null, null, null, null],
    clamped: [false, false, false, false],
    stops: [false, false],
  };
}

/** The grids of an arrangement: interfaces first, then patches. */
export function gridsOf(arrangement: Arrangement): Grid[] {
  const owners = ownersOf(arrangement);
  const interfaces = arrangement.interfaces.map((own, number): Grid => {
    const ends: (Source | null)[] = [0, 1].map((end) => {
      const owner = owners.get(2 * number + end) ?? 2 * number + end;
      const ownerInterface = owner >> 1;
      const ownerEnd = owner & 1;
      const elsewhere = ownerInterface !== number || (ownerEnd !== end && own.length > 1);
      return elsewhere ? { grid: ownerInterface, reversed: ownerEnd === 1 } : null;
    });
    return {
      shape: [own.length, 1],
      closed: [own.closed, false],
      clamped: [!own.closed, !own.closed, false, false],
      stops: [own.stops, false],
      sources: [ends[0]!, own.length === 1 ? null : ends[1]!, null, null],
      interface: true,
    };
  });
  const patches = arrangement.patches.map((patch): Grid => {
    const source = (side: Side | null): Source | null => side && { grid: side.interface, reversed: side.reversed };
    const [first, last, left, right] = patch.sides;
    return {
      shape: [patch.rows[1] - patch.rows[0], patch.columns[1] - patch.columns[0]],
      closed: patch.closed,
      clamped: patch.clamped,
      stops: patch.stops,
      sources: [source(first), source(last), source(left), source(right)],
      interface: false,
    };
  });
  return [...interfaces, ...patches];
}

/** For every end of an interface the first end that is the same point; ends are 2 number, and 2 number + 1 (the last). */
function ownersOf(arrangement: Arrangement): Map<number, number> {
  const parent = new Map<number, number>();
  const find = (end: number): number => {
    for (;;) {
      const above = parent.get(end) ?? end;
      if (above === end) return end;
      end = above;
    }
  };
  const endOf = (side: Side, last: number): number => {
    const pole = arrangement.interfaces[side.interface]!.length === 1;
    return 2 * side.interface + (pole ? 0 : last ^ Number(side.reversed));
  };
  for (const patch of arrangement.patches) {
    if (patch.closed[0] || patch.closed[1]) continue;
    for (const row of [0, 1]) {
      for (const column of [0, 1]) {
        const along = patch.sides[row];
        const across = patch.sides[2 + column];
        if (!along || !across) continue;
        const one = find(endOf(along, column));
        const other = find(endOf(across, row));
        parent.set(Math.max(one, other), Math.min(one, other));
      }
    }
  }
  return new Map([...parent.keys()].map((end) => [end, find(end)]));
}

type Cells = readonly [rows: Span, columns: Span];

/** Whether patches of a block cover each of its cells once; along a closed axis the last cells wrap. */
export function covers(shape: Shape, closed: Closed, patches: readonly Patch[]): boolean {
  const cells: Cells[] = [];
  for (const patch of patches) {
    for (const rows of cellsAlong(shape[0], closed[0], patch.closed[0], patch.rows)) {
      for (const columns of cellsAlong(shape[1], closed[1], patch.closed[1], patch.columns))
        cells.push([rows, columns]);
    }
  }
  const whole = [0, 1].map((axis) => (closed[axis] ? shape[axis]! : Math.max(shape[axis]! - 1, 1)));
  let area = 0;
  for (const [rows, columns] of cells) area += (rows[1] - rows[0]) * (columns[1] - columns[0]);
  return area === whole[0]! * whole[1]! && !overlap(cells);
}

/** First and past-the-last cell along an axis, as one span or two. */
function cellsAlong(length: number, wraps: boolean, closed: boolean, window: Span): Span[] {
  if (closed) return [[0, length]];
  const start = window[0];
  const stop = Math.max(window[1] - 1, window[0] + 1);
  if (!wraps || stop <= length) return [[start, stop]];
  return [
    [start, length],
    [0, stop - length],
  ];
}

/**
 * Whether any two rectangles have a cell in common.
 *
 * Row after row the columns that are taken are kept in order, so that each is compared with two others: there may be
 * tens of thousands.
 */
function overlap(cells: Cells[]): boolean {
  const sorted = [...cells].sort((a, b) => a[0][0] - b[0][0] || a[0][1] - b[0][1] || a[1][0] - b[1][0]);
  const byEnd = [...sorted].sort((a, b) => a[0][1] - b[0][1]);
  const taken: Span[] = [];
  let ended = 0;
  for (const [rows, columns] of sorted) {
    for (; ended < byEnd.length && byEnd[ended]![0][1] <= rows[0]; ended++) {
      // A rectangle that ends here began before, so it is there.
      taken.splice(placeOf(taken, byEnd[ended]![1][0]), 1);
    }
    const place = placeOf(taken, columns[0]);
    const [before, after] = [taken[place - 1], taken[place]];
    if ((after && after[0] < columns[1]) || (before && before[1] > columns[0])) return true;
    taken.splice(place, 0, columns);
  }
  return false;
}

/** Where a span that begins here stands, or would stand, among spans in order. */
function placeOf(taken: readonly Span[], start: number): number {
  let low = 0;
  let high = taken.length;
  while (low < high) {
    const middle = (low + high) >> 1;
    if (taken[middle]![0] < start) low = middle + 1;
    else high = middle;
  }
  return low;
}
