/**
 * What has come of a surface over one or several connections.
 *
 * Bytes of the container go in, views come out. A `Download` or a `RangeDownload` is one connection and ends with it.
 * The state is handed to the next connection, so that bytes that have arrived are not requested again.
 */

import { Capacity } from "../container/capacity";
import type { Header } from "../container/header";
import type { Index } from "../container/model";
import { headerSteps, INDEX_GROWTH, indexFrom, indexSteps } from "../container/reader";
import { checkMetadataLength } from "../container/sections";
import { OptionError, RemoteError, RemoteProtocolError, TooLargeError, TruncatedStreamError } from "../errors";
import { type Place, RangeSet } from "../planning/byte-ranges";
import { type Ended, endOf, type Plan } from "../planning/plan";
import { plan } from "../planning/planner";
import { sameRegion } from "../planning/target";
import { type WindowErrors, wantsWindowErrors, windowErrorsFrom, windowSection } from "../planning/window-errors";
import { MAX_DATA, type Header as ServerHeader } from "../protocol/messages";
import type { ByteRange, Region, Target, ViewInfo } from "../types";
import type { StreamDecoder } from "./decoding";
import { inFileOrder, sure } from "./safe-prefix";
import { MemoryStore, type Store } from "./store";

/** Called with bytes of the container that had not come before, as they come; by then it is known which container. */
export type Sink = (offset: number, data: Uint8Array) => void;

/** What may be given to a receiver state beside its target and decoder. */
export interface ReceiverStateOptions {
  /** All received bytes are stored here too, and bytes that it has are not requested. */
  readonly store?: Store | undefined;
  /** SHA-256 and size of the container, if they are known. */
  readonly container?: string | undefined;
  readonly size?: number | undefined;
  readonly sink?: Sink | undefined;
}

/** What a server is about to send, see the header of the protocol. */
export type Announced = Pick<ServerHeader, "planned" | "index" | "metadata" | "prefix" | "window_errors">;

// What is kept for a slice beside its bytes.
const SLICE = 256;

// Whoever reads a container's index reads its first bytes too.
const HEAD = 4096;

/** One surface being received. */
export class ReceiverState<View extends ViewInfo> {
  /** What to receive, where to stop, and in which order; changed by `focus` and `retarget`. */
  target: Target;
  /** Decodes what has arrived so far. */
  readonly decoder: StreamDecoder<View>;
  /** Bytes of the container that have arrived or were in the store. */
  readonly cached: RangeSet;
  /** SHA-256 of the container, once it is known. */
  container: string | undefined;
  /** Its size in bytes, once it is known. */
  size: number | undefined;
  /** Bytes of the surface that the target needs, once they are known. */
  planned: number | undefined;
  /** The container's index, if the transport or the order needs it, once it has arrived. */
  index: Index | undefined;
  /** The slices that the target needs, once the index is known. */
  plan: Plan | undefined;
  /** Bytes of the surface that are cached. */
  received = 0;
  /** Bytes of the container received, including bytes that were cached already. */
  dataBytes = 0;
  /** Bytes of all messages and answers received. */
  wireBytes = 0;
  /** Why the stream ended; undefined while it has not. */
  ended: Ended | undefined;
  /** Why this side stopped: stopped or seconds. */
  stoppedFor: "stopped" | "seconds" | "channels" | undefined;

  private store: Store | undefined;
  private readonly sink: Sink | undefined;
  private readonly aside = new MemoryStore();
  private readonly fed = new RangeSet();
  private order: Place[] | undefined; // what the decoder is to be given next, from a store; the first one first
  private learning = false; // the order has changed, and the index is needed to know it
  private surface: RangeSet | undefined;
  private wantedSet: RangeSet | undefined;
  private service: readonly [index: Place, metadata: Place, windows?: Place] | undefined;
  private windows: WindowErrors | null = null;
  private section: Place | undefined; // of those bounds, where a server has told it and it is not read
  private bounded = true; // whether the other side tells errors of a window
  private deadline: number | undefined;
  private kept = 0;

  constructor(target: Target, decoder: StreamDecoder<View>, options: ReceiverStateOptions = {}) {
    this.target = target;
    this.decoder = decoder;
    this.store = options.store;
    this.sink = options.sink;
    this.cached = options.store === undefined ? new RangeSet() : options.store.ranges.copy();
    this.container = options.container;
    this.size = options.size;
    if (target.first !== undefined) decoder.focus(target.first);
  }

  /**
   * Declare which container is being received, before its bytes are.
   *
   * @throws RemoteError with the code `other-container` if it differs from the one before.
   */
  identify(container: string | undefined, size: number): void {
    const other = this.container !== undefined && container !== undefined && this.container !== container;
    if (other || (this.size !== undefined && this.size !== size)) {
      throw new RemoteError(
        "other-container",
        `expected container ${this.container ?? ""} of ${this.size} bytes as before, ` +
          `got ${container ?? "one"} of ${size}: the surface has changed`,
      );
    }
    this.container ??= container;
    this.size = size;
  }

  /**
   * Declare what the other side is about to send; returns the views that stored bytes complete.
   *
   * @throws CorruptStreamError if the metadata are longer than allowed in a container.
   */
  expect({ planned, index, metadata, prefix, window_errors }: Announced): View[] {
    checkMetadataLength(metadata[1], metadata[0], true);
    this.planned = planned;
    this.service = window_errors?.[1] ? [index, metadata, window_errors] : [index, metadata];
    this.section = this.windows === null ? this.service[2] : undefined;
    if (this.bounded !== (window_errors !== undefined)) {
      this.bounded = window_errors !== undefined;
      if (this.index !== undefined) this.makePlan(this.index); // a server of another release stops elsewhere
    }
    if (prefix && this.order === undefined) this.follow([[0, planned]], [], [metadata]);
    return this.advance();
  }

  /**
   * Set the container's index, and its bounds of the errors of windows where the target is one; returns the views that
   * stored bytes complete.
   *
   * @throws OptionError if the container cannot meet the target.
   */
  learn(index: Index, windows: WindowErrors | null = null): View[] {
    this.windows = windows;
    this.section = undefined;
    this.makePlan(index);
    return this.advance();
  }

  /**
   * Look for the index among the bytes that are kept, of a container whose size is known.
   *
   * @returns The views that stored bytes complete, or the first bytes that are missing to read the index.
   * @throws CorruptStreamError, TruncatedStreamError, UnsupportedVersionError, TooLargeError if they are not those of a
   * container that can be read.
   * @throws OptionError if the container cannot meet the target.
   */
  find(size: number): { readonly views: View[] } | { readonly missing: Place } {
    const store = this.keep();
    const capacity = new Capacity(this.decoder.capacity.maxVertices);
    const found = stepped(indexSteps(size, capacity), store, size);
    if (isPlace(found)) return { missing: found };
    const section = wantsWindowErrors(this.target, found.header) ? windowSection(found) : null;
    if (section === null) return { views: this.learn(found) };
    for (const missing of store.ranges.missing(section.offset, section.length)) return { missing };
    const data = store.read(section.offset, section.length);
    return { views: this.learn(found, windowErrorsFrom(data, section.offset, found.header)) };
  }

  /**
   * Change which region comes first; undefined: the target's own order.
   *
   * @throws OptionError if the region contains no point, or the surface is known and has no such region.
   */
  focus(region: Region | undefined): void {
    this.decoder.focus(region ?? null);
    const { first: _, ...rest } = this.target;
    this.target = region === undefined ? rest : { ...rest, first: region };
    if (this.index !== undefined) this.makePlan(this.index);
    else this.learning = region !== undefined;
  }

  /**
   * Change what is received and where it stops, while it is being received or after it has ended.
   *
   * @throws OptionError if the window, its level or the attributes differ, which take another decoder; or if the surface
   * is known and cannot meet the target.
   */
  retarget(target: Target): void {
    const names = (some: Target): string => JSON.stringify(some.attributes ?? null);
    if (!sameRegion(target.region, this.target.region) || names(target) !== names(this.target)) {
      throw new OptionError("expected a target with the same region and attributes, got others: open another stream");
    }
    if (target.region !== undefined && target.level !== this.target.level) {
      throw new OptionError("expected a target with the same level of the region, got another: open another stream");
    }
    const { windows, bounded } = this;
    if (this.index !== undefined) plan(this.index, target, undefined, { windows, bounded });
    this.decoder.focus(target.first ?? null);
    this.target = target;
    this.ended = this.stoppedFor = this.deadline = undefined;
    if (this.index !== undefined) this.makePlan(this.index);
    else {
      // Another prefix, or an order that only the index tells: nothing of the last plan holds.
      this.order = this.surface = this.wantedSet = this.planned = undefined;
      this.learning = !inFileOrder(target);
    }
  }

  /**
   * Take bytes of the container; returns the views that they complete.
   *
   * @throws CorruptStreamError, UnsupportedVersionError from the decoder.
   * @throws RemoteProtocolError if the bytes lie outside the container.
   * @throws TooLargeError from the decoder, or if there are more bytes than its capacity.
   */
  take(offset: number, data: Uint8Array): View[] {
    if (this.size !== undefined && offset + data.length > this.size) {
      throw new RemoteProtocolError(`expected bytes of ${this.size}, got those to ${offset + data.length}`);
    }
    this.dataBytes += data.length;
    const views: View[] = [];
    for (const [start, length] of [...this.cached.missing(offset, data.length)]) {
      const slice = data.subarray(start - offset, start - offset + length);
      this.kept += length + SLICE;
      const most = this.decoder.capacity.bytes;
      if (this.kept > most) throw new TooLargeError(`expected at most ${most} bytes of a container, got more`);
      this.cached.add(start, length);
      this.count(start, length);
      this.sink?.(start, slice);
      if (this.store !== undefined) this.store.write(start, slice.slice());
      else {
        this.copy(start, slice);
        this.fed.add(start, length);
        views.push(...this.decoder.feedAt(start, slice));
        this.learnFromDecoder();
      }
    }
    views.push(...this.advance());
    return views;
  }

  /** What the decoder has read of the index is known here too, once the bounds that come behind it are. */
  private learnFromDecoder(): void {
    const index = this.index ?? this.decoder.index;
    if (index === null || (this.index !== undefined && this.section === undefined)) return;
    const windows = this.windowsIn(this.aside, index);
    if (windows !== undefined) this.learn(index, windows);
  }

  /** The bounds of errors of windows that the other side sends; null: none; undefined: not all has come. */
  private windowsIn(store: Store, index: Index): WindowErrors | null | undefined {
    const place = windowSection(index);
    if (this.service?.[2] === undefined || place === null) return null;
    if (!store.ranges.covers(place.offset, place.length)) return undefined;
    return windowErrorsFrom(store.read(place.offset, place.length), place.offset, index.header);
  }

  /** The bytes that are still to come, in order; once the index is known. */
  *missing(): Generator<Place> {
    for (const place of this.order ?? []) yield* this.cached.missing(...place);
  }

  /** The parts of a range that the target needs, cached or not; before that is known, the whole range. */
  wanted(offset: number, length: number): Iterable<Place> {
    return this.wantedSet === undefined ? [[offset, length]] : this.wantedSet.overlap(offset, length);
  }

  /** Keep bytes that the decoder cannot use yet, and in any case those of header, index and metadata. */
  keep(): Store {
    this.store ??= this.aside;
    return this.store;
  }

  /** Offset and length of the container's metadata, once they are known. */
  get metadataPlace(): Place | undefined {
    return this.service?.[1];
  }

  /**
   * Set the time, in seconds of any clock that does not go back; the first call starts the clock.
   *
   * @returns Seconds left of the target's time limit, 0 if it is over; undefined if there is none.
   */
  tick(now: number): number | undefined {
    if (this.target.seconds === undefined) return undefined;
    this.deadline ??= now + this.target.seconds;
    return Math.max(this.deadline - now, 0);
  }

  /**
   * Declare that the other side has sent everything; returns why the stream ended.
   *
   * @throws TruncatedStreamError if that is less than it announced.
   */
  end(why: string): Ended {
    if (why === "stopped") this.ended = this.stoppedFor ?? "stopped";
    else if (this.received < (this.planned ?? 0) || (why === "complete" && !this.decoder.complete)) {
      throw new TruncatedStreamError(`expected ${this.planned} bytes of the surface, got ${this.received} at the end`);
    } else this.ended = why as Ended;
    return this.ended;
  }

  private makePlan(index: Index): void {
    const { windows, bounded } = this;
    const chosen = plan(index, this.target, undefined, { windows, bounded });
    this.index = index;
    // Where a server stops may stand in bounds that it sends and that were not known when the index was read.
    this.learning = this.section !== undefined;
    const known = chosen.before.find((place) => place !== index.index);
    const section = known === undefined ? this.section : placeOf(known);
    const places = [placeOf(index.index), placeOf(index.metadata)] as const;
    this.service = section === undefined ? places : [...places, section];
    this.planned = endOf(chosen).bytes;
    this.plan = chosen;
    const before = chosen.before.map(placeOf);
    if (this.section !== undefined) before.push(this.section);
    this.follow(chosen.ranges.map(placeOf), before, chosen.after.map(placeOf));
  }

  private follow(surface: readonly Place[], before: readonly Place[], after: readonly Place[]): void {
    this.surface = new RangeSet(surface);
    this.received = 0;
    for (const place of this.cached) this.count(...place);
    const all = [...before, ...surface, ...after];
    this.wantedSet = new RangeSet(all);
    if (this.store !== undefined) this.order = all.flatMap((place) => [...this.fed.missing(...place)]);
  }

  private get servicePlaces(): Place[] {
    if (this.service === undefined) return [];
    const [index, metadata, windows] = this.service;
    return windows === undefined ? [index, metadata] : [index, metadata, windows];
  }

  /** Add to `received` what of a range belongs to the surface, once that is known. */
  private count(offset: number, length: number): void {
    if (this.planned === undefined) return;
    const belongs =
      this.surface !== undefined
        ? this.surface.overlap(offset, length)
        : new RangeSet(this.servicePlaces).missing(offset, length);
    for (const [, size] of belongs) this.received += size;
  }

  /** Keep of what the decoder is given at once the parts that tell where things stand. */
  private copy(offset: number, data: Uint8Array): void {
    for (const [start, length] of [[0, HEAD] as Place, ...this.servicePlaces]) {
      const first = Math.max(start, offset);
      const last = Math.min(start + length, offset + data.length);
      if (first < last) this.aside.write(first, data.slice(first - offset, last - offset));
    }
  }

  /** Feed the decoder with what is kept, as far as it goes on. */
  private advance(): View[] {
    const { store } = this;
    if (store === undefined) return [];
    if (this.order === undefined && this.service === undefined) return this.begin(store);
    if (this.order === undefined || this.learning) {
      const learned = this.learnFromStore(store);
      if (this.order === undefined || learned !== undefined) return learned ?? [];
    }
    const views: View[] = [];
    let next = 0;
    const { order } = this;
    while (next < order.length) {
      const [offset, length] = order[next]!;
      const size = Math.min(store.ranges.run(offset), length, MAX_DATA);
      if (size === 0) break;
      if (size === length) next += 1;
      else order[next] = [offset + size, length - size];
      this.fed.add(offset, size);
      views.push(...this.decoder.feedAt(offset, store.read(offset, size)));
      if (this.plan !== undefined) store.used(offset, size);
    }
    order.splice(0, next);
    return views;
  }

  /** Feed the decoder with what is in the plan for certain, before that is made. */
  private begin(store: Store): View[] {
    const views: View[] = [];
    if (!inFileOrder(this.target)) return views;
    let position = this.fed.run(0);
    for (;;) {
      const run = store.ranges.run(position);
      const size = sure(this.target, this.decoder, position, run, (offset, length) => store.read(offset, length));
      if (size === 0) break;
      this.fed.add(position, size);
      views.push(...this.decoder.feedAt(position, store.read(position, size)));
      position += size;
    }
    this.received = this.decoder.layers[this.decoder.layers.length - 1]?.bytes ?? 0;
    return views;
  }

  /** The order of slices stands in the index, which needs the header to be read; undefined: not all is there. */
  private learnFromStore(store: Store): View[] | undefined {
    if (this.index !== undefined) {
      const windows = this.windowsIn(store, this.index);
      return windows === undefined ? undefined : this.learn(this.index, windows);
    }
    if (this.service === undefined || !store.ranges.covers(...this.service[0])) return undefined;
    const [offset, length] = this.service[0];
    const own = this.decoder.header;
    const header = own !== null && !own.awaitsMasks ? own : headerIn(store);
    if (header === undefined) return undefined;
    const { capacity } = this.decoder;
    capacity.promise(0, [], { masked: 0, tables: header.tables });
    capacity.take(INDEX_GROWTH * length);
    const index = indexFrom(store.read(offset, length), offset, header);
    const windows = this.windowsIn(store, index);
    return windows === undefined ? undefined : this.learn(index, windows);
  }
}

/** The header, and the masks after it, in a store; undefined: not all has come. */
function headerIn(store: Store): Header | undefined {
  const run = store.ranges.run(0);
  try {
    const found = stepped(headerSteps(run), store, run);
    return isPlace(found) ? undefined : found;
  } catch (error) {
    if (error instanceof TruncatedStreamError) return undefined;
    throw error;
  }
}

function isPlace(found: object): found is Place {
  return Array.isArray(found);
}

/** What bytes in a store lead to; where some are missing that are needed, the first run of them. */
function stepped<Result extends object>(
  steps: Generator<ByteRange, Result, Uint8Array>,
  store: Store,
  size: number,
): Result | Place {
  for (let step = steps.next(); ; ) {
    if (step.done) return step.value;
    const { offset, length } = step.value;
    const taken = Math.max(Math.min(length, size - offset), 0);
    for (const gap of store.ranges.missing(offset, taken)) return gap;
    step = steps.next(store.read(offset, taken));
  }
}

function placeOf(range: ByteRange): Place {
  return [range.offset, range.length];
}
