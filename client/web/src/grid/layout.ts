/**
 * Where the levels, bands and tiles of a surface lie (docs/format.md, sections 4 and 5).
 *
 * A surface is coded as one or more *grids*: the patches of its blocks, and the interfaces along which patches meet. The
 * coefficients of one channel of a grid fill an array of the grid's own shape; level l occupies its first rows and
 * columns. A *tile* is a rectangle of all bands of one level over the same part of a grid, or all bands of a level of
 * several small grids; level 0 of all grids is one tile.
 */
import type { Closed, Shape, Span } from "../types";
import { type AxisStep, axisLengths, axisStep } from "./axis";

/** First row, last row, first column, last column. */
export type Sides<T> = readonly [T, T, T, T];

/** Where a side's points come from: the grid of an interface, perhaps backwards; of its end: another interface's end. */
export interface Source {
  readonly grid: number;
  readonly reversed: boolean;
}

/** What is coarsened by itself: a patch of a block, or an interface of one column. */
export interface Grid {
  readonly shape: Shape;
  readonly closed: Closed;
  /** That end of an axis keeps its node as it is. */
  readonly clamped: Sides<boolean>;
  /** The axis is not coarsened further once its length is even. */
  readonly stops: readonly [boolean, boolean];
  /** Where the points of sides come from, as far as the channel is a coordinate. No tile holds those. */
  readonly sources: Sides<Source | null>;
  readonly interface: boolean;
}

/** A tile's part of one band. */
export interface Band {
  /** Whether it holds details along the rows' axis and along the columns' axis; neither only at level 0. */
  readonly kind: readonly [boolean, boolean];
  /** First and past-the-last index in the array of coefficients. */
  readonly rows: Span;
  readonly columns: Span;
  /** Index of the first coefficient within the whole band of its level. */
  readonly origin: readonly [number, number];
  /** Number of the grid in the layout. */
  readonly grid: number;
}

/** A tile: its level, its bands (none empty), its parent's number or -1. */
export interface Tile {
  readonly level: number;
  readonly bands: readonly Band[];
  /** The bands of channels that take nothing from interfaces. */
  readonly whole: readonly Band[];
  readonly parent: number;
}

const NONE: Sides<boolean> = [false, false, false, false];

/** A grid that shares no side. */
export function plainGrid(shape: Shape, closed: Closed): Grid {
  return { shape, closed, clamped: NONE, stops: [false, false], sources: [null, null, null, null], interface: false };
}

/** Where tiles of 2^exponent coefficients begin along an axis of so many nodes, and where the last one ends. */
export function tileBounds(length: number, exponent: number): number[] {
  const size = 1 << exponent;
  const count = Math.max(1, Math.floor((length + size / 2 - 1) / size));
  return [...Array.from({ length: count }, (_, i) => size * i), length];
}

type Bounds = readonly [readonly number[], readonly number[]];

/** Levels, bands and tiles of a surface. */
export class Layout {
  readonly grids: readonly Grid[];
  /** Exponents of two of a tile's rows and columns, in coefficients of one band. */
  readonly tile: readonly [number, number];
  /** Number L of the finest level. */
  readonly levels: number;
  /** Whether any side comes from an interface. */
  readonly shared: boolean;
  readonly #shapes: Shape[][];
  readonly #steps: (readonly [AxisStep, AxisStep])[][];
  #tiles: Tile[] | null = null;
  #starts: number[] = [];

  /** Grids: interfaces first. A surface of one block that shares no side is one grid. */
  constructor(grids: readonly Grid[], tile: readonly [number, number]) {
    this.grids = grids;
    this.tile = tile;
    const lengths = grids.map((grid) =>
      [0, 1].map((axis) => axisLengths(grid.shape[axis]!, grid.closed[axis]!, grid.stops[axis])),
    );
    this.levels = 0;
    for (const own of lengths) for (const axis of own) this.levels = Math.max(this.levels, axis.length - 1);
    this.shared = grids.some((grid) => grid.sources.some((source) => source !== null));
    this.#shapes = lengths.map(([rows, columns]) =>
      Array.from({ length: this.levels + 1 }, (_, level): Shape => {
        const above = this.levels - level;
        return [rows![Math.max(rows!.length - 1 - above, 0)]!, columns![Math.max(columns!.length - 1 - above, 0)]!];
      }),
    );
    this.#steps = grids.map((grid, number) =>
      this.#shapes[number]!.map(([rows, columns]): readonly [AxisStep, AxisStep] => [
        axisStep(rows, grid.closed[0], [grid.clamped[0], grid.clamped[1]], grid.stops[0]),
        axisStep(columns, grid.closed[1], [grid.clamped[2], grid.clamped[3]], grid.stops[1]),
      ]),
    );
  }

  /** Rows and columns of a grid at a level. */
  shape(grid: number, level: number): Shape {
    return this.#shapes[grid]![level]!;
  }

  /** The steps along axis 0 and axis 1 of a grid from a level to the level below. */
  steps(grid: number, level: number): readonly [AxisStep, AxisStep] {
    return this.#steps[grid]![level]!;
  }

  /** All tiles, coarsest level first, then group by group (interfaces first), row by row. */
  get tiles(): readonly Tile[] {
    if (this.#tiles === null) {
      this.#tiles = this.#layTiles();
      this.#starts = Array.from({ length: this.levels + 2 }, () => this.#tiles!.length);
      for (let number = this.#tiles.length - 1; number >= 0; number--)
        this.#starts[this.#tiles[number]!.level] = number;
    }
    return this.#tiles;
  }

  /** Numbers of the tiles of a level: the first, and the one after the last. */
  tilesOf(level: number): Span {
    this.tiles;
    return [this.#starts[level]!, this.#starts[level + 1]!];
  }

  /** The first tile of a level; the number of tiles where there is no such level, as for level 0. */
  tilesFrom(level: number): number {
    return level > 0 && level <= this.levels ? this.tilesOf(level)[0] : this.tiles.length;
  }

  #layTiles(): Tile[] {
    const every = this.grids.map((_, number) => number);
    const tiles: Tile[] = [{ level: 0, ...this.#members(every, 0, null, [0, 0]), parent: -1 }];
    const groups = this.#groups();
    let parents = new Map<number, readonly [number, number, number]>(); // grid: its first tile, tiles down and across
    for (let level = 1; level <= this.levels; level++) {
      const found = new Map<number, readonly [number, number, number]>();
      for (const group of groups[level]!) {
        const first = tiles.length;
        const bounds = this.#bounds(group, level);
        const down = bounds[0].length - 1;
        const across = bounds[1].length - 1;
        const [before, parentsDown, parentsAcross] = parents.get(group[0]!) ?? [0, 1, 1];
        const halves = group.length === 1 ? this.#halves(group[0]!, level) : [0, 0];
        for (let i = 0; i < down; i++) {
          for (let j = 0; j < across; j++) {
            let parent = -1;
            if (level > 1) {
              const row = Math.min(i >> halves[0]!, parentsDown - 1);
              parent = before + row * parentsAcross + Math.min(j >> halves[1]!, parentsAcross - 1);
            }
            tiles.push({ level, ...this.#members(group, level, bounds, [i, j]), parent });
          }
        }
        for (const grid of group) found.set(grid, [first, down, across]);
      }
      parents = found;
    }
    return tiles;
  }

  /** For each level the grids whose tiles are common: all interfaces, and neighbouring patches that are small there. */
  #groups(): number[][][] {
    const most = 4 * 2 ** (this.tile[0] + this.tile[1]); // points of a tile's three bands, and of the nodes under them
    const levels: number[][][] = Array.from({ length: this.levels + 1 }, () => []);
    let groups = this.grids.map((_, number) => [number]);
    for (let level = this.levels; level > 0; level--) {
      const merged: number[][] = [];
      let size = 0;
      for (const group of groups) {
        let points = 0;
        for (const number of group) points += this.shape(number, level)[0] * this.shape(number, level)[1];
        const last = merged.at(-1);
        const isInterface = this.grids[group[0]!]!.interface;
        if (last && this.grids[last[0]!]!.interface === isInterface && (isInterface || size + points <= most)) {
          for (const number of group) last.push(number);
          size += points;
        } else {
          merged.push([...group]);
          size = points;
        }
      }
      groups = merged;
      levels[level] = groups;
    }
    return levels;
  }

  /** For each axis 1 if it steps from the level below to the one below that. */
  #halves(grid: number, level: number): readonly [number, number] {
    if (level < 2) return [0, 0];
    const finer = this.shape(grid, level - 1);
    const coarser = this.shape(grid, level - 2);
    return [Number(finer[0] !== coarser[0]), Number(finer[1] !== coarser[1])];
  }

  #bounds(group: readonly number[], level: number): Bounds {
    const coarse = this.shape(group[0]!, level - 1);
    if (group.length > 1 || this.grids[group[0]!]!.interface) {
      // One tile, of which only the number of bounds matters.
      return [
        [0, coarse[0]],
        [0, coarse[1]],
      ];
    }
    return [tileBounds(coarse[0], this.tile[0]), tileBounds(coarse[1], this.tile[1])];
  }

  /** The tile's bands of coordinates, and of channels that take nothing from interfaces and have none. */
  #members(group: readonly number[], level: number, bounds: Bounds | null, place: readonly [number, number]) {
    const bands: Band[] = [];
    const whole: Band[] = [];
    for (const number of group) {
      const grid = this.grids[number]!;
      const coarse = this.shape(number, Math.max(level - 1, 0));
      const own: Bounds =
        bounds && group.length === 1
          ? bounds
          : [
              [0, coarse[0]],
              [0, coarse[1]],
            ];
      const [first, last, left, right] = grid.sources;
      this.#addBands(bands, number, level, own, place, [first !== null, last !== null, left !== null, right !== null]);
      if (this.shared && !grid.interface) this.#addBands(whole, number, level, own, place, NONE);
    }
    return { bands, whole: this.shared ? whole : bands };
  }

  #addBands(
    found: Band[],
    number: number,
    level: number,
    bounds: Bounds,
    place: readonly [number, number],
    taken: Sides<boolean>,
  ): void {
    const fine = this.shape(number, level);
    const coarse = level ? this.shape(number, level - 1) : fine;
    // Of either axis: its nodes and its details, and where they begin within the whole band.
    const spans = [0, 1].map((axis) => {
      const along = bounds[axis]!;
      const at = place[axis]!;
      const isLast = at === along.length - 2;
      const [start, stop] = [along[at]!, along[at + 1]!];
      const first = start + Number(taken[2 * axis] && at === 0);
      const details = fine[axis]! - coarse[axis]!;
      const from = Math.min(start, details);
      const to = isLast ? details : Math.min(stop, details);
      return [
        { span: [first, stop - Number(taken[2 * axis + 1] && isLast)] as const, origin: first },
        { span: [coarse[axis]! + from, coarse[axis]! + to] as const, origin: from },
      ] as const;
    });
    for (const kind of level ? KINDS : COARSEST) {
      const rows = spans[0]![Number(kind[0]) as 0 | 1];
      const columns = spans[1]![Number(kind[1]) as 0 | 1];
      if (rows.span[1] > rows.span[0] && columns.span[1] > columns.span[0]) {
        const origin = [rows.origin, columns.origin] as const;
        found.push({ kind, rows: rows.span, columns: columns.span, origin, grid: number });
      }
    }
  }
}

const COARSEST = [[false, false]] as const;
const KINDS = [
  [false, true],
  [true, false],
  [true, true],
] as const;
