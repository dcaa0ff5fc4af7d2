/**
 * The far side of a `SurfaceStream`: stream and decoder, in a worker or, where there is none, in the same thread.
 *
 * What is asked of it and what it answers can be posted from one thread to another.
 */

import { Capacity } from "../container/capacity";
import { Decoder } from "../decoding/decoder";
import type { View } from "../decoding/view";
import { InputError } from "../errors";
import { loadKernels } from "../kernels/instance";
import { checkSize, checkSurface } from "../planning/selection";
import { makeTarget, type TargetOptions } from "../planning/target";
import type { Region, Surface, ViewInfo } from "../types";
import { isSurface } from "./addresses";
import { fetchPrices, type Price, pricesOf } from "./prices";
import type { Kept, Opening, Platform, Questions, Told } from "./questions";
import { MemoryStore } from "./store";
import { Stream } from "./stream";

/** One stream with its decoder. */
export class Host implements Questions {
  private opening: Opening | undefined;
  private stream: Stream<View> | undefined;
  private decoder: Decoder | undefined;
  private store: MemoryStore | undefined;
  private described = "";

  constructor(
    private readonly tell: (told: Told) => void,
    private readonly platform: Platform = {},
  ) {}

  async open(opening: Opening): Promise<void> {
    const { source, options, kept } = opening;
    const target = makeTarget(opening.target);
    const { region, attributes, level } = target;
    const maxVertices = opening.maxVertices ?? null;
    // A later target for the whole surface may want more than this level, see `aim`.
    this.decoder = new Decoder(await loadKernels(), { region, attributes, level, maxVertices });
    if (opening.keep || kept !== undefined) {
      this.store = new MemoryStore(opening.keep);
      for (const [offset, data] of kept?.slices ?? []) {
        for (const [start, length] of [...this.store.ranges.missing(offset, data.length)]) {
          this.store.write(start, data.subarray(start - offset, start - offset + length));
        }
      }
    }
    this.opening = opening;
    this.stream = new Stream(source, target, this.decoder, {
      ...options,
      ...this.platform,
      store: this.store,
      container: kept?.container ?? options.container,
      size: kept?.size ?? options.size,
      version: kept?.version,
      onState: (state) => this.tell({ kind: "state", state, progress: this.own.progress }),
      onProgress: (progress) => {
        this.tell({ kind: "progress", progress });
        this.describe();
      },
      ...(opening.tellBytes
        ? { onBytes: (offset: number, data: Uint8Array) => this.tell({ kind: "bytes", offset, data: data.slice() }) }
        : {}),
    });
  }

  async next(): Promise<{ number: number; info: ViewInfo } | null> {
    const { value } = await this.own.next();
    this.describe();
    return value === undefined ? null : { number: this.decoder!.layers.lastIndexOf(value), info: value.info };
  }

  stop(): Promise<void> {
    return this.own.stop();
  }

  async close(): Promise<void> {
    await this.stream?.close();
  }

  focus(region: Region | undefined): void {
    this.own.focus(region);
  }

  aim(options: TargetOptions): void {
    const header = this.decoder?.header;
    if (header && !header.awaitsMasks) {
      const { region, attributes, level } = makeTarget(options);
      const selection = { region, attributes, level };
      checkSurface(selection, header);
      checkSize(selection, header, new Capacity(this.decoder!.capacity.maxVertices));
    }
    this.own.aim(options);
  }

  throttle(rate: number | undefined): void {
    this.own.throttle(rate);
  }

  async surface(view: number, level: number | undefined): Promise<Surface> {
    return this.viewOf(view).surfaceAsync(level);
  }

  window(view: number, region: Region, level: number | undefined): Surface {
    return this.viewOf(view).window(region, level);
  }

  async prices(): Promise<readonly Price[]> {
    const { reception, url } = this.own;
    const index = reception.index ?? this.decoder?.index;
    if (index !== undefined && index !== null) return pricesOf(index);
    const { options } = this.opening!;
    if (url === undefined || !isSurface(url)) {
      throw new InputError("expected the index of the container to have come, got a stream that has not begun");
    }
    return fetchPrices(url, options.token, options.silence ?? 30, this.platform.fetch ?? globalThis.fetch);
  }

  kept(): Kept {
    const { container, size } = this.own.reception;
    return { container, size, version: this.own.version, slices: this.store?.all() ?? [] };
  }

  private get own(): Stream<View> {
    if (this.stream === undefined) throw new InputError("expected a stream that has been opened, got none");
    return this.stream;
  }

  private viewOf(number: number): View {
    const view = this.decoder?.layers[number];
    if (view === undefined) throw new InputError(`expected a view of this stream, got number ${number}`);
    return view;
  }

  /** Tell what is known of the surface, when more of it is. */
  private describe(): void {
    const decoder = this.decoder!;
    const { header, metadata } = decoder;
    if (header === null || header.awaitsMasks) return;
    const { reception } = this.own;
    const index = reception.index ?? decoder.index ?? undefined;
    const known = [metadata !== null, index !== undefined, reception.size, reception.container].join();
    if (known === this.described) return;
    this.described = known;
    const { blocks, levels, extent, dtype, pointChannels, attributes, plane, exact, masks } = header;
    const { container, size } = reception;
    const prices = index === undefined ? null : pricesOf(index);
    const joined = header.arrangement !== null;
    const facts = { blocks, joined, levels, extent, dtype, pointChannels, attributes, plane, exact };
    const description = { ...facts, holes: masks.holes, container, size, metadata, prices };
    this.tell({ kind: "description", description });
  }
}
