/** A stream and its decoder as a `Source` wants them; runs in a worker. */

import type { Header } from "../container/header";
import { Decoder } from "../decoding/decoder";
import type { View } from "../decoding/view";
import { CorruptStreamError, RemoteError, UnsupportedVersionError } from "../errors";
import { loadKernels } from "../kernels/instance";
import { makeTarget, type TargetOptions } from "../planning/target";
import type { WindowErrors } from "../planning/window-errors";
import { isNamed } from "../transfer/locating";
import { PartRanges, type PartReader } from "../transfer/parts";
import { CutShortError } from "../transfer/problems";
import { Stream } from "../transfer/stream";
import type { Surface } from "../types";
import { composed, thinned } from "./compose";
import { type Description, describe, infoOf, NO_DESCRIPTION } from "./description";
import { areHeights, gridOf, placeOf } from "./grids";
import { localErrors } from "./local-errors";
import type { DetailWindow, MomentGrids, NodeValues, Progress, Region, SourceEvents, Target } from "./source";

/** Milliseconds over which the rate is measured. */
const RATE_SPAN = 2000;
/** Milliseconds for which moments wait for the description. */
const PATIENCE = 3000;

/** Receives one surface. */
export class Receiver {
  private stream: Stream<View> | null = null;
  private decoder: Decoder | null = null;
  private views: View[] = [];
  private description: Description | null = null;
  private told = false;
  private target: Target = {};
  private region: Region | null = null;
  private rate: number | null = null;
  private running = false;
  private stopped = false;
  private began = 0;
  private failure: Pick<Progress, "detail" | "code" | "useless"> | null = null;
  private history: { at: number; bytes: number }[] = [];
  private windows: WindowErrors | null = null;
  private askedForErrors = false;
  private whole: { moment: number; surface: Surface } | null = null;
  private headerCame: (header: Header) => void = () => {};

  constructor(private readonly events: SourceEvents) {}

  /** Begins to receive from an address, or from what gives the bytes. */
  async open(url: string | PartReader, token: string | null): Promise<void> {
    this.began = performance.now();
    this.progress();
    const header = new Promise<Header>((resolve) => {
      this.headerCame = resolve;
    });
    const described = (description: Description): void => {
      const late = this.description === NO_DESCRIPTION && description !== NO_DESCRIPTION;
      if (late) this.told = this.askedForErrors = false;
      if (late || this.description === null) this.description = description;
      this.tell();
    };
    // Of a name the stream learns which surface or container it leads to.
    const named = typeof url === "string" && isNamed(url);
    const place = named ? header.then(() => this.stream?.url ?? url) : Promise.resolve(url);
    place.then((known) => describe(known, token, header)).then(described, () => described(NO_DESCRIPTION));
    void header.then(() => setTimeout(() => described(NO_DESCRIPTION), PATIENCE));
    try {
      this.decoder = new Decoder(await loadKernels());
      const source = typeof url === "string" ? url : new PartRanges(url);
      this.stream = new Stream<View>(source, makeTarget(this.options()), this.decoder, {
        token: token ?? undefined,
        limitRate: this.rate ?? undefined,
        latest: true,
        onState: () => this.progress(),
        onProgress: () => {
          this.look();
          this.progress();
        },
      });
      if (this.stopped) await this.stream.stop();
      await this.run();
    } catch (error) {
      this.fail(error);
    }
  }

  /** The grids of a moment, see `Source.grids`. */
  async grids(asked: number | null, level: number, window: DetailWindow | null): Promise<MomentGrids> {
    const header = this.decoder!.header!;
    const moment = asked ?? this.views.length - 1;
    const view = this.views[moment]!;
    const surface = await view.surfaceAsync(level === header.levels ? undefined : level);
    const grids = surface.blocks.map((block, number) => gridOf(block, number, header, this.metadata));
    if (window === null) return { moment, grids };
    const [part] = view.window(window.region).blocks;
    const fine = gridOf(part!, 0, header, this.metadata);
    return { moment, grids: [composed(grids[0]!, thinned(fine, window.stride))] };
  }

  /** The values of a node, see `Source.valuesAt`. */
  async valuesAt(moment: number, block: number, row: number, column: number): Promise<NodeValues> {
    const header = this.decoder!.header!;
    const view = this.views[moment]!;
    const single = header.blocks.length === 1 && header.arrangement === null;
    if (!single && this.whole?.moment !== moment) this.whole = { moment, surface: await view.surfaceAsync() };
    const surface = single
      ? view.window([
          [row, row + 1],
          [column, column + 1],
        ])
      : this.whole!.surface;
    const own = surface.blocks[single ? 0 : block]!;
    const node = single ? 0 : row * own.shape[1] + column;
    if (own.mask?.[node] === 0) throw new Error("expected a point, got a hole");
    const { components, values } = own.points;
    const channels = Array.from({ length: components }, (_, k) => Number(values[node * components + k]));
    const point = areHeights(header)
      ? [...placeOf(this.metadata, header, row, column), ...channels]
      : channels.slice(0, 3);
    const attributes = [...own.attributes].map(([name, array]) => {
      const count = Math.max(array.components, 1);
      return [name, Array.from({ length: count }, (_, k) => Number(array.values[node * count + k]))] as const;
    });
    this.askForErrors();
    const errors = localErrors(view, header, this.windows, this.description?.prices ?? null, row, column);
    return { block, row, column, point, attributes, ...errors };
  }

  /** Asks for the errors of windows, once somebody looks at values; until they are there, those of the whole hold. */
  private askForErrors(): void {
    const { description } = this;
    if (this.askedForErrors || description === null) return;
    this.askedForErrors = true;
    description.windows().then(
      (windows) => {
        this.windows = windows;
        if (windows !== null) this.events.refined();
      },
      () => {},
    );
  }

  /** See `Source`. */
  focus(region: Region | null): void {
    this.region = region;
    const { stream, decoder } = this;
    if (stream === null || stream.ended !== undefined || decoder?.header?.blocks.length !== 1) return;
    try {
      stream.focus(region ?? undefined);
    } catch (error) {
      this.fail(error);
    }
  }

  /** See `Source`. */
  setTarget(target: Target): void {
    this.target = target;
    this.resume();
  }

  /** See `Source`. */
  throttle(rate: number | null): void {
    this.rate = rate;
    this.stream?.throttle(rate ?? undefined);
  }

  /** See `Source`. */
  stop(): void {
    this.stopped = true;
    void this.stream?.stop();
  }

  /** See `Source`. */
  resume(): void {
    this.stopped = false;
    if (this.stream === null) return;
    this.failure = null;
    try {
      this.stream.aim(this.options());
      void this.run();
    } catch (error) {
      this.fail(error);
    }
  }

  private get metadata(): Record<string, unknown> {
    return this.description === NO_DESCRIPTION || this.description === null
      ? (this.decoder?.metadata ?? {})
      : this.description.metadata;
  }

  private options(): TargetOptions {
    const { level, rms, max, bytes, attribute } = this.target;
    const first = this.decoder?.header?.blocks.length === 1 ? (this.region ?? undefined) : undefined;
    const of = (error: number | undefined) =>
      error === undefined || attribute === undefined ? error : { [attribute]: error };
    return { level, untilRms: of(rms), untilMax: of(max), maxBytes: bytes, first };
  }

  /** Takes views until the stream ends; only one of these runs. */
  private async run(): Promise<void> {
    const { stream } = this;
    if (this.running || stream === null) return;
    this.running = true;
    try {
      for (;;) {
        const { done } = await stream.next();
        this.look();
        // A stream that was given another target while it ended goes on.
        if (done && stream.ended !== undefined) break;
      }
    } catch (error) {
      this.fail(error);
    } finally {
      this.running = false;
    }
    this.look();
    this.progress();
  }

  /** Tells of what has come. */
  private look(): void {
    const header = this.decoder?.header;
    // An index is not read before the masks are known, which tell how long its lists are.
    if (header && !header.awaitsMasks) this.headerCame(header);
    this.tell();
  }

  private tell(): void {
    const { decoder, description } = this;
    if (decoder?.header == null || description === null) return;
    if (!this.told) {
      this.told = true;
      const size = description.size || (this.stream?.progress.size ?? 0);
      this.events.info(infoOf(decoder.header, { ...description, size }));
    }
    for (const view of decoder.layers.slice(this.views.length)) {
      const number = this.views.push(view) - 1;
      const { number: layer, level, bytes, rms, maxError: max, complete } = view;
      const seconds = (performance.now() - this.began) / 1000;
      const attributes = attributeErrors(view, decoder.header);
      // Nobody knows the errors of the whole while a region comes first.
      const region = Number.isNaN(rms) ? this.region : null;
      this.events.moment({ number, layer, region, level, bytes, seconds, rms, max, attributes, complete });
    }
  }

  private fail(error: unknown): void {
    const detail = error instanceof Error ? error.message : String(error);
    const code = error instanceof RemoteError ? error.code : "";
    this.failure = { detail, code, useless: isUseless(error) };
    this.progress();
  }

  private progress(): void {
    const { stream } = this;
    const { received = 0, planned = 0 } = stream?.progress ?? {};
    const now = performance.now();
    this.history = [...this.history.filter(({ at }) => now - at < RATE_SPAN), { at: now, bytes: received }];
    const first = this.history[0]!;
    const rate = now - first.at > 200 ? (1000 * (received - first.bytes)) / (now - first.at) : 0;
    this.events.progress({ bytes: received, planned: planned ?? 0, rate: Math.max(rate, 0), ...this.state() });
  }

  private state(): Pick<Progress, "state" | "detail" | "code" | "useless"> {
    const { stream, failure } = this;
    if (failure !== null) return { state: "failed", ...failure };
    const { phase, problem, pause, ended } = stream?.state ?? { phase: "connecting" as const };
    if (phase === "streaming") return { state: "receiving", detail: "" };
    if (phase === "reconnecting") {
      const next = pause === undefined ? "" : `; next attempt in ${pause.toFixed(1)} s`;
      return { state: "resuming", detail: `${problem ?? "the connection broke"}${next}` };
    }
    if (phase !== "ended") return { state: "connecting", detail: problem ?? "" };
    if (ended === "stopped") return { state: "stopped", detail: "" };
    return { state: ended === "complete" ? "complete" : "target", detail: "" };
  }
}

/** Whether bytes that have come do not fit to those that another attempt would bring: only another file can help. */
function isUseless(error: unknown): boolean {
  if (error instanceof RemoteError) return error.code === "other-container";
  return [CorruptStreamError, CutShortError, UnsupportedVersionError].some((kind) => error instanceof kind);
}

/** RMS errors of the attributes, each of all of its components together; NaN where they are not known. */
function attributeErrors({ channels }: View, { attributes }: Header): number[] {
  let last = channels.length;
  const errors = attributes.toReversed().map(({ components }) => {
    const first = last - Math.max(components, 1);
    const squares = Array.from({ length: last - first }, (_, k) => (channels[first + k]?.[0] ?? Number.NaN) ** 2);
    last = first;
    return Math.sqrt(squares.reduce((sum, square) => sum + square, 0));
  });
  return errors.toReversed();
}
