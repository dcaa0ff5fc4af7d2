/**
 * The reconstruction of a window: of every level only what the window is made of, so that it costs what a window costs.
 *
 * From the finest level down, an axis is followed by the samples that are wanted, see `grid/support`. The nodes and details
 * that give them back are one stretch of the axis. It is stepped like an axis of its own: where it ends inside the
 * surface, what lies beyond would be extended wrongly, but nothing that is wanted looks there.
 */
import type { Header } from "../container/header";
import { type Plane, type Tiles, UNANNOUNCED } from "../entropy/tiles";
import { type AxisStep, hasTail } from "../grid/axis";
import { coefficientsNeeded } from "../grid/support";
import type { Arena } from "../kernels/arena";
import { allocatePlane, corner, FRACTION_BITS, inverseStep, toEighths } from "../transform/pyramid";
import type { Region, Span } from "../types";

/** Nodes that the third step wants of a run. */
const LEAST_NODES = 4;

/** What one step along an axis takes for the samples that are wanted. */
interface AxisCrop {
  /** The first node, and the first detail, that is taken. */
  readonly first: number;
  /** Of the nodes and details that are taken, as an axis of their own. */
  readonly step: AxisStep;
  /** Where the samples that are wanted begin among those that the step makes. */
  readonly start: number;
}

/** What gives the samples from `start` to before `stop` back; an axis that wraps is taken whole. */
function cropAxis(step: AxisStep, [start, stop]: Span): AxisCrop {
  if (step.wraps) return { first: 0, step, start };
  if (!step.midpoints) {
    const length = stop - start;
    const still = { length, coarse: length, midpoints: 0, run: length, wraps: false, left: false, right: false };
    return { first: start, step: still, start: 0 };
  }
  const samples = new Uint8Array(step.length).fill(1, start, stop);
  const line = coefficientsNeeded(samples, step);
  const nodes = line.subarray(0, step.coarse);
  const details = line.subarray(step.coarse);
  let first = nodes.indexOf(1);
  let last = Math.min(nodes.lastIndexOf(1), step.run - 1);
  if (details.includes(1)) {
    first = Math.min(first, details.indexOf(1));
    last = Math.max(last, details.lastIndexOf(1) + 1);
  }
  first = Math.max(Math.min(first, last + 1 - LEAST_NODES), 0);
  last = Math.min(Math.max(last, first + LEAST_NODES - 1), step.run - 1);
  // The sample of its own at the end of an axis of even length goes with the last node of the run.
  const tail = Number(hasTail(step) && last === step.run - 1);
  const run = last - first + 1;
  const made: AxisStep = {
    length: 2 * run - 1 + tail,
    coarse: run + tail,
    midpoints: run - 1,
    run,
    wraps: false,
    left: step.left && first === 0,
    right: step.right && last === step.run - 1,
  };
  return { first, step: made, start: start - 2 * first };
}

/** The nodes that are taken: samples that are wanted of the coarser level. */
function nodesOf(crop: AxisCrop): Span {
  return [crop.first, crop.first + crop.step.coarse];
}

/** Of an axis the first node and detail, nodes that are taken, and nodes that there are. */
type Taken = readonly [first: number, taken: number, nodes: number];

/**
 * A window of a level of one channel in a state, of a surface of one grid, in memory that the caller's scope ends: lattice
 * coordinates over two to the power of `fraction`. `state` has the passes that remain of each tile, 0 where nothing is
 * needed; `region` has rows and columns of the level.
 */
export function reconstructWindow(
  arena: Arena,
  header: Header,
  channel: number,
  tiles: Tiles,
  state: Int8Array,
  region: Region,
  finest: number,
): { plane: Plane; fraction: number } {
  const { layout } = header;
  let whole = 0;
  while (whole < finest && !state.subarray(...layout.tilesOf(whole + 1)).some((left) => left !== 0)) whole++;
  const crops: (readonly [AxisCrop, AxisCrop])[] = []; // finest level first
  let spans: Region = region;
  for (let level = finest; level > 0; level--) {
    const steps = layout.steps(0, level);
    const crop = [cropAxis(steps[0], spans[0]), cropAxis(steps[1], spans[1])] as const;
    crops.push(crop);
    spans = [nodesOf(crop[0]), nodesOf(crop[1])];
  }
  const sizes = [spans[0][1] - spans[0][0], spans[1][1] - spans[1][0]] as const;
  let reconstructed = allocatePlane(arena, sizes);
  putLevel(arena, tiles, 0, state, false, reconstructed, [
    [spans[0][0], sizes[0], 0],
    [spans[1][0], sizes[1], 0],
  ]);
  for (let level = 1; level <= finest; level++) {
    const crop = crops[finest - level]!;
    const finer = crops[finest - level - 1];
    const wanted: Region = finer ? [nodesOf(finer[0]), nodesOf(finer[1])] : region;
    const steps = [crop[0].step, crop[1].step] as const;
    const canvas = allocatePlane(arena, [steps[0].length, steps[1].length]);
    const nodes = corner(canvas, [steps[0].coarse, steps[1].coarse]);
    copyPlane(arena, reconstructed, nodes);
    if (level === whole + 1) toEighths(arena, nodes);
    const full = layout.steps(0, level);
    putLevel(arena, tiles, level, state, level > whole, canvas, [
      [crop[0].first, steps[0].coarse, full[0].coarse],
      [crop[1].first, steps[1].coarse, full[1].coarse],
    ]);
    for (const axis of [1, 0] as const) {
      const rule = header.predictors[channel]!.of(layout.grids[0]!, full[axis], level, axis);
      inverseStep(arena, canvas, axis, steps[axis], rule);
    }
    const [[top, bottom], [left, right]] = wanted;
    const address = canvas.address + 4 * (crop[0].start * canvas.pitch + crop[1].start);
    reconstructed = { address, rows: bottom - top, columns: right - left, pitch: canvas.pitch };
  }
  return { plane: reconstructed, fraction: whole < finest ? FRACTION_BITS : 0 };
}

/** Copy a plane into the first rows and columns of another. */
function copyPlane(arena: Arena, from: Plane, to: Plane, top = 0, left = 0): void {
  const words = arena.i32(0, arena.bytes / 4);
  for (let row = 0; row < from.rows; row++) {
    const start = from.address / 4 + row * from.pitch;
    words.copyWithin(to.address / 4 + (top + row) * to.pitch + left, start, start + from.columns);
  }
}

/** Put the bands of a level where they belong in what is taken of it; those that are `finer` multiplied by 8. */
function putLevel(
  arena: Arena,
  tiles: Tiles,
  level: number,
  state: Int8Array,
  finer: boolean,
  canvas: Plane,
  places: readonly [Taken, Taken],
): void {
  const { table } = tiles;
  const [first, stop] = table.layout.tilesOf(level);
  for (let number = first; number < stop; number++) {
    if (state[number]! >= UNANNOUNCED) continue;
    for (const [k, band] of table.members[number]!.entries()) {
      const down = spanOf(band.kind[0], band.rows, places[0], canvas.rows);
      const across = spanOf(band.kind[1], band.columns, places[1], canvas.columns);
      if (down.stop <= down.start || across.stop <= across.start) continue;
      arena.scope(() => {
        const shape = [band.rows[1] - band.rows[0], band.columns[1] - band.columns[0]] as const;
        const own = allocatePlane(arena, shape);
        const numbers = [table.first[number]! + k];
        tiles.dequantize(numbers, state, finer ? 0 : table.layout.tiles.length, own, band.rows[0], band.columns[0]);
        const address = own.address + 4 * (down.skip * own.pitch + across.skip);
        const plane = { address, rows: down.stop - down.start, columns: across.stop - across.start, pitch: own.pitch };
        copyPlane(arena, plane, canvas, down.start, across.start);
      });
    }
  }
}

/** Where a band begins in itself to be taken, and from where to where it goes along an axis of what is taken. */
function spanOf(details: boolean, span: Span, [first, taken, nodes]: Taken, length: number) {
  const offset = details ? taken - nodes - first : -first;
  const [least, most] = details ? [taken, length] : [0, taken];
  const start = Math.max(span[0] + offset, least);
  const stop = Math.min(span[1] + offset, most);
  return { skip: start - offset - span[0], start, stop };
}
