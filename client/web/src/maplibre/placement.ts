/** Where a height field lies on the Earth: places of the grid at longitudes and latitudes, bounds, cells, zooms. */

import type { Header } from "../container/header";
import type { Metadata } from "../container/sections";
import { InputError } from "../errors";
import { GridPlaces, modulo, type Pair } from "./grid-places";
import { EARTH_RADIUS, type ForeignTransform, type Projection, projectionOf } from "./projection";
import { type Box, FINEST_ZOOM, LATITUDE_LIMIT } from "./tile-grid";

/** Rows and columns of the full grid at which bounds are looked for. */
const SAMPLES = 129;

/** A gap of more degrees between longitudes is outside the field; between samples around the Earth there are fewer. */
const GAP = 6;

/** Beyond this latitude the meridians are too close for bounds from samples, unless they are the columns of the field. */
const POLAR = 85;

/** How far bounds from samples may be off, in parts of their extent. */
const INEXACT = 1e-3;

/**
 * At most so many positions along each axis of a tile are projected; those between lie on straight lines. Over a 64th of a
 * tile, that is 0.05 pixels of zoom 0, and less at every other.
 */
const POSITIONS = 67;

/** A step between neighbouring positions that is so many times the usual one is a seam of the projection. */
const SEAM = 16;

/** The rules of a grid's coordinates, and their CRS. */
export class Placement {
  private constructor(
    private readonly projection: Projection,
    private readonly grid: GridPlaces,
    readonly bounds: Box,
    /** Metres from node to node in the middle of the field; along the axis where they are closer. */
    readonly cell: number,
  ) {}

  /**
   * Place the heights of a container.
   *
   * @throws InputError if they lack a CRS or a position, or it is not on the Earth.
   */
  static async of(metadata: Metadata, header: Header, foreign: ForeignTransform): Promise<Placement> {
    const { crs } = metadata;
    if (typeof crs !== "string" || crs === "") {
      throw new InputError("expected heights with a CRS, got none: encode with --crs, such as EPSG:32611");
    }
    const projection = projectionOf(crs, foreign);
    const grid = new GridPlaces(metadata, header.plane, header.shape, header.closed, projection.turn);
    return new Placement(projection, grid, await boundsOf(projection, grid), await cellOf(projection, grid));
  }

  /** Metres upwards of one unit of the heights, where the CRS says so. */
  get vertical(): number | undefined {
    return this.projection.vertical;
  }

  /** The first zoom whose pixels, `size` along an edge of a tile, are no larger than the cells; a little larger will do. */
  webZoom(size: number): number {
    const latitude = Math.min(Math.abs((this.bounds[1] + this.bounds[3]) / 2), LATITUDE_LIMIT);
    const cosine = Math.cos((latitude * Math.PI) / 180);
    const ratio = (2 * Math.PI * EARTH_RADIUS * cosine) / size / this.cell;
    return Math.min(Math.max(Math.ceil(Math.log2(ratio) - 1e-6), 0), FINEST_ZOOM - 1);
  }

  /**
   * The rows and columns of the grid at a grid of places on the Earth, (latitude, longitude) in C order; NaN where the
   * field is not. Along closed axes they are continuous, so they may be of any turn.
   */
  async places(longitudes: Float64Array, latitudes: Float64Array): Promise<Pair> {
    const width = longitudes.length;
    const found: Pair = [
      new Float64Array(latitudes.length * width).fill(Number.NaN),
      new Float64Array(latitudes.length * width).fill(Number.NaN),
    ];
    const [up, across] = this.near(longitudes, latitudes);
    const [top, bottom, left, right] = [up.indexOf(1), up.lastIndexOf(1), across.indexOf(1), across.lastIndexOf(1)];
    if (top < 0 || left < 0) return found;
    const inner = [longitudes.slice(left, right + 1), latitudes.slice(top, bottom + 1)] as const;
    const [rows, columns] = this.grid.places(await this.positions(...inner));
    const first: [number, number] = [Number.NaN, Number.NaN];
    const columnCount = inner[0].length;
    for (let i = 0; i < rows.length; i++) {
      const row = top + Math.floor(i / columnCount);
      const column = left + (i % columnCount);
      if (!up[row] || !across[column] || !this.grid.has(rows[i]!, columns[i]!)) continue;
      found[0][row * width + column] = this.turned(0, rows[i]!, first);
      found[1][row * width + column] = this.turned(1, columns[i]!, first);
    }
    return found;
  }

  /** A place along an axis; of a closed one the turn that is nearest to the first place. */
  private turned(axis: 0 | 1, place: number, first: [number, number]): number {
    if (!this.grid.closed[axis]) return place;
    if (Number.isNaN(first[axis])) first[axis] = place;
    const length = this.grid.shape[axis];
    return first[axis] + modulo(place - first[axis] + length / 2, length) - length / 2;
  }

  /** x and y at a grid of places; infinite or NaN where there are none. */
  private async positions(longitudes: Float64Array, latitudes: Float64Array): Promise<Pair> {
    const coarse = [fewOf(latitudes.length), fewOf(longitudes.length)] as const;
    const [few, many] = [coarse[0].length * coarse[1].length, latitudes.length * longitudes.length];
    const [up, across] = [pick(latitudes, coarse[0]), pick(longitudes, coarse[1])];
    const [x, y] = await toPlane(this.projection, across, up);
    if (few === many) return [x, y];
    const { turn } = this.projection;
    if (turn !== undefined) unwrap(x, across.length, turn);
    if (!isSmooth(x, across.length) || !isSmooth(y, across.length)) {
      return toPlane(this.projection, longitudes, latitudes);
    }
    return [spread(x, coarse), spread(y, coarse)];
  }

  /**
   * Which latitudes and which longitudes are within the bounds: 1 or 0. Far from its zone, a projection may have any
   * values, or take long to find that it has none.
   */
  private near(longitudes: Float64Array, latitudes: Float64Array): readonly [Uint8Array, Uint8Array] {
    const [west, south, east, north] = this.bounds;
    const more = (east - west) * INEXACT + 1e-9;
    const higher = (north - south) * INEXACT + 1e-9;
    const columns = Uint8Array.from(longitudes, (longitude) =>
      Number(east - west >= 360 || modulo(longitude - west + more, 360) <= east - west + 2 * more),
    );
    return [Uint8Array.from(latitudes, (at) => Number(at >= south - higher && at <= north + higher)), columns];
  }
}

/** West, south, east and north. Throws `InputError` where no place of the grid is on the Earth. */
async function boundsOf(projection: Projection, grid: GridPlaces): Promise<Box> {
  const lines = grid.shape.map((length) => {
    const step = length / (SAMPLES - 1);
    return Float64Array.from({ length: SAMPLES }, (_, i) => (i < SAMPLES - 1 ? i * step - 0.5 : length - 0.5));
  });
  const count = SAMPLES * SAMPLES;
  const rows = Float64Array.from({ length: count }, (_, i) => lines[0]![Math.floor(i / SAMPLES)]!);
  const columns = Float64Array.from({ length: count }, (_, i) => lines[1]![i % SAMPLES]!);
  const { turn } = projection;
  const [x, y] = grid.positions([rows, columns]);
  // Half a cell beyond the pole.
  const within = turn === undefined ? y : y.map((at) => Math.min(Math.max(at, -turn / 4), turn / 4));
  const [longitudes, latitudes] = await toDegrees(projection, x, within);
  const known = rows.map((_, i) => Number(Number.isFinite(longitudes[i]!) && Number.isFinite(latitudes[i]!)));
  if (!known.includes(1)) throw new InputError("expected a position on the Earth in the CRS of the heights, got none");
  const wests = longitudes.filter((_, i) => known[i]);
  let [south, north] = [90, -90];
  latitudes.forEach((latitude, i) => {
    if (known[i]) [south, north] = [Math.min(south, latitude), Math.max(north, latitude)];
  });
  if (turn !== undefined) {
    const [west, east] = extent(wests);
    return [west, south, east, north];
  }
  for (const pole of [-90, 90]) {
    const [row, column] = grid.places(await toPlane(projection, new Float64Array(1), Float64Array.of(pole)));
    if (grid.has(row[0]!, column[0]!)) [south, north] = [Math.min(south, pole), Math.max(north, pole)];
  }
  const [west, east] = Math.max(-south, north) > POLAR ? [-180, 180] : extent(wests);
  return [west, south, east, north];
}

/** See `Placement.cell`. Throws `InputError` where the middle is not on the Earth. */
async function cellOf(projection: Projection, grid: GridPlaces): Promise<number> {
  const [row, column] = grid.shape.map((length) => Math.max((length - 2) / 2, 0)) as [number, number];
  const at = grid.positions([Float64Array.of(row, row, row + 1), Float64Array.of(column, column + 1, column)]);
  const [longitudes, latitudes] = await toDegrees(projection, ...at);
  // On a sphere: straight through the Earth is as far as on its surface, between neighbours.
  const points = [0, 1, 2].map((i) => {
    const [longitude, latitude] = [(longitudes[i]! * Math.PI) / 180, (latitudes[i]! * Math.PI) / 180];
    const out = Math.cos(latitude);
    return [out * Math.cos(longitude), out * Math.sin(longitude), Math.sin(latitude)] as const;
  });
  const [middle, ...beside] = points;
  const lengths = beside.map((point) => Math.hypot(...point.map((value, k) => value - middle![k]!)));
  const metres = Math.min(...lengths) * EARTH_RADIUS;
  if (metres > 0 && metres < Number.POSITIVE_INFINITY) return metres;
  throw new InputError("expected a position on the Earth in the middle of the heights, got none");
}

/** x and y at a grid of places on the Earth. */
async function toPlane({ transform }: Projection, longitudes: Float64Array, latitudes: Float64Array): Promise<Pair> {
  const places = new Float64Array(2 * longitudes.length * latitudes.length);
  let next = 0;
  for (const latitude of latitudes) {
    for (const longitude of longitudes) {
      places[next++] = modulo(longitude + 180, 360) - 180;
      places[next++] = latitude;
    }
  }
  return apart(await transform(places, false));
}

async function toDegrees({ transform }: Projection, x: Float64Array, y: Float64Array): Promise<Pair> {
  const places = new Float64Array(2 * x.length);
  x.forEach((at, i) => {
    places[2 * i] = at;
    places[2 * i + 1] = y[i]!;
  });
  return apart(await transform(places, true));
}

function apart(places: Float64Array): Pair {
  const count = places.length / 2;
  return [
    Float64Array.from({ length: count }, (_, i) => places[2 * i]!),
    Float64Array.from({ length: count }, (_, i) => places[2 * i + 1]!),
  ];
}

/** West and east of longitudes of any turn: around their largest gap. */
function extent(longitudes: Float64Array): readonly [number, number] {
  const around = longitudes.map((longitude) => modulo(longitude + 180, 360) - 180).sort();
  let [widest, gap] = [0, 0];
  for (let i = 0; i < around.length; i++) {
    const next = i + 1 < around.length ? around[i + 1]! : around[0]! + 360;
    if (next - around[i]! > gap) [widest, gap] = [i, next - around[i]!];
  }
  if (gap <= GAP) return [-180, 180];
  const west = around[(widest + 1) % around.length]!;
  return [west, west + 360 - gap];
}

/** Some of the places along an axis of this length, the first and the last among them. */
function fewOf(length: number): Int32Array {
  const step = Math.ceil(length / POSITIONS);
  const found: number[] = [];
  for (let place = 0; place < length - 1; place += step) found.push(place);
  return Int32Array.of(...found, length - 1);
}

function pick(line: Float64Array, places: Int32Array): Float64Array {
  return Float64Array.from(places, (place) => line[place]!);
}

/** Let rows of values go on where they are a whole turn off. */
function unwrap(values: Float64Array, width: number, turn: number): void {
  for (let start = 0; start < values.length; start += width) {
    for (let i = start + 1; i < start + width; i++) {
      values[i] = values[i]! - turn * Math.round((values[i]! - values[i - 1]!) / turn);
    }
  }
}

/** Whether values at a grid are finite, and steps between neighbours about the same. */
function isSmooth(values: Float64Array, width: number): boolean {
  let [least, most] = [Number.POSITIVE_INFINITY, Number.NEGATIVE_INFINITY];
  for (const value of values) {
    if (!Number.isFinite(value)) return false;
    [least, most] = [Math.min(least, value), Math.max(most, value)];
  }
  for (const step of [width, 1]) {
    const steps: number[] = [];
    for (let i = step; i < values.length; i++) {
      if (step === width || i % width !== 0) steps.push(Math.abs(values[i]! - values[i - step]!));
    }
    if (steps.length === 0) continue;
    const sorted = Float64Array.from(steps).sort();
    const half = sorted.length >> 1;
    const median = sorted.length % 2 === 0 ? (sorted[half - 1]! + sorted[half]!) / 2 : sorted[half]!;
    if (sorted.at(-1)! > SEAM * median + 1e-6 * (most - least)) return false;
  }
  return true;
}

/** Values of some rows and columns at all of them, linearly. */
function spread(values: Float64Array, [down, across]: readonly [Int32Array, Int32Array]): Float64Array {
  const [height, width] = [down.at(-1)! + 1, across.at(-1)! + 1];
  const tall = new Float64Array(height * across.length);
  for (let row = 0; row < height; row++) {
    const { low, share } = shareOf(row, down);
    const above = low * across.length;
    const below = Math.min(low + 1, down.length - 1) * across.length;
    for (let k = 0; k < across.length; k++) {
      tall[row * across.length + k] = values[above + k]! + (values[below + k]! - values[above + k]!) * share;
    }
  }
  const found = new Float64Array(height * width);
  for (let column = 0; column < width; column++) {
    const { low, share } = shareOf(column, across);
    const next = Math.min(low + 1, across.length - 1);
    for (let row = 0; row < height; row++) {
      const [left, right] = [tall[row * across.length + low]!, tall[row * across.length + next]!];
      found[row * width + column] = left + (right - left) * share;
    }
  }
  return found;
}

/** Between which of some places one lies, and how far from the first to the second. */
function shareOf(place: number, few: Int32Array): { low: number; share: number } {
  const low = Math.max(
    Math.min(
      few.findLastIndex((at) => at <= place),
      few.length - 2,
    ),
    0,
  );
  return { low, share: few.length > 1 ? (place - few[low]!) / (few[low + 1]! - few[low]!) : 0 };
}
