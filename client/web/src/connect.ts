/** Receiving a surface: the public API. */

import { OptionError } from "./errors";
import type { Ended } from "./planning/plan";
import { makeTarget, type TargetOptions } from "./planning/target";
import { sourceUrl } from "./transfer/addresses";
import { type Channel, WorkerChannel, type WorkerLike } from "./transfer/channel";
import type { PlainStreamOptions, Progress, StreamState } from "./transfer/options";
import type { Price } from "./transfer/prices";
import type { Description, Kept, Opening, Told } from "./transfer/questions";
import type { SocketClass } from "./transfer/socket";
import type { ChannelErrors, Region, Surface, ViewInfo } from "./types";

/** Options of `connect`; times in seconds. */
export interface ConnectOptions extends PlainStreamOptions {
  /** Called when the state changes: connecting, streaming, reconnecting, ended. */
  readonly onState?: ((state: StreamState) => void) | undefined;
  /** Called when bytes have come. */
  readonly onProgress?: ((progress: Progress) => void) | undefined;
  /** Called when something is known of the surface, and when more of it is. */
  readonly onDescription?: ((description: Description) => void) | undefined;
  /** Called with bytes of the container that had not come before, for a caller that keeps them on its own. */
  readonly onBytes?: ((offset: number, data: Uint8Array) => void) | undefined;
  /** Bytes of the container that were received before; they are not asked for again. */
  readonly kept?: Kept | undefined;
  /** Keep all bytes, for `SurfaceStream.kept`. */
  readonly keep?: boolean | undefined;
  /** Limit on the memory of the surface: 128 bytes for each vertex, and 16 MiB. Left out: 3 GiB. */
  readonly maxVertices?: number | undefined;
  /**
   * Whether to receive and decode in a worker: by default where there are workers. It may also be what makes one, for
   * bundlers and platforms that have their own ways; its program is `serveHost` around its messages.
   */
  readonly worker?: boolean | (() => WorkerLike) | undefined;
  /** In place of the platform's own, without a worker; Node 20 has no WebSocket. */
  readonly WebSocket?: SocketClass | undefined;
  readonly fetch?: typeof globalThis.fetch | undefined;
}

/** One state of a surface on its way. Its values are computed on request, even if more data have arrived since. */
export class SurfaceView implements ViewInfo {
  readonly number: number;
  readonly level: number;
  readonly bytes: number;
  readonly rms: number;
  readonly maxError: number;
  readonly bound: boolean;
  readonly complete: boolean;
  readonly channels: ChannelErrors;

  constructor(
    info: ViewInfo,
    private readonly channel: Channel,
    private readonly view: number,
  ) {
    this.number = info.number;
    this.level = info.level;
    this.bytes = info.bytes;
    this.rms = info.rms;
    this.maxError = info.maxError;
    this.bound = info.bound;
    this.complete = info.complete;
    this.channels = info.channels;
  }

  /**
   * The state as a surface, at full resolution or at a coarser level.
   *
   * @throws OptionError if there is no such level.
   * @throws CorruptStreamError if the SHA-256 of the complete surface is wrong, or no value is finite.
   */
  surface(level?: number): Promise<Surface> {
    return this.channel.ask("surface", this.view, level);
  }

  /**
   * The points of a window, at full resolution or at a coarser level; costs time and memory for the window only. `region`
   * has rows and columns of the full grid at any level; the window of a level has its points that stand there.
   *
   * @throws OptionError if the region is outside the surface or has no point of the level, the surface has several blocks,
   * or there is no such level.
   */
  window(region: Region, level?: number): Promise<Surface> {
    return this.channel.ask("window", this.view, region, level);
  }
}

/**
 * A surface being received: iterate over it for a view of each layer.
 *
 *     for await (const view of connect("https://maps.example.org/v1/surfaces/alps", { untilRms: 0.5 })) {
 *       draw(await view.surface());
 *     }
 *
 * Nothing is asked for before the first view is. If the iteration throws, for example because the server is gone, the
 * stream ends but keeps what it has: earlier views stay usable, until `close`.
 */
export class SurfaceStream implements AsyncIterableIterator<SurfaceView> {
  private readonly opened: Promise<Channel>;
  private channel: Channel | undefined;
  private current: StreamState = { phase: "idle", transport: "http" };
  private reached: Progress = {
    received: 0,
    planned: undefined,
    size: undefined,
    wireBytes: 0,
    dataBytes: 0,
    seconds: 0,
    connections: 0,
  };
  private facts: Description | undefined;

  /** See `connect`. */
  constructor(
    opening: Opening,
    private readonly options: ConnectOptions,
  ) {
    this.opened = this.open(opening);
    this.opened.catch(() => undefined); // whoever asks is told
  }

  /** What the stream is doing. */
  get state(): StreamState {
    return this.current;
  }

  /** How far the stream has come. */
  get progress(): Progress {
    return this.reached;
  }

  /** What is known of the surface; undefined before its header has come. */
  get description(): Description | undefined {
    return this.facts;
  }

  /** Why the stream ended; undefined while it has not. */
  get ended(): Ended | undefined {
    return this.current.ended;
  }

  [Symbol.asyncIterator](): this {
    return this;
  }

  /**
   * The next view; done once the stream has ended. A stream that was given another target afterwards goes on.
   *
   * @throws LodestreamError if the stream cannot go on.
   */
  async next(): Promise<IteratorResult<SurfaceView, undefined>> {
    const channel = await this.opened;
    const found = await channel.ask("next");
    if (found === null) return { value: undefined, done: true };
    return { value: new SurfaceView(found.info, channel, found.number), done: false };
  }

  /** Stop the stream; leaving a loop over it does this. Views stay usable. */
  async return(): Promise<IteratorResult<SurfaceView, undefined>> {
    await (await this.opened).ask("close");
    return { value: undefined, done: true };
  }

  /** Stop the stream at once: no further view is given, and no more bytes come than are under way. */
  async stop(): Promise<void> {
    await (await this.opened).ask("stop");
  }

  /** Receive the data of a region before the rest; undefined: in the target's own order. Allowed at any time.
   *
   * @throws OptionError if the surface has no such region, or several blocks.
   */
  async focus(region: Region | undefined): Promise<void> {
    await (await this.opened).ask("focus", region);
  }

  /**
   * Receive something else of the same surface, in another order or up to another limit. Allowed at any time; after the
   * end, iterate again. What has come is not asked for again.
   *
   * @throws OptionError if the target is not valid, the surface cannot meet it, or its window or attributes differ.
   */
  async aim(target: TargetOptions): Promise<void> {
    const { phase } = this.current;
    await (await this.opened).ask("aim", target);
    if (phase === "ended") {
      const { ended: _, ...rest } = this.current;
      this.current = { ...rest, phase: "idle" };
    }
  }

  /** Receive at most so many bytes per second; undefined: as fast as it goes. */
  async throttle(rate: number | undefined): Promise<void> {
    await (await this.opened).ask("throttle", rate);
  }

  /**
   * What each error costs, from the index or, over a WebSocket, from what the server says of the surface.
   *
   * @throws LodestreamError if the server does not say, or the index of a file has not come yet.
   */
  async prices(): Promise<readonly Price[]> {
    return (await this.opened).ask("prices");
  }

  /** What has come of the container, for a later `connect` with `kept`; only with the option `keep`. */
  async kept(): Promise<Kept> {
    return (await this.opened).ask("kept");
  }

  /** Stop, close the connection, and free everything: views cannot be computed any more. */
  async close(): Promise<void> {
    try {
      const channel = await this.opened;
      await channel.ask("close");
    } catch {
      // Whoever closes has what they want.
    }
    this.channel?.end();
  }

  private async open(opening: Opening): Promise<Channel> {
    const channel = await this.makeChannel((told) => this.take(told));
    this.channel = channel;
    try {
      await channel.ask("open", opening);
    } catch (error) {
      channel.end();
      throw error;
    }
    return channel;
  }

  private async makeChannel(tell: (told: Told) => void): Promise<Channel> {
    const { worker, WebSocket, fetch } = this.options;
    if (typeof worker === "function") return new WorkerChannel(worker(), tell);
    const own = WebSocket !== undefined || fetch !== undefined;
    if (worker && own) throw new OptionError("expected a WebSocket or fetch of one's own without a worker, got both");
    if (worker ?? (typeof Worker !== "undefined" && !own)) {
      const { default: StreamWorker } = await import("./transfer/worker?worker&inline");
      return new WorkerChannel(new StreamWorker(), tell);
    }
    // Apart, so that a page that has workers does not load the decoder twice.
    const { LocalChannel } = await import("./transfer/local-channel");
    return new LocalChannel(tell, { WebSocket, fetch });
  }

  private take(told: Told): void {
    switch (told.kind) {
      case "state":
        this.current = told.state;
        this.reached = told.progress;
        this.options.onState?.(told.state);
        break;
      case "progress":
        this.reached = told.progress;
        this.options.onProgress?.(told.progress);
        break;
      case "description":
        this.facts = told.description;
        this.options.onDescription?.(told.description);
        break;
      case "bytes":
        this.options.onBytes?.(told.offset, told.data);
        break;
    }
  }
}

/**
 * Receive a surface.
 *
 * @param source URL of a surface on a server (`.../v1/surfaces/ID`), of a name there that leads to one
 * (`.../v1/names/NAME`), or of a container file on any web server that knows Range; or a `File` or `Blob`. In a page a URL may be relative.
 * @param target What to receive, where to stop, and in which order; by default the whole surface.
 * @throws OptionError if the target or the URL is not valid; other errors are thrown by the iteration.
 */
export function connect(
  source: string | URL | Blob,
  target: TargetOptions = {},
  options: ConnectOptions = {},
): SurfaceStream {
  makeTarget(target);
  const place = source instanceof Blob ? source : sourceUrl(source, globalThis.document?.baseURI);
  const { token, transport, silence, deadline, closeTimeout, limitRate, window, latest, pauses } = options;
  const plain = { token, transport, silence, deadline, closeTimeout, limitRate, window, latest, pauses };
  const { kept, keep = false, maxVertices, onBytes } = options;
  const tellBytes = onBytes !== undefined;
  return new SurfaceStream({ source: place, target, options: plain, maxVertices, kept, keep, tellBytes }, options);
}
