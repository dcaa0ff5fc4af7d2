/** Slices of a container whose index is known: which segments they complete, and which states those make. */

import { CorruptStreamError } from "../errors";
import type { SelectedSlices } from "../planning/selection";
import type { ChannelErrors, Chunk, Segment } from "../types";
import { ByteBuffer } from "./buffer";
import { type Frame, wholeSection } from "./frames";
import type { Index } from "./model";
import { KIND } from "./sections";

/** What a view is made of; its errors are those that the whole surface has in this state. */
export interface State {
  readonly number: number;
  readonly level: number;
  readonly bytes: number;
  readonly rms: number;
  readonly maxError: number;
  /** Errors of each channel, where they are known. */
  readonly channels: ChannelErrors;
  readonly complete: boolean;
  /** No layer is missing, so that units which none names are known to have only zeros. */
  readonly allLayers: boolean;
  /** The level to which everything is there where levels come one after another, counted from the coarsest; else -1. */
  readonly wholeLevel: number;
  /** Nothing but the residual is missing in the region that comes first. */
  readonly wholeNear: boolean;
}

/** A segment, or a chunk of the residual with its number, and its bytes. */
export type Arrived =
  | { readonly segment: Segment; readonly data: Uint8Array }
  | { readonly chunk: Chunk; readonly number: number; readonly data: Uint8Array };

type Item = { readonly segment: Segment } | { readonly chunk: Chunk; readonly number: number };

const rangeOf = (item: Item) => ("segment" in item ? item.segment : item.chunk).range;
const endOf = (item: Item) => rangeOf(item).offset + rangeOf(item).length;

/** Bytes that follow each other, from `start` on. */
class Run {
  readonly bytes = new ByteBuffer();
  start: number;

  constructor(start: number) {
    this.start = start;
  }

  get end(): number {
    return this.start + this.bytes.length;
  }
}

/** Collects bytes at their places and hands each segment and chunk of the residual on once, when it is whole. */
export class Slices {
  readonly #index: Index;
  readonly #whole: boolean;
  readonly #level: number;
  readonly #items: Item[];
  readonly #starts: Float64Array;
  readonly #seen: Uint8Array;
  readonly #wanted: readonly Segment[];
  readonly #levels: Int32Array; // of the wanted segments
  readonly #layerLevel: number[];
  readonly #byLayer: Groups;
  readonly #byLevel: Groups;
  readonly #chunks: number;
  // What is not whole yet: runs of bytes by the place where each goes on, several where the order has changed.
  readonly #runs = new Map<number, Run>();
  #run = new Run(0);
  #hasMetadata = false;
  #bytes: number;
  #inFile = false;
  #received = 0;
  #finest = 0;
  #corrected = 0;
  #nearTiles: Uint8Array | null = null;
  #near: readonly Groups[] = [];
  #reached: number[] | null = null; // null while all comes in order

  /** `level` is the finest of the segments that are wanted: a layer that has finer ones is then no state. */
  constructor(index: Index, wanted: SelectedSlices, level: number = index.header.levels) {
    this.#index = index;
    this.#level = level;
    this.#whole = wanted.whole;
    this.#wanted = wanted.segments;
    const chunks = [...wanted.chunks].map(([number, chunk]): Item => ({ number, chunk }));
    const items: Item[] = [...wanted.segments.map((segment): Item => ({ segment })), ...chunks];
    this.#items = items.sort((a, b) => rangeOf(a).offset - rangeOf(b).offset);
    this.#starts = Float64Array.from(this.#items, (item) => rangeOf(item).offset);
    this.#seen = new Uint8Array(this.#items.length);
    this.#bytes = index.header.length;
    this.#chunks = wanted.chunks.size;
    const { tiles } = index.header.layout;
    this.#levels = Int32Array.from(wanted.segments, (segment) => tiles[segment.tile]!.level);
    this.#layerLevel = index.layers.map(() => 0);
    wanted.segments.forEach((segment, i) => {
      this.#layerLevel[segment.layer] = Math.max(this.#layerLevel[segment.layer]!, this.#levels[i]!);
    });
    for (let layer = 1; layer < this.#layerLevel.length; layer++) {
      this.#layerLevel[layer] = Math.max(this.#layerLevel[layer]!, this.#layerLevel[layer - 1]!);
    }
    this.#byLayer = new Groups(
      wanted.segments.map((segment) => segment.layer),
      index.layers.length,
    );
    this.#byLevel = new Groups(this.#levels, level + 1);
  }

  /**
   * Begin where a file was read in its order as far as a section that ends at `position`. All bytes of the surface count
   * from there on, not only those of segments and chunks.
   */
  continueFile(position: number): void {
    this.#inFile = true;
    this.#bytes = position;
    for (let number = 0; number < lowerBound(this.#starts, position); number++) {
      const item = this.#items[number]!;
      this.#seen[number] = 1;
      if ("segment" in item) this.#count(item.segment);
      else this.#corrected++;
    }
  }

  /** Notice from now on when a layer or level is whole in these tiles too, 1 or 0 for each; null: in no tiles. */
  focus(tiles: Uint8Array | null): void {
    this.#nearTiles = tiles;
    this.#near = [];
    if (tiles !== null) {
      const [layers, levels]: [number[], number[]] = [[], []];
      this.#wanted.forEach((segment, i) => {
        if (tiles[segment.tile] && !this.#seen[lowerBound(this.#starts, segment.range.offset)]) {
          layers.push(segment.layer);
          levels.push(this.#levels[i]!);
        }
      });
      this.#near = [new Groups(layers, this.#index.layers.length), new Groups(levels, this.#level + 1)];
    }
    this.#reached = this.#groupsReached();
  }

  /** Take bytes; they continue the run of them that ends where they begin, if one does. */
  add(offset: number, data: Uint8Array): void {
    if (this.#run.end !== offset) {
      if (this.#run.bytes.length) this.#runs.set(this.#run.end, this.#run);
      this.#run = this.#runs.get(offset) ?? new Run(offset);
      this.#runs.delete(offset);
    }
    this.#run.bytes.append(data);
    if (this.#inFile) {
      this.#bytes += Math.max(Math.min(offset + data.length, this.#index.surfaceEnd) - offset, 0);
    }
  }

  /** Segments and chunks that are whole now, in the order of the file. */
  *items(): Generator<Arrived> {
    const { start, end } = this.#run;
    const first = lowerBound(this.#starts, start);
    const last = lowerBound(this.#starts, end + 1);
    for (let number = first; number < last; number++) {
      const item = this.#items[number]!;
      if (endOf(item) > end || this.#seen[number]) continue;
      this.#seen[number] = 1;
      const place = rangeOf(item).offset - start;
      const data = this.#run.bytes.peek(endOf(item) - start).slice(place);
      yield { ...item, data };
    }
    this.#drop(end);
  }

  /** The metadata, once, when they are whole. */
  metadata(): Frame | null {
    const { offset, length } = this.#index.metadata;
    const start = offset - this.#run.start;
    if (this.#hasMetadata || start < 0 || offset + length > this.#run.end) return null;
    this.#hasMetadata = true;
    return wholeSection(this.#run.bytes.peek(start + length).slice(start), offset, KIND.metadata);
  }

  /** Note a segment; the state that it completes, if there is one. */
  hold(segment: Segment): State | null {
    if (!this.#inFile) this.#bytes += segment.range.length;
    this.#count(segment);
    return this.state();
  }

  /** Note a chunk of the residual; the complete state, if everything is there. */
  holdChunk(chunk: Chunk): State | null {
    if (this.#received !== this.#wanted.length) {
      throw new CorruptStreamError("expected all segments before the residual, got fewer", chunk.range.offset);
    }
    this.#corrected++;
    if (!this.#inFile) this.#bytes += chunk.range.length;
    if (this.#corrected < this.#chunks) return null;
    const { residual, chunks, layers } = this.#index;
    if (this.#whole && !this.#inFile && residual) {
      // With the frame of the section.
      this.#bytes += residual.length;
      for (const { range } of chunks) this.#bytes -= range.length;
    }
    return this.#end(layers.length);
  }

  /** The state that is complete now, if it is one; the first ones may need no segment at all. */
  state(): State | null {
    const risen = this.#risen();
    const { layers, levels, header } = this.#index;
    const layer = this.#byLayer.whole(this.#received);
    const level = this.#byLevel.whole(this.#received);
    const ended = level === this.#level && level < header.levels;
    if (layer !== null && layers[layer]!.level <= this.#level && !ended) {
      const record = layers[layer]!;
      const last = layer === layers.length - 1;
      if (last && !this.#chunks) return this.#end(layer);
      return {
        number: layer,
        level: this.#layerLevel[layer]!,
        bytes: this.#inFile ? record.end : this.#bytes,
        rms: record.errors.rms,
        maxError: record.errors.maximum,
        channels: record.errors.channels,
        complete: false,
        allLayers: last,
        wholeLevel: -1,
        wholeNear: false,
      };
    }
    if (level !== null && level < header.levels && !this.#inFile) {
      return {
        number: level,
        level,
        bytes: this.#bytes,
        rms: levels[level]!.errors.rms,
        maxError: levels[level]!.errors.maximum,
        channels: levels[level]!.errors.channels,
        complete: false,
        allLayers: false,
        wholeLevel: level,
        wholeNear: false,
      };
    }
    // Out of order, what is whole stands beside parts of what comes later.
    if (!risen.length) return null;
    return {
      number: Math.max(...risen),
      level: this.#finest,
      bytes: this.#bytes,
      rms: Number.NaN,
      maxError: Number.NaN,
      channels: [],
      complete: false,
      allLayers: false,
      wholeLevel: -1,
      wholeNear: this.#near[0]?.reached === layers.length - 1,
    };
  }

  #count(segment: Segment): void {
    const level = this.#index.header.layout.tiles[segment.tile]!.level;
    this.#received++;
    this.#finest = Math.max(this.#finest, level);
    this.#byLayer.hold(segment.layer);
    this.#byLevel.hold(level);
    if (this.#nearTiles?.[segment.tile]) {
      this.#near[0]!.hold(segment.layer);
      this.#near[1]!.hold(level);
    }
  }

  /** What has become whole since this was asked last; nothing while all comes in order. */
  #risen(): number[] {
    const before = this.#reached;
    if (before === null) return [];
    const now = this.#groupsReached();
    this.#reached = now;
    return now.filter((reached, i) => reached > before[i]!);
  }

  /** How far layers are whole everywhere and in the focus; and levels, where these are what comes in turn. */
  #groupsReached(): number[] {
    const kinds = this.#inFile ? 1 : 2;
    return [[this.#byLayer, this.#byLevel], this.#near].flatMap((pair) =>
      pair.slice(0, kinds).map((groups) => groups.reached),
    );
  }

  #end(number: number): State {
    const last = this.#index.levels.at(-1)!;
    return {
      number,
      level: last.level,
      bytes: this.#inFile ? this.#index.surfaceEnd : this.#bytes,
      rms: last.errors.rms,
      maxError: last.errors.maximum,
      channels: last.errors.channels,
      complete: true,
      allLayers: true,
      wholeLevel: -1,
      wholeNear: false,
    };
  }

  /** Forget bytes that belong to whole items only. */
  #drop(end: number): void {
    const run = this.#run;
    let keep = end;
    const { offset, length } = this.#index.metadata;
    if (!this.#hasMetadata) {
      if (offset <= end && end < offset + length) keep = Math.min(keep, Math.max(offset, run.start));
      else if (run.start <= offset && offset + length <= end) keep = Math.min(keep, offset);
    }
    const item = this.#items[lowerBound(this.#starts, end + 1) - 1];
    if (item && endOf(item) > end) keep = Math.min(keep, Math.max(rangeOf(item).offset, run.start));
    run.bytes.drop(keep - run.start);
    run.start = keep;
  }
}

/** The first place in rising numbers that is not below a number. */
function lowerBound(numbers: Float64Array, number: number): number {
  let [low, high] = [0, numbers.length];
  while (low < high) {
    const middle = (low + high) >> 1;
    if (numbers[middle]! < number) low = middle + 1;
    else high = middle;
  }
  return low;
}

/** Segments by layer, or by level: when are the first groups whole, and nothing else received? */
class Groups {
  readonly #missing: Int32Array;
  readonly #ends: Int32Array;
  #next = 0;

  constructor(groups: ArrayLike<number>, count: number) {
    this.#missing = new Int32Array(count);
    for (let i = 0; i < groups.length; i++) this.#missing[groups[i]!]!++;
    let total = 0;
    this.#ends = this.#missing.map((missing) => {
      total += missing;
      return total;
    });
    this.#pass();
  }

  /** The last of the groups that are whole with all before them, -1 if there is none. */
  get reached(): number {
    return this.#next - 1;
  }

  hold(group: number): void {
    this.#missing[group]!--;
    this.#pass();
  }

  /** The last of the groups that are whole, if these are all that is received. */
  whole(received: number): number | null {
    const last = this.#next - 1;
    return last >= 0 && this.#ends[last] === received ? last : null;
  }

  #pass(): void {
    while (this.#next < this.#missing.length && this.#missing[this.#next] === 0) this.#next++;
  }
}
