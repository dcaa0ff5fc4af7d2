/** A source that computes its surfaces, to develop and test the element without a container. */

import type {
  AttributeGrid,
  BlockInfo,
  Grid,
  Moment,
  MomentGrids,
  NodeValues,
  Price,
  Source,
  SourceEvents,
  SurfaceInfo,
  Target,
} from "../../src/view/source";

/** How the points of a surface follow from where they are on it. */
export interface ArtificialSurface {
  readonly info: Omit<SurfaceInfo, "prices" | "size" | "levels">;
  /** A point of a block, from shares of its rows and columns, 0 to 1; null: a hole. `detail` is 0 to 1. */
  readonly point: (block: number, row: number, column: number, detail: number) => [number, number, number] | null;
  readonly attribute?: (block: number, row: number, column: number) => number;
}

/** Lengths of an axis at all levels, the finest last. */
function lengths(full: number, closed: boolean, levels: number): number[] {
  const result = [full];
  for (let k = 0; k < levels; k += 1) {
    const length = result[0]!;
    result.unshift(length < (closed ? 5 : 3) ? length : closed ? Math.ceil(length / 2) : Math.floor(length / 2) + 1);
  }
  return result;
}

/** Where the nodes of a level stand along an axis of so many samples. */
function stands(full: number, closed: boolean, level: number, levels: number): Float64Array {
  const count = lengths(full, closed, levels)[level]!;
  const step = closed ? full / count : (full - 1) / Math.max(count - 1, 1);
  return Float64Array.from({ length: count }, (_, k) => k * step);
}

/** A surface that gains a level of detail at each moment. */
export class ArtificialSource implements Source {
  readonly info: SurfaceInfo;
  private readonly events: SourceEvents[] = [];
  private number = 0;
  private timer: ReturnType<typeof setTimeout> | undefined;
  private readonly started = performance.now();
  private stopped = false;

  /** @param interval - Milliseconds between moments. */
  constructor(
    private readonly surface: ArtificialSurface,
    private readonly interval = 300,
    levels = 7,
  ) {
    const prices: Price[] = Array.from({ length: levels + 1 }, (_, level) => {
      const rms = level === levels ? 0 : surface.info.extent * 0.2 * 2.2 ** -level;
      return { bytes: Math.round(120 * 2.6 ** level), level, rms, max: 4 * rms };
    });
    this.info = { ...surface.info, levels, size: prices.at(-1)!.bytes, prices };
  }

  start(events: SourceEvents): void {
    this.events.push(events);
    events.info(this.info);
    this.next();
  }

  grids(asked: number | null, level: number): Promise<MomentGrids> {
    const moment = asked ?? Math.max(0, this.number - 1);
    return Promise.resolve({ moment, grids: this.info.blocks.map((of, block) => this.grid(of, block, moment, level)) });
  }

  valuesAt(moment: number, block: number, row: number, column: number): Promise<NodeValues> {
    const { shape, closed } = this.info.blocks[block]!;
    const [i, j] = [row / (closed[0] ? shape[0] : shape[0] - 1), column / (closed[1] ? shape[1] : shape[1] - 1)];
    const point = this.surface.point(block, i, j, moment / this.info.levels);
    if (point === null) return Promise.reject(new Error("expected a point, got a hole"));
    const attributes = this.info.attributes.map(
      ({ name }) => [name, [this.surface.attribute?.(block, i, j) ?? 0]] as const,
    );
    const { rms, max } = this.info.prices![moment]!;
    return Promise.resolve({ block, row, column, point, attributes, rms, max, within: null });
  }

  focus(): void {}

  setTarget(_target: Target): void {
    this.resume();
  }

  stop(): void {
    this.stopped = true;
    clearTimeout(this.timer);
    this.tell("stopped");
  }

  resume(): void {
    this.stopped = false;
    this.next();
  }

  throttle(): void {}

  close(): void {
    this.stopped = true;
    clearTimeout(this.timer);
    this.events.length = 0;
  }

  private tell(state: "receiving" | "stopped" | "complete"): void {
    const price = this.info.prices?.[Math.max(0, this.number - 1)];
    const progress = { state, bytes: price?.bytes ?? 0, planned: this.info.size, rate: 40_000, detail: "" };
    for (const events of this.events) events.progress(progress);
  }

  private next(): void {
    clearTimeout(this.timer);
    if (this.stopped) return;
    const price = this.info.prices?.[this.number];
    if (price === undefined) {
      this.tell("complete");
      return;
    }
    const complete = this.number === this.info.levels;
    const seconds = (performance.now() - this.started) / 1000;
    const moment: Moment = {
      number: this.number,
      layer: this.number,
      region: null,
      seconds,
      attributes: [],
      complete,
      ...price,
    };
    this.number += 1;
    this.tell(complete ? "complete" : "receiving");
    for (const events of this.events) events.moment(moment);
    if (!complete) this.timer = setTimeout(() => this.next(), this.interval);
  }

  private grid(of: BlockInfo, block: number, moment: number, level: number): Grid {
    const detail = moment / this.info.levels;
    const rowsAt = stands(of.shape[0], of.closed[0], level, this.info.levels);
    const columnsAt = stands(of.shape[1], of.closed[1], level, this.info.levels);
    const count = rowsAt.length * columnsAt.length;
    const points = new Float64Array(3 * count);
    const mask = new Uint8Array(count);
    const values = new Float64Array(count);
    const share = (at: number, axis: 0 | 1): number => at / (of.closed[axis] ? of.shape[axis] : of.shape[axis] - 1);
    rowsAt.forEach((row, i) => {
      columnsAt.forEach((column, j) => {
        const node = i * columnsAt.length + j;
        const point = this.surface.point(block, share(row, 0), share(column, 1), detail);
        points.set(point ?? [Number.NaN, Number.NaN, Number.NaN], 3 * node);
        mask[node] = point === null ? 0 : 1;
        values[node] = this.surface.attribute?.(block, share(row, 0), share(column, 1)) ?? 0;
      });
    });
    const attributes: AttributeGrid[] = this.info.attributes.map(({ name }) => ({ name, components: 1, values }));
    const holes = mask.includes(0) ? mask : null;
    return { rowsAt, columnsAt, full: of.shape, closed: of.closed, points, mask: holes, attributes };
  }
}

const BASE = {
  unit: "m",
  planeUnit: "m",
  exact: true,
  georeferenced: false,
  geographic: false,
  mapped: false,
  joined: false,
  heights: false,
};
const TURN = 2 * Math.PI;

/** Mountains with a lake that is a hole, 10 km wide, far from the origin of their coordinates. */
export const MOUNTAINS: ArtificialSurface = {
  info: {
    ...BASE,
    name: "Artificial mountains",
    blocks: [{ shape: [193, 161], closed: [false, false] }],
    extent: 1500,
    heights: true,
    georeferenced: true,
    attributes: [{ name: "moisture", components: 1 }],
  },
  point: (_, row, column, detail) => {
    const [x, y] = [10 * column, 12 * row];
    if (Math.hypot(x - 6.5, y - 4) < 0.9) return null;
    let z = 0;
    for (let octave = 0; octave < 1 + 6 * detail; octave += 1) {
      const f = 0.35 * 1.9 ** octave;
      z +=
        (Math.sin(f * x + 1.7 * octave) * Math.cos(f * y * 1.1 - octave) + Math.sin(f * (x + y) * 0.7)) / 2.1 ** octave;
    }
    return [500_000 + 1000 * x, 4_200_000 - 1000 * y, 900 + 380 * z];
  },
  attribute: (_, row, column) => Math.sin(9 * row) * Math.cos(7 * column),
};

/** A torus, closed along both axes. */
export const TORUS: ArtificialSurface = {
  info: {
    ...BASE,
    name: "Artificial torus",
    blocks: [{ shape: [96, 128], closed: [true, true] }],
    extent: 10,
    attributes: [],
  },
  point: (_, row, column, detail) => {
    const bump = 1 + 0.12 * detail * Math.sin(TURN * 5 * row) * Math.sin(TURN * 7 * column);
    const ring = 3 + bump * Math.cos(TURN * row);
    return [ring * Math.cos(TURN * column), ring * Math.sin(TURN * column), bump * Math.sin(TURN * row)];
  },
};

/** A sphere with a pole at either end, closed along its columns. */
export const SPHERE: ArtificialSurface = {
  info: {
    ...BASE,
    name: "Artificial sphere",
    blocks: [{ shape: [65, 128], closed: [false, true] }],
    extent: 6.93,
    attributes: [],
  },
  point: (_, row, column) => {
    const across = row === 0 || row === 1 ? 0 : Math.sin(Math.PI * row);
    return [2 * across * Math.cos(TURN * column), 2 * across * Math.sin(TURN * column), 2 * Math.cos(Math.PI * row)];
  },
};

/** A cube of six blocks, blown up a little, whose sides coincide. */
export const BLOCKS: ArtificialSurface = {
  info: {
    ...BASE,
    name: "Artificial blocks",
    blocks: Array.from({ length: 6 }, () => ({ shape: [33, 33] as const, closed: [false, false] as const })),
    extent: 3.46,
    joined: true,
    attributes: [],
  },
  point: (block, row, column) => {
    const [u, v] = [2 * row - 1, 2 * column - 1];
    const sign = block % 2 === 0 ? 1 : -1;
    const axis = Math.floor(block / 2);
    const point: [number, number, number] = [0, 0, 0];
    point[axis] = sign;
    point[(axis + 1) % 3] = u;
    point[(axis + 2) % 3] = v;
    const length = 0.6 * Math.hypot(...point) + 0.4;
    return point.map((value) => value / length) as [number, number, number];
  },
};
