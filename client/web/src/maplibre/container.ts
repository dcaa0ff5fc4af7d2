/** A container of heights that stays open: its index is read once, and windows of its levels are received as they are asked for. */

import type { Header } from "../container/header";
import type { Index } from "../container/model";
import type { Metadata } from "../container/sections";
import { Decoder } from "../decoding/decoder";
import type { View } from "../decoding/view";
import { InputError, UnavailableError } from "../errors";
import type { Positions } from "../grid/patches";
import { loadKernels } from "../kernels/instance";
import { nodesOfLevel } from "../planning/selection";
import { makeTarget, type TargetOptions } from "../planning/target";
import { MemoryStore } from "../transfer/store";
import { Stream } from "../transfer/stream";
import type { Region, Span } from "../types";

/** Bytes of a container that are kept for later windows; beyond that only what says where things stand. */
const MOST_KEPT = 32 * 1024 * 1024;

/** What every window begins with; requests for the first bytes of a container ask for so many. */
const HEAD = 4096;

/**
 * Of the slices of a window many are short and far from each other. A map is to need few bytes: what lies between is not
 * taken along, but more of them are asked for at once.
 */
const RANGES = { requests: 4, gap: 4096 };

/** Where a container is. */
export interface Source {
  readonly url: string;
  /** For a server that wants one. */
  readonly token: string | undefined;
}

/** What is known of a container once its index has come. */
interface Opened {
  readonly header: Header;
  readonly metadata: Metadata;
  readonly index: Index;
  /** Where it was found. */
  readonly url: string;
  readonly version: string | undefined;
  readonly container: string | undefined;
  readonly size: number | undefined;
}

/** A container of one block of heights, or of points whose x and y follow a rule. */
export class Container {
  readonly header: Header;
  readonly metadata: Metadata;
  readonly url: string;
  private readonly nodesAt = new Map<number, Positions>();

  private constructor(
    private readonly source: Source,
    private readonly opened: Opened,
    private readonly fetch: typeof globalThis.fetch | undefined,
    private store: MemoryStore,
    private readonly mostKept: number,
  ) {
    this.header = opened.header;
    this.metadata = opened.metadata;
    this.url = opened.url;
  }

  /**
   * Read the index of a container.
   *
   * @param fetch In place of the platform's own.
   * @param mostKept Bytes of the container.
   * @throws InputError if it has no heights.
   * @throws LodestreamError if it cannot be had, or is damaged.
   */
  static async open(source: Source, fetch?: typeof globalThis.fetch, mostKept = MOST_KEPT): Promise<Container> {
    const store = new MemoryStore(true);
    const { decoder, stream } = await received(source, { level: 0, attributes: [] }, { store, fetch });
    const { header } = decoder;
    const { index, container, size } = stream.reception;
    if (header === null || index === undefined)
      throw new UnavailableError("expected the index of a container, got none");
    if (header.arrangement !== null) {
      const { length } = header.blocks;
      const got = length > 1 ? `${length} blocks` : "a block that meets itself";
      throw new InputError(`expected one block of heights for a map, got ${got}`);
    }
    if (header.pointChannels !== 1) {
      throw new InputError("expected one block of heights for a map, got points with an x and a y of their own");
    }
    const metadata = decoder.metadata ?? {};
    const { url = source.url, version } = stream;
    return new Container(source, { header, metadata, index, url, version, container, size }, fetch, store, mostKept);
  }

  /** The rows and columns of the full grid at the nodes of a level. */
  nodes(level: number): Positions {
    let found = this.nodesAt.get(level);
    if (found === undefined) {
      found = nodesOfLevel(this.header, level);
      this.nodesAt.set(level, found);
    }
    return found;
  }

  /**
   * A window of a level as the container has it, (row, column); NaN in holes. Only one may be under way.
   *
   * @param window Rows and columns of the level.
   * @throws LodestreamError if its bytes cannot be had, or are damaged.
   */
  async heights(level: number, window: Region, signal: AbortSignal): Promise<Float64Array> {
    const nodes = this.nodes(level);
    const spans = window.map((span, axis) => twoOf(span, nodes[axis as 0 | 1].length)) as unknown as Region;
    const region = spans.map(([start, stop], axis) => {
      const line = nodes[axis as 0 | 1];
      return [line[start]!, line[stop - 1]! + 1];
    }) as unknown as Region;
    const target: TargetOptions = { region, level, attributes: [] };
    const { url, version, container, size } = this.opened;
    const source = { ...this.source, url };
    const known = { store: this.store, version, container, size, fetch: this.fetch };
    const { decoder } = await received(source, target, known, signal);
    this.forget();
    return cut(valuesOf(decoder.view(), spans), spans, window);
  }

  /** Keep no more bytes than there may be. */
  private forget(): void {
    if (this.store.ranges.total <= this.mostKept) return;
    const { header, index, size } = this.opened;
    const store = new MemoryStore(true);
    const service = Math.min(index.index.offset, index.metadata.offset);
    const end = size ?? index.size;
    for (const [start, stop] of [
      [0, Math.max(header.length, HEAD)],
      [service, end],
    ] as const) {
      const held = this.store.ranges.overlap(start, stop - start);
      for (const [offset, length] of held) {
        for (const [from, count] of [...store.ranges.missing(offset, length)]) {
          store.write(from, this.store.read(from, count));
        }
      }
    }
    this.store = store;
  }
}

/** What a stream may be given beside source and target. */
interface Known {
  readonly store: MemoryStore;
  readonly version?: string | undefined;
  readonly container?: string | undefined;
  readonly size?: number | undefined;
  readonly fetch: typeof globalThis.fetch | undefined;
}

/** Receive all of a target by Range requests. */
async function received(source: Source, options: TargetOptions, known: Known, signal?: AbortSignal) {
  const target = makeTarget(options);
  const { region, attributes, level } = target;
  const decoder = new Decoder(await loadKernels(), { region, attributes, level });
  const { url, token } = source;
  const stream = new Stream<View>(url, target, decoder, {
    ...known,
    token,
    transport: "http",
    ranges: RANGES,
    latest: true,
  });
  const stop = (): void => void stream.close();
  signal?.throwIfAborted();
  signal?.addEventListener("abort", stop);
  try {
    for await (const _ of stream);
    signal?.throwIfAborted();
  } finally {
    signal?.removeEventListener("abort", stop);
  }
  return { decoder, stream };
}

/** A span of at least two nodes where there are so many, since one point alone is no surface. */
function twoOf([start, stop]: Span, length: number): Span {
  return stop - start > 1 || length < 2 ? [start, stop] : start > 0 ? [start - 1, stop] : [start, stop + 1];
}

function valuesOf(view: View, [[top, bottom], [left, right]]: Region): Float64Array {
  let block: ReturnType<View["surface"]>["blocks"][0];
  try {
    block = view.surface().blocks[0]!;
  } catch (error) {
    if (!(error instanceof InputError)) throw error;
    return new Float64Array((bottom - top) * (right - left)).fill(Number.NaN); // nothing of this window is valid
  }
  const { points, mask } = block;
  const { components, values } = points;
  return Float64Array.from({ length: values.length / components }, (_, i) =>
    mask?.[i] === 0 ? Number.NaN : Number(values[(i + 1) * components - 1]!),
  );
}

/** The part of a window that is within another one. */
function cut(values: Float64Array, from: Region, to: Region): Float64Array {
  const [rows, columns] = to;
  const width = from[1][1] - from[1][0];
  const made = new Float64Array((rows[1] - rows[0]) * (columns[1] - columns[0]));
  let next = 0;
  for (let row = rows[0]; row < rows[1]; row++) {
    const start = (row - from[0][0]) * width - from[1][0];
    made.set(values.subarray(start + columns[0], start + columns[1]), next);
    next += columns[1] - columns[0];
  }
  return made;
}
