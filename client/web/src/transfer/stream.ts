/**
 * A stream: one surface received over as many connections as it takes.
 *
 * It runs in one thread with its decoder. In a page that is a worker, see `connect`; in Node it may be the program's.
 */

import { LodestreamError, OptionError, RemoteError } from "../errors";
import type { Ended } from "../planning/plan";
import { makeTarget, type TargetOptions } from "../planning/target";
import type { Region, Target, ViewInfo } from "../types";
import { RangeTransport } from "./by-ranges";
import { SocketTransport } from "./by-socket";
import type { StreamDecoder } from "./decoding";
import type { Journey } from "./journey";
import { Place } from "./locating";
import type { Progress, StreamOptions, StreamState } from "./options";
import { Link, windowFor } from "./pacing";
import { fromCode } from "./problems";
import { BlobRanges, HttpRanges, type RangeSource } from "./range-sources";
import { ReceiverState } from "./receiver-state";
import { platformSocket } from "./socket";
import { Transports, type UsedTransport } from "./transports";
import { seconds, Waiting } from "./waiting";

/**
 * A surface being received: iterate over it for a view of each layer.
 *
 * If the iteration throws, for example because the server is gone, the stream ends but keeps what it has: earlier views
 * stay usable, and `ended` is truncated.
 */
export class Stream<View extends ViewInfo> implements AsyncIterableIterator<View>, Journey<View> {
  readonly reception: ReceiverState<View>;
  readonly waiting = new Waiting();
  stopped = false;
  turns = 0;

  private readonly transports: Transports | undefined;
  private readonly socket: SocketTransport<View> | undefined;
  private readonly makeRanges: () => RangeTransport<View>;
  private made: RangeTransport<View> | undefined;
  private readonly place: Place | undefined;
  private link: Link | undefined;
  private readonly silence: number;
  private readonly closeTimeout: number;
  private current: StreamState;
  private views: View[] = [];
  private running: Promise<void> | undefined;
  private failure: unknown;
  private truncated = false;
  private closeBy: number | undefined;
  private connections = 0;
  private began: number | undefined;

  /**
   * @param source URL of a surface on a server or of a container file, a file, or what gives ranges of one.
   * @param decoder One that decodes what the target asks for.
   * @throws OptionError
   */
  constructor(
    source: string | Blob | RangeSource,
    target: Target,
    decoder: StreamDecoder<View>,
    private readonly options: StreamOptions = {},
  ) {
    const { token, limitRate } = options;
    this.silence = positive("silence", options.silence ?? 30);
    this.closeTimeout = positive("closeTimeout", options.closeTimeout ?? 5);
    this.link = limitRate === undefined ? undefined : new Link(limitRate);
    if (typeof source === "string") {
      const sockets = options.WebSocket ?? platformSocket();
      const transport = options.transport ?? "auto";
      const own = sockets === undefined && transport === "auto" ? "http" : transport;
      const transports = new Transports(source, own, options.deadline ?? 60, options.pauses);
      const fetch = options.fetch ?? globalThis.fetch.bind(globalThis);
      const place = new Place(transports.url, token, fetch);
      const http = new HttpRanges(place, fetch);
      this.makeRanges = () => new RangeTransport(this, http, options.version, options.ranges);
      const window = options.window ?? (limitRate === undefined ? undefined : windowFor(limitRate));
      this.socket = new SocketTransport(this, place, { token, window }, sockets);
      this.place = place;
      this.transports = transports;
    } else {
      const ranges = source instanceof Blob ? new BlobRanges(source) : source;
      this.makeRanges = () => new RangeTransport(this, ranges, undefined, options.ranges);
    }
    this.reception = new ReceiverState(target, decoder, {
      store: options.store,
      container: options.container,
      size: options.size,
      sink: options.onBytes,
    });
    this.current = { phase: "idle", transport: this.transport };
  }

  /**
   * The URL of the surface or file; undefined for a file of this machine. Of a name it is that of the surface or
   * container to which it leads, once it is known.
   */
  get url(): string | undefined {
    return this.place?.url;
  }

  /** What tells this version of a file from others, as far as its server says: its entity tag, or else its date. */
  get version(): string | undefined {
    return this.made?.version ?? this.options.version;
  }

  /** What to receive, where to stop, and in which order. */
  get target(): Target {
    return this.reception.target;
  }

  /** Why the stream ended; undefined while it has not. After an error it is truncated. */
  get ended(): Ended | undefined {
    return this.reception.ended ?? (this.truncated ? "truncated" : undefined);
  }

  /** What the stream is doing. */
  get state(): StreamState {
    return this.current;
  }

  /** How far the stream has come. */
  get progress(): Progress {
    const { received, planned, size, wireBytes, dataBytes } = this.reception;
    const passed = this.began === undefined ? 0 : seconds() - this.began;
    return { received, planned, size, wireBytes, dataBytes, seconds: passed, connections: this.connections };
  }

  /** The transport in use. */
  get transport(): UsedTransport | "file" {
    return this.transports?.current ?? "file";
  }

  [Symbol.asyncIterator](): this {
    return this;
  }

  /**
   * The next view; done once the stream has ended. A stream that was given another target afterwards goes on.
   *
   * @throws LodestreamError if the stream cannot go on.
   */
  async next(): Promise<IteratorResult<View, undefined>> {
    this.start();
    while (this.views.length === 0 && this.running !== undefined) await this.waiting.woken();
    const view = this.views.shift();
    this.waiting.wake();
    if (view !== undefined) return { value: view, done: false };
    const { failure } = this;
    this.failure = undefined;
    if (failure !== undefined) throw failure;
    return { value: undefined, done: true };
  }

  /** Stop and close the connection, within `closeTimeout`; leaving a loop over the stream does this. */
  async return(): Promise<IteratorResult<View, undefined>> {
    await this.close();
    return { value: undefined, done: true };
  }

  /**
   * Stop the stream at once: no further view is given. At most the credit that is outstanding still arrives.
   *
   * @returns A promise that is kept when the other side has ended, or is gone; it is never broken.
   */
  async stop(): Promise<void> {
    if (this.ended !== undefined) return this.running;
    this.stopped = true;
    this.views.length = 0;
    this.socket?.stop();
    this.waiting.wake();
    if (this.running !== undefined) return this.running;
    this.reception.end("stopped");
    this.tell({ phase: "ended" });
  }

  /** Stop and close the connection, within `closeTimeout`. */
  async close(): Promise<void> {
    this.closeBy = seconds() + this.closeTimeout;
    this.views.length = 0;
    this.socket?.interrupt();
    this.waiting.wake();
    await this.stop();
    this.failure = this.closeBy = undefined;
  }

  /**
   * Receive the data of a region before the rest; undefined: in the target's own order. Allowed at any time.
   *
   * Nothing is sent twice, and the stream ends as it would have. Views then come when a layer is complete in the region,
   * and when it is complete everywhere. Their errors are NaN if more data have arrived than belong to the layer.
   *
   * @throws OptionError if the surface has no such region, or several blocks. While the surface is not known yet, the
   * iteration throws it.
   */
  focus(region: Region | undefined): void {
    if (this.stopped || this.ended !== undefined) return;
    const { first: _, ...rest } = this.target;
    const { first } = makeTarget(region === undefined ? rest : { ...rest, first: region });
    if (!this.socket?.focus(first)) this.reception.focus(first);
    this.turned();
  }

  /**
   * Receive something else of the same surface, in another order or up to another limit. Allowed at any time; after the
   * end, iterate again.
   *
   * @throws OptionError if the target is not valid, the surface cannot meet it, or its window or attributes differ.
   */
  aim(options: TargetOptions): void {
    const target = makeTarget(options);
    if (!this.socket?.retarget(target)) this.reception.retarget(target);
    this.stopped = this.truncated = false;
    this.failure = undefined;
    this.turned();
  }

  /** Change the rate that `limitRate` set, in bytes per second; undefined: as fast as it goes. */
  throttle(rate: number | undefined): void {
    this.link = rate === undefined ? undefined : new Link(rate);
    this.waiting.wake();
  }

  // What the transports need.

  patience(): number {
    if (this.closeBy === undefined) return this.silence;
    return Math.max(Math.min(this.silence, this.closeBy - seconds()), 0.001);
  }

  met(): void {
    this.connections += 1;
    if (this.transports !== undefined) this.transports.met = true;
    if (this.current.phase !== "streaming") this.tell({ phase: "streaming" });
  }

  get portion(): number {
    return this.link?.portion ?? Number.POSITIVE_INFINITY;
  }

  async pace(size: number): Promise<void> {
    const { link } = this;
    if (link === undefined) return;
    const until = seconds() + link.delay(size, seconds());
    while (!this.stopped && this.link === link) {
      const wait = until - seconds();
      if (wait <= 0) return;
      const left = this.reception.tick(seconds());
      if (left === 0) return;
      await this.waiting.woken(Math.min(wait, left ?? wait));
    }
  }

  take(receive: () => View[]): void {
    let views: View[];
    const before = this.progress;
    try {
      views = receive();
    } catch (error) {
      throw error instanceof RemoteError ? fromCode(error.code, error.message) : error;
    }
    if (!this.stopped && views.length > 0) {
      if (this.options.latest) this.views = views.slice(-1);
      else this.views.push(...views);
      this.waiting.wake();
    }
    const now = this.progress;
    const moved = (["wireBytes", "received", "planned", "size"] as const).some((key) => now[key] !== before[key]);
    if (moved) this.options.onProgress?.(now);
  }

  async room(): Promise<void> {
    while (this.views.length > 0 && !this.options.latest && this.closeBy === undefined) {
      const left = this.reception.tick(seconds());
      if (left === 0) return;
      await this.waiting.woken(left);
    }
  }

  // Running.

  private turned(): void {
    this.turns += 1;
    this.waiting.wake();
  }

  private start(): void {
    if (this.running !== undefined || this.ended !== undefined) return;
    this.began ??= seconds();
    const run = async (): Promise<void> => {
      try {
        await this.travel();
      } catch (error) {
        this.truncated = true;
        // Whoever stops or closes has what they want; how the other side takes it is no concern of theirs.
        if (!this.stopped) this.failure = error;
      }
      this.socket?.hangUp();
      this.running = undefined;
      this.tell({ phase: "ended" });
      this.waiting.wake();
    };
    this.running = run();
  }

  private async travel(): Promise<void> {
    const { transports, reception } = this;
    this.tell({ phase: "connecting" });
    transports?.start(seconds());
    while (reception.ended === undefined) {
      const before = reception.cached.total;
      try {
        if (this.socket !== undefined && transports?.current === "ws") await this.socket.travel();
        else {
          this.made ??= this.makeRanges();
          await this.made.travel();
        }
      } catch (error) {
        this.socket?.hangUp();
        if (this.over()) return;
        if (transports === undefined || !(error instanceof LodestreamError)) throw error;
        const pause = transports.failed(error, seconds(), reception.cached.total > before);
        const left = reception.tick(seconds());
        const phase = transports.met ? "reconnecting" : "connecting";
        this.tell({ phase, problem: error.message, pause });
        const until = seconds() + Math.min(pause, left ?? pause);
        while (!this.over() && seconds() < until) await this.waiting.woken(until - seconds());
      }
      this.socket?.hangUp();
    }
  }

  /** Whether a connection that broke is not to be replaced, since nothing more is wanted. */
  private over(): boolean {
    const { reception } = this;
    if (!this.stopped && this.closeBy === undefined && reception.stoppedFor === undefined) {
      if (reception.tick(seconds()) !== 0) return false;
      reception.stoppedFor = "seconds";
    }
    if (reception.ended === undefined) reception.end("stopped");
    return true;
  }

  private tell(state: Omit<StreamState, "transport" | "ended">): void {
    const { ended } = this;
    this.current = { ...state, transport: this.transport, ...(ended === undefined ? {} : { ended }) };
    this.options.onState?.(this.current);
  }
}

function positive(name: string, value: number): number {
  if (!(value > 0)) throw new OptionError(`expected a positive number of seconds for ${name}, got ${value}`);
  return value;
}
