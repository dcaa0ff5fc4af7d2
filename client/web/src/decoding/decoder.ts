/** Decoding a container while its bytes arrive. */
import { ByteBuffer } from "../container/buffer";
import { Capacity } from "../container/capacity";
import { checkOf } from "../container/crc";
import { type Frame, FrameReader, indexExtent, sectionExtent } from "../container/frames";
import { type Header, parseHeader, parseMasks } from "../container/header";
import { parseIndex } from "../container/index-section";
import { parseChunks, parseLayer } from "../container/layers";
import type { Index } from "../container/model";
import { INDEX_GROWTH, indexFrom, readMetadata, takeDigest } from "../container/reader";
import { FOOTER_LENGTH, KIND, type Metadata, parseFooter, parseMetadata } from "../container/sections";
import { Slices, type State } from "../container/slices";
import { UNANNOUNCED } from "../entropy/tiles";
import { CorruptStreamError, TruncatedStreamError } from "../errors";
import { checkSelection, checkSize, type Selection, select, selectedTiles } from "../planning/selection";
import type { Region, Surface } from "../types";
import { Progress } from "./progress";
import { type Coded, Reconstruction } from "./reconstruction";
import { type Shared, View } from "./view";
import { WindowState } from "./window-state";

// What an entry of a layer's table becomes until its segment has been decoded.
const ENTRY = 256;

/** What a decoder may be asked for. */
export interface DecoderOptions extends Selection {
  /** Limit on the memory of the surface, see `Capacity`. */
  readonly maxVertices?: number | null;
}

/** What exists from the header, and the masks, on. */
interface Begun {
  readonly header: Header;
  readonly window: WindowState | null;
  readonly progress: Progress;
  readonly shared: Shared;
}

/**
 * Decodes a container as its bytes come, and gives a `View` for each state whose errors are known.
 *
 * `feed` takes the bytes in file order; `feedAt` takes slices in the order of a plan. Damage throws `CorruptStreamError`
 * with its offset; everything before it stays usable. Bytes are copied: callers may reuse their buffers.
 */
export class Decoder {
  /** All states so far. */
  readonly layers: View[] = [];
  /** How much memory may be taken. */
  readonly capacity: Capacity;
  readonly #module: WebAssembly.Module;
  readonly #selection: Selection;
  readonly #frames = new FrameReader();
  readonly #values: Metadata = {};
  readonly #digest: { value: string | null } = { value: null }; // filled when it comes, for views made before
  readonly #ending: Shared["ending"] = { digest: null, verified: null };
  readonly #loose = new Map<number, { start: number; bytes: ByteBuffer }>(); // unfinished sections, by where each goes on
  readonly #footer = new ByteBuffer();
  #header: Header | null = null;
  #index: Index | null = null;
  #metadata: Metadata | null = null;
  #begun: Begun | null = null;
  #level = 0;
  #pages: Frame | null = null; // of the index, before its root
  #slices: Slices | null = null;
  #focus: Region | null = null; // the region that comes first
  #near: Uint8Array | null = null; // its tiles, once the index is known
  #turned = false;
  #early: { offset: number; data: Uint8Array }[] = [];

  /** `module` is that of `loadKernels`. */
  constructor(module: WebAssembly.Module, options: DecoderOptions = {}) {
    this.#module = module;
    this.#selection = { region: options.region, attributes: options.attributes, level: options.level };
    this.capacity = new Capacity(options.maxVertices);
  }

  /** The header, with the masks once they have come; null before it. */
  get header(): Header | null {
    return this.#header;
  }

  /** The index, once it has come. */
  get index(): Index | null {
    return this.#index;
  }

  /** The metadata, once they have come. */
  get metadata(): Metadata | null {
    return this.#metadata;
  }

  /** Whether the whole surface has arrived; metadata and index may still be missing. */
  get complete(): boolean {
    return this.layers.at(-1)?.complete ?? false;
  }

  /** Bytes received of header, layers and residual; 0 before the first layer is complete. */
  get bytes(): number {
    return this.layers.at(-1)?.bytes ?? 0;
  }

  /** Decode the next bytes of the file; returns the views that they complete. The layers before damage stay usable. */
  feed(data: Uint8Array): View[] {
    const before = this.layers.length;
    this.capacity.take(data.length);
    this.#feed(data);
    return this.layers.slice(before);
  }

  /**
   * Decode a slice of the container that starts at `offset`; returns the views that it completes. Slices must come in the
   * order of a plan. They may be cut anywhere.
   */
  feedAt(offset: number, data: Uint8Array): View[] {
    const before = this.layers.length;
    this.capacity.take(data.length);
    if (this.#slices !== null) {
      this.#takePart(offset, data);
    } else if (offset === this.#frames.position + this.#frames.pending) {
      this.#feed(data);
      if (this.#begun !== null) {
        const early = this.#early;
        this.#early = [];
        for (const { offset: place, data } of early) this.#takePart(place, data);
      }
    } else if (this.#begun === null) {
      this.#early.push({ offset, data: data.slice() });
    } else {
      this.#takeLoose(offset, data);
    }
    return this.layers.slice(before);
  }

  /**
   * Announce another order of the bytes: first what a region needs; with null, the plan's own order. The index must have
   * come before, or be among these bytes. A view is given whenever a layer or level is complete in the region, and when
   * it is complete everywhere. Throws `OptionError` where the header is known and there is no such region.
   */
  focus(region: Region | null): void {
    this.#focus = region;
    this.#turned = true;
    if (this.#header !== null && region !== null) checkSelection({ region }, this.#header);
    this.#followFocus();
  }

  /** Declare that no more bytes will come. Throws `TruncatedStreamError` where the surface is not complete. */
  finish(): void {
    if (this.complete) return;
    const got = this.layers.length;
    const wanted = this.#header?.layerCount;
    const layers = got !== wanted ? `${got} of ${wanted} layers` : `${got} layers without what makes them exact`;
    const bytes = this.#frames.position + this.#frames.pending;
    throw new TruncatedStreamError(
      `expected a whole container, got ${this.#header ? layers : "no header"} in ${bytes} bytes: it is cut short`,
    );
  }

  /** The current state. Throws `TruncatedStreamError` where the first layer is not complete. */
  view(): View {
    const last = this.layers.at(-1);
    if (!last) throw new TruncatedStreamError("expected at least one whole layer, got less");
    return last;
  }

  /** The current state as a surface, at full resolution or at a coarser level. */
  surface(level?: number): Surface {
    return this.view().surface(level);
  }

  #feed(data: Uint8Array): void {
    if (this.#frames.ended) {
      this.#takeFooter(data);
      return;
    }
    for (const frame of this.#frames.feed(data)) this.#take(frame);
    if (this.#frames.ended) this.#takeFooter(this.#frames.rest());
  }

  #take(frame: Frame): void {
    const { kind, offset } = frame;
    const header = this.#header;
    if (kind === KIND.header) {
      this.#takeHeader(frame);
    } else if (header === null) {
      throw new CorruptStreamError(`expected the header, got a section of kind ${kind}`, offset);
    } else if (kind === KIND.masks || kind === KIND.keptMasks) {
      if (!header.awaitsMasks) throw new CorruptStreamError("expected layers, got masks", offset);
      this.#begin(parseMasks(header, frame));
    } else if (this.#begun === null) {
      throw new CorruptStreamError(`expected masks, got a section of kind ${kind}`, offset);
    } else if (kind === KIND.layer) {
      this.#takeLayer(frame, this.#begun);
    } else if (kind === KIND.residual) {
      this.#takeResidual(frame, this.#begun);
    } else if (kind === KIND.metadata) {
      this.#takeMetadata(parseMetadata(frame.payload, frame.payloadOffset));
    } else if (kind === KIND.pages) {
      this.#pages = frame;
    } else {
      this.#takeIndex(frame, header);
    }
  }

  #takeIndex(root: Frame, header: Header): void {
    const pages = this.#pages;
    this.#pages = null;
    if (pages === null) {
      throw new CorruptStreamError("expected the pages of an index before its root, got the root", root.offset);
    }
    this.capacity.take(INDEX_GROWTH * (root.end - pages.offset));
    this.#index = parseIndex(pages, root, header).withMetadata(this.#metadata ?? {}, this.#digest.value);
  }

  #takeFooter(data: Uint8Array): void {
    const offset = this.#frames.position;
    this.#footer.append(data.subarray(0, FOOTER_LENGTH + 1 - this.#footer.length));
    if (this.#footer.length > FOOTER_LENGTH) {
      throw new CorruptStreamError("expected the end of the container, got more bytes", offset + FOOTER_LENGTH);
    }
    if (this.#footer.length === FOOTER_LENGTH) parseFooter(this.#footer.peek(FOOTER_LENGTH), offset);
  }

  #takeHeader(frame: Frame): void {
    if (this.#header !== null) throw new CorruptStreamError("expected one header, got a second", frame.offset);
    const header = parseHeader(frame.payload, frame.payloadOffset, frame.end);
    this.#header = header;
    checkSelection(this.#selection, header);
    checkSize(this.#selection, header, this.capacity);
    if (!header.masked) this.#begin(header);
  }

  #begin(header: Header): void {
    this.#header = header;
    this.#begun = {
      header,
      window: this.#selection.region ? new WindowState(header, this.#selection.region, this.#selection) : null,
      progress: new Progress(header),
      shared: {
        reconstruction: new Reconstruction(this.#module, header),
        metadata: this.#values,
        digest: this.#digest,
        ending: this.#ending,
      },
    };
  }

  #takeLayer(frame: Frame, begun: Begun): void {
    const { header, progress, shared } = begun;
    const number = this.layers.length;
    if (number >= header.layerCount) {
      throw new CorruptStreamError(`expected ${header.layerCount} layers, got more`, frame.offset);
    }
    const { errors, entries, start } = parseLayer(frame.payload, frame.payloadOffset, header);
    this.capacity.take(ENTRY * entries.length);
    const segments: Coded[] = [];
    let place = start;
    for (const { tile, channel, top, passes, length } of entries) {
      const first = progress.advance(tile, channel, top, passes, frame.payloadOffset + place);
      segments.push({ tile, channel, first, passes, data: frame.payload.subarray(place, place + length) });
      place += length;
      this.#level = Math.max(this.#level, header.layout.tiles[tile]!.level);
    }
    for (const segment of segments) shared.reconstruction.add(segment);
    const last = number + 1 === header.layerCount;
    const complete = last && !header.corrected;
    this.#show(begun, {
      number,
      level: this.#level,
      bytes: frame.end,
      rms: errors.rms,
      maxError: errors.maximum,
      channels: errors.channels,
      complete,
      allLayers: last,
      wholeLevel: -1,
      wholeNear: false,
    });
  }

  #takeResidual(frame: Frame, begun: Begun): void {
    const { header, shared } = begun;
    if (this.layers.length !== header.layerCount || !header.corrected) {
      throw new CorruptStreamError("expected layers, got a residual", frame.offset);
    }
    const { errors, chunks } = parseChunks(frame.payload, frame.payloadOffset, header);
    for (const [number, { data, offset }] of chunks.entries()) shared.reconstruction.correct(number, data, offset);
    this.#show(begun, {
      number: this.layers.length,
      level: header.levels,
      bytes: frame.end,
      rms: errors.rms,
      maxError: errors.maximum,
      channels: errors.channels,
      complete: true,
      allLayers: true,
      wholeLevel: -1,
      wholeNear: false,
    });
  }

  #takeMetadata(values: Metadata): void {
    this.#digest.value = takeDigest(values) ?? this.#digest.value;
    this.#metadata = values;
    Object.assign(this.#values, values);
    this.#verify();
  }

  /**
   * Look at the values of the complete state if they need a residual, which may hold anything. Throws
   * `CorruptStreamError` where they are damaged; what came before the residual stays.
   */
  #verify(): void {
    const header = this.#header;
    if (!header?.corrected || !this.complete || (this.#selection.level ?? header.levels) < header.levels) return;
    try {
      this.view().verify();
    } catch (error) {
      if (error instanceof CorruptStreamError) this.layers.pop();
      throw error;
    }
  }

  #show(begun: Begun, made: State): void {
    const { header, progress, shared, window } = begun;
    const { channels, layout } = header;
    const state = progress.snapshot(made.allLayers);
    this.capacity.take(state.length);
    if (made.wholeLevel >= 0) {
      // The index says that there is nothing more of these levels.
      const stop = layout.tilesOf(made.wholeLevel)[1] * channels;
      for (let unit = 0; unit < stop; unit++) if (state[unit] === UNANNOUNCED) state[unit] = 0;
    }
    const near = made.wholeNear ? this.#near : null;
    for (let unit = 0; near && unit < state.length; unit++) {
      if (near[Math.floor(unit / channels)] && state[unit] === UNANNOUNCED) state[unit] = 0;
    }
    window?.putOutside(made, state);
    const info = { ...made, bound: false, ...window?.figures(made) };
    this.layers.push(new View(info, shared, { length: shared.reconstruction.length, state }, this.#selection));
    this.#verify();
  }

  /** Bytes of a plan, once the header is known. */
  #takePart(offset: number, data: Uint8Array): void {
    if (this.#slices === null) this.#takeLoose(offset, data);
    else if (!this.#begun?.window?.take(offset, data)) this.#takeSlice(this.#slices, offset, data);
  }

  /** Bytes that do not continue the file and belong to a service section: the index or the metadata. */
  #takeLoose(offset: number, data: Uint8Array): void {
    const { start, bytes } = this.#loose.get(offset) ?? { start: offset, bytes: new ByteBuffer() };
    this.#loose.delete(offset);
    bytes.append(data);
    const run = bytes.peek(bytes.length);
    const kind = run[0];
    if (kind !== KIND.pages && kind !== KIND.metadata) {
      throw new CorruptStreamError(`expected the index or the metadata, got a section of kind ${kind}`, offset);
    }
    const end = kind === KIND.metadata ? (sectionExtent(run, start)?.end ?? null) : indexExtent(run, start);
    if (end === null || run.length < end) {
      this.#loose.set(start + run.length, { start, bytes });
      return;
    }
    if (run.length > end) {
      throw new CorruptStreamError("expected a section by itself, got bytes after it", start + end);
    }
    if (kind === KIND.metadata) this.#takeMetadata(readMetadata(run.slice(), start));
    else if (this.#begun !== null) this.#takeLooseIndex(run.slice(), start, this.#begun);
  }

  #takeLooseIndex(data: Uint8Array, start: number, begun: Begun): void {
    this.capacity.take(INDEX_GROWTH * data.length);
    const index = indexFrom(data, start, begun.header).withMetadata(this.#metadata ?? {}, this.#digest.value);
    this.#index = index;
    begun.window?.follow(index);
    const finest = begun.window ? this.#selection.level : undefined;
    const slices = new Slices(index, select(index, this.#selection), finest);
    this.#slices = slices;
    if (this.layers.length || this.#frames.partial) {
      // The file was read in its own order so far, and is not any more.
      slices.continueFile(this.#frames.position);
      this.#followFocus();
      this.#takeSlice(slices, this.#frames.position, this.#frames.rest());
      for (const loose of [...this.#loose.values()]) {
        this.#takeSlice(slices, loose.start, loose.bytes.take(loose.bytes.length));
      }
    } else {
      this.#followFocus();
      const state = slices.state();
      if (state !== null) this.#show(begun, state);
    }
  }

  #followFocus(): void {
    if (!this.#turned || this.#slices === null || this.#header === null) return;
    this.#near = this.#focus === null ? null : selectedTiles({ region: this.#focus }, this.#header);
    this.#slices.focus(this.#near);
  }

  #takeSlice(slices: Slices, offset: number, data: Uint8Array): void {
    const begun = this.#begun!;
    const { progress, shared } = begun;
    slices.add(offset, data);
    for (const item of slices.items()) {
      const { range, check } = "segment" in item ? item.segment : item.chunk;
      if (checkOf(item.data) !== check) {
        throw new CorruptStreamError("expected a segment or chunk to match its CRC, got other bytes", range.offset);
      }
      let state: State | null;
      if ("chunk" in item) {
        shared.reconstruction.correct(item.number, item.data, range.offset);
        state = slices.holdChunk(item.chunk);
      } else {
        const { tile, channel, passes, top } = item.segment;
        const told = progress.isKnown(tile, channel) ? 0 : top;
        const first = progress.advance(tile, channel, told, passes, range.offset);
        shared.reconstruction.add({ tile, channel, first, passes, data: item.data });
        state = slices.hold(item.segment);
      }
      if (state !== null) this.#show(begun, state);
    }
    const frame = slices.metadata();
    if (frame !== null) this.#takeMetadata(parseMetadata(frame.payload, frame.payloadOffset));
  }
}

/** Decode a complete container. `module` is that of `loadKernels`. */
export async function decode(
  module: WebAssembly.Module,
  container: Uint8Array,
  maxVertices?: number,
): Promise<Surface> {
  const decoder = new Decoder(module, { maxVertices: maxVertices ?? null });
  decoder.feed(container);
  decoder.finish();
  return decoder.view().surfaceAsync();
}
