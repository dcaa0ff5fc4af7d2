/** Heights of a container anywhere on the Earth, from the level that their distance needs: as `lodestream.maps` has them. */

import type { Metadata } from "../container/sections";
import { InputError, OptionError } from "../errors";
import type { Region, Shape, Span } from "../types";
import type { BlockCache } from "./block-cache";
import { BLOCK, Blocks } from "./blocks";
import { Container, type Source } from "./container";
import { between, modulo } from "./grid-places";
import { Placement } from "./placement";
import type { ForeignTransform } from "./projection";
import type { TileGrid } from "./tile-grid";

/** Nodes of a level that a tile may take; a tile beside a pole of Web Mercator would take more of the level of its row. */
const MOST_NODES = 1 << 21;

/** What a valid node weighs less than counts as a hole. */
const LEAST_WEIGHT = Math.fround(0.5 - 1e-6);

/** Metres of the units in which files tell heights. */
const UNITS = new Map(
  (
    [
      [1, "m metre metres meter meters"],
      [0.3048, "ft foot feet"],
      [1200 / 3937, "ftus us-ft foot_us sfoot us_survey_foot us_survey_feet"],
      [1000, "km kilometre kilometres kilometer kilometers"],
      [0.1, "dm decimetre decimeter"],
      [0.01, "cm centimetre centimetres centimeter centimeters"],
      [0.001, "mm millimetre millimetres millimeter millimeters"],
      [1.8288, "fathom fathoms"],
    ] as const
  ).flatMap(([metres, names]) => names.split(" ").map((name) => [name, metres] as const)),
);

/** Heights of a container in some unit. */
export interface FieldSource extends Source {
  /** Metres upwards of one unit of the heights, such as -1 for depths; undefined: as CRS or metadata say. */
  readonly scale?: number | undefined;
}

/** What fields share. */
export interface FieldOptions {
  /** For CRS that are not built in. */
  readonly foreign: ForeignTransform;
  readonly cache: BlockCache;
  /** Of this field in the cache. */
  readonly name: string;
  /** In place of the platform's own. */
  readonly fetch?: typeof globalThis.fetch | undefined;
}

/** A container of heights with a CRS, which is read and decoded block by block as heights are asked for. */
export class HeightField {
  private readonly blocks: Blocks;

  private constructor(
    private readonly container: Container,
    readonly placement: Placement,
    private readonly metres: Metres,
    name: string,
    cache: BlockCache,
  ) {
    const shapeOf = (level: number): Shape => {
      const [rows, columns] = container.nodes(level);
      return [rows.length, columns.length];
    };
    this.blocks = new Blocks(name, cache, shapeOf, (level, window, signal) => this.read(level, window, signal));
  }

  /**
   * Open a container.
   *
   * @throws InputError if it has no heights, no CRS or no position, or its unit is none of length.
   * @throws LodestreamError if it cannot be had, or is damaged.
   */
  static async open(source: FieldSource, { foreign, name, cache, fetch }: FieldOptions): Promise<HeightField> {
    const container = await Container.open(source, fetch);
    const placement = await Placement.of(container.metadata, container.header, foreign);
    const metres = metresOf(container.metadata, placement.vertical, source.scale);
    return new HeightField(container, placement, metres, name, cache);
  }

  /** Of the surface; empty if it has none. */
  get name(): string {
    return String(this.container.metadata.name ?? "");
  }

  /** Where the container was found. */
  get url(): string {
    return this.container.url;
  }

  /**
   * Heights at the pixels of a tile, (row, column), in metres upwards, bilinear between the nodes of the coarsest level
   * whose nodes are no further apart; NaN in holes and outside the field.
   *
   * @throws LodestreamError if the container cannot be had any more, or is damaged; or the reason of the signal.
   */
  async heights({ longitudes, latitudes, metres }: TileGrid, signal: AbortSignal): Promise<Float32Array> {
    const [rows, columns] = await this.placement.places(longitudes, latitudes);
    const heights = new Float32Array(rows.length).fill(Number.NaN);
    const inside = Int32Array.from(rows.keys()).filter((i) => Number.isFinite(rows[i]!));
    if (inside.length === 0) return heights;
    for (let level = this.levelFor(metres); ; level--) {
      const down = this.atLevel(level, 0, inside, rows);
      const across = this.atLevel(level, 1, inside, columns);
      const spans: Region = [spanOf(down), spanOf(across)];
      const [[top, bottom], [left, right]] = spans;
      if ((bottom - top) * (right - left) > MOST_NODES && level > 0) continue;
      const canvas = await this.canvas(level, spans, signal);
      const sampled = bilinear(canvas, right - left, down, top, across, left);
      inside.forEach((place, i) => {
        heights[place] = sampled[i]!;
      });
      return heights;
    }
  }

  private levelFor(metres: number): number {
    const steps = Math.floor(Math.log2(Math.max(metres / this.placement.cell, 1)) + 1e-6);
    return Math.max(this.container.header.levels - steps, 0);
  }

  /** Rows or columns of the full grid as ones of a level, whose nodes may be uneven. */
  private atLevel(level: number, axis: 0 | 1, inside: Int32Array, all: Float64Array): Float64Array {
    const { header } = this.container;
    const nodes = this.container.nodes(level)[axis];
    const length = header.shape[axis];
    const count = nodes.length;
    const numbers = Float64Array.from({ length: count + 1 }, (_, i) => i);
    if (header.closed[axis]) {
      const line = Float64Array.of(...nodes, nodes[0]! + length);
      return Float64Array.from(inside, (i) => {
        const place = all[i]!;
        if (count === length) return place;
        const turns = Math.floor(place / length);
        return between(place - turns * length, line, numbers) + turns * count;
      });
    }
    return Float64Array.from(inside, (i) => {
      const place = all[i]!;
      return Math.min(Math.max(count === length ? place : between(place, nodes, numbers), 0), count - 1);
    });
  }

  /** Heights of a level at spans of its rows and columns, which go on around closed axes, and repeat the last node of others. */
  private async canvas(level: number, spans: Region, signal: AbortSignal): Promise<Float32Array> {
    const { closed } = this.container.header;
    const shape = this.container.nodes(level).map(({ length }) => length);
    const [rows, columns] = ([0, 1] as const).map((axis) => {
      const [start, stop] = spans[axis];
      const count = shape[axis]!;
      return Int32Array.from({ length: stop - start }, (_, i) =>
        closed[axis] ? modulo(start + i, count) : Math.min(start + i, count - 1),
      );
    }) as [Int32Array, Int32Array];
    const [down, across] = [rows, columns].map((line) => [...new Set(line.map((at) => Math.floor(at / BLOCK)))]);
    const places = down!.flatMap((row) => across!.map((column) => [row, column] as const));
    const blocks = await this.blocks.get(level, places, signal);
    const canvas = new Float32Array(rows.length * columns.length);
    let next = 0;
    for (const row of rows) {
      const first = down!.indexOf(Math.floor(row / BLOCK)) * across!.length;
      for (const column of columns) {
        const number = Math.floor(column / BLOCK);
        const width = Math.min(BLOCK, shape[1]! - number * BLOCK);
        canvas[next++] = blocks[first + across!.indexOf(number)]![(row % BLOCK) * width + (column % BLOCK)]!;
      }
    }
    return canvas;
  }

  private async read(level: number, window: Region, signal: AbortSignal): Promise<Float32Array> {
    const stored = await this.container.heights(level, window, signal);
    const { times, plus } = this.metres;
    return Float32Array.from(stored, (value) => {
      const height = value * times + plus;
      return Number.isFinite(height) ? height : Number.NaN;
    });
  }
}

/** What a number of the container is multiplied with, and what is then added, for metres upwards. */
interface Metres {
  readonly times: number;
  readonly plus: number;
}

function metresOf(metadata: Metadata, vertical: number | undefined, scale: number | undefined): Metres {
  if (scale !== undefined && !(Number.isFinite(scale) && scale !== 0)) {
    throw new OptionError(`expected a scale that is not 0, such as -1 for depths, got ${scale}`);
  }
  const unit = String(metadata.unit || "m").trim();
  const factor = scale ?? vertical ?? UNITS.get(unit.toLowerCase().replaceAll(" ", "_"));
  if (factor === undefined) {
    throw new InputError(
      `expected heights in metres or feet, got the unit ${JSON.stringify(unit.slice(0, 40))}: say what it is by scale=`,
    );
  }
  const [times, plus] = [metadata.scale ?? 1, metadata.offset ?? 0].map(Number) as [number, number];
  if (!(Number.isFinite(times) && Number.isFinite(plus))) {
    throw new InputError("expected numbers as scale and offset in the metadata, got others");
  }
  return { times: times * factor, plus: plus * factor };
}

/** The nodes around places along an axis. */
function spanOf(places: Float64Array): Span {
  let [least, most] = [Number.POSITIVE_INFINITY, Number.NEGATIVE_INFINITY];
  for (const place of places) [least, most] = [Math.min(least, place), Math.max(most, place)];
  return [Math.floor(least), Math.floor(most) + 2];
}

/**
 * Heights between the nodes of a canvas, at rows and columns that count from `top` and `left`, in the arithmetic of float32.
 * Holes weigh nothing; where valid nodes weigh less than half, there is a hole.
 */
function bilinear(
  canvas: Float32Array,
  width: number,
  rows: Float64Array,
  top: number,
  columns: Float64Array,
  left: number,
): Float32Array {
  const f = Math.fround;
  const isWhole = canvas.every(Number.isFinite);
  const found = new Float32Array(rows.length);
  for (let i = 0; i < rows.length; i++) {
    const [at, along] = [rows[i]! - top, columns[i]! - left];
    const [row, column] = [Math.floor(at), Math.floor(along)];
    const [down, across] = [f(at - row), f(along - column)];
    const first = row * width + column;
    const [a, b, c, d] = [canvas[first]!, canvas[first + 1]!, canvas[first + width]!, canvas[first + width + 1]!];
    if (isWhole) {
      const above = f(a + f(f(b - a) * across));
      const below = f(c + f(f(d - c) * across));
      found[i] = above + f(f(below - above) * down);
      continue;
    }
    const [up, back] = [f(1 - down), f(1 - across)];
    const shares = [f(up * back), f(up * across), f(down * back), f(down * across)];
    let [total, weight] = [0, 0];
    [a, b, c, d].forEach((height, k) => {
      if (!Number.isFinite(height)) return;
      total = f(total + f(height * shares[k]!));
      weight = f(weight + shares[k]!);
    });
    found[i] = weight >= LEAST_WEIGHT ? total / Math.max(weight, f(1e-9)) : Number.NaN;
  }
  return found;
}
