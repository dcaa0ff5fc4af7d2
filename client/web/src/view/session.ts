/** A surface coming into focus on a stage: moments in, pictures out; what the view asks for back to the source. */

import { isStill } from "./dom";
import { AGAIN, COMPARED, DONE, remainingShare } from "./ending";
import type { Field, FromGeometry, Hit, ToGeometry } from "./geometry-messages";
import GeometryWorker from "./geometry-worker?worker&inline";
import { firstLevel } from "./levels";
import { pictureChange } from "./picture-change";
import type { DetailWindow, Moment, Progress, Region, Source, SurfaceInfo, Target } from "./source";
import type { Stage } from "./stage";
import { drawingFor, isInside } from "./windows";

type Patches = Extract<FromGeometry, { kind: "patches" }>;

/** What a session tells. */
export interface SessionEvents {
  info(info: SurfaceInfo): void;
  moment(moment: Moment): void;
  progress(progress: Progress): void;
  /** See `SourceEvents`. */
  refined(): void;
  /** Something else is drawn: a picture (`fresh`), or the same in other patches or colours. */
  drawn(patches: Patches, moment: Moment): void;
  failed(detail: string): void;
  /** The view rests, and what is in it is asked for before the rest; null: all of it alike. */
  region(region: Region | null): void;
}

/** How long the view rests before the source is asked for what is in it, in milliseconds. */
const REST = 400;

/** One source on one stage, until `close`. */
export class Session {
  readonly moments: Moment[] = [];
  info: SurfaceInfo | null = null;
  progress: Progress = { state: "connecting", bytes: 0, planned: 0, rate: 0, detail: "" };
  /** Stop when the picture looks done, and go on when it does not any more. */
  endsByItself = true;
  /** The transmission was ended since the picture looks done. */
  looksDone = false;
  /** Share of the drawn pixels that will still change visibly, as estimated for the picture in hand; NaN: not known. */
  remaining = Number.NaN;
  private readonly worker = new GeometryWorker();
  private readonly picks = new Map<number, (hit: Hit | null) => void>();
  private chosen: number | null = null;
  private shown: { moment: Moment; level: number; window: DetailWindow | null } | null = null;
  private before: Moment | null = null;
  private field: Field = { kind: "height" };
  private target: Target = {};
  private awaited: { take(patches: Patches): void; fail(error: Error): void } | null = null;
  private wanted: number | null = null;
  private region: Region | null = null;
  private asked = 0;
  private busy = false;
  private eyeDue = false;
  private outdated = false;
  private closed = false;
  private userStopped = false;
  private triangles: number;
  private eyeTimer: ReturnType<typeof setTimeout> | undefined;
  private focusTimer: ReturnType<typeof setTimeout> | undefined;
  private judgeTimer: ReturnType<typeof setTimeout> | undefined;
  private focused: Region | null = null;

  constructor(
    readonly source: Source,
    private readonly stage: Stage,
    private readonly events: SessionEvents,
    triangles: number,
  ) {
    this.triangles = triangles;
    this.worker.onmessage = ({ data }: MessageEvent<FromGeometry>) => this.take(data);
    this.worker.onerror = (event) => this.failed(event.message || "the geometry worker could not be started");
    this.post({ kind: "most", triangles });
    source.start({
      info: (info) => {
        // What came late may place what is drawn elsewhere.
        this.outdated = this.busy || this.shown !== null;
        this.info = info;
        events.info(info);
        void this.pump();
      },
      moment: (moment) => {
        this.moments.push(moment);
        events.moment(moment);
        if (moment.complete) this.looksDone = false; // the last bytes may have come after it was stopped
        void this.pump();
      },
      progress: (progress) => {
        this.progress = progress;
        events.progress(progress);
      },
      refined: () => events.refined(),
    });
  }

  /** The moment that is drawn; null: none yet. */
  get drawnMoment(): Moment | null {
    return this.shown?.moment ?? null;
  }

  /** Whether new moments are shown as they come. */
  get following(): boolean {
    return this.chosen === null;
  }

  /** Whether a moment was chosen that is not drawn yet. */
  get awaitsChosen(): boolean {
    return this.chosen !== null && this.shown?.moment.number !== this.chosen;
  }

  /** Goes back to a moment, or with null to the latest one and those to come. */
  show(number: number | null): void {
    this.chosen = number;
    void this.pump();
  }

  /** Colours by another field. */
  setField(field: Field): void {
    this.field = field;
    this.remaining = Number.NaN;
    this.post({ kind: "field", field });
  }

  /** Draws at most so many triangles. */
  setTriangles(triangles: number): void {
    this.triangles = triangles;
    this.post({ kind: "most", triangles });
    this.viewChanged();
  }

  /** The camera has moved or the canvas has another size: soon the worker is told, but not while a picture is blended in. */
  viewChanged(): void {
    this.eyeTimer ??= setTimeout(() => {
      this.eyeTimer = undefined;
      this.eyeDue = true;
      if (!this.busy) this.tellEye();
    }, 120);
  }

  /** Where a ray meets what is drawn, see `Stage.ray`. */
  pick(ray: { origin: [number, number, number]; direction: [number, number, number] }): Promise<Hit | null> {
    this.asked += 1;
    const id = this.asked;
    this.post({ kind: "pick", id, ...ray });
    return new Promise((resolve) => this.picks.set(id, resolve));
  }

  /** Ends the transmission. */
  stop(): void {
    this.userStopped = true;
    this.looksDone = false;
    this.source.stop();
  }

  /** Goes on; what cannot be seen is asked for too. */
  resume(): void {
    if (this.looksDone) this.endsByItself = false;
    this.userStopped = false;
    this.looksDone = false;
    this.source.resume();
  }

  /** Another target; goes on. Where it has a limit, the picture ends nothing. */
  setTarget(target: Target): void {
    this.target = target;
    this.userStopped = false;
    this.looksDone = false;
    this.source.setTarget(target);
  }

  /** Ends everything. */
  close(): void {
    this.closed = true;
    clearTimeout(this.eyeTimer);
    clearTimeout(this.focusTimer);
    clearTimeout(this.judgeTimer);
    this.source.close();
    this.worker.terminate();
    for (const resolve of this.picks.values()) resolve(null);
  }

  /** Estimates how much of the picture will still change in this view, and stops where that is little, or goes on. */
  judge(): void {
    const last = this.moments.at(-1);
    if (this.closed || !this.following || this.userStopped || last === undefined || last.complete) return;
    if (this.progress.state !== "receiving" && !this.looksDone) return;
    const limited = Object.values(this.target).some((limit) => limit !== undefined);
    this.remaining = this.endsByItself && !limited ? this.estimate() : Number.NaN;
    const done = this.remaining < DONE;
    if (done && !this.looksDone) {
      this.looksDone = true;
      this.source.stop();
    } else if (!(this.remaining < AGAIN) && this.looksDone && this.shown?.moment === last) {
      this.looksDone = false;
      this.source.resume();
    }
  }

  /** Judges once the view and its colours rest. */
  judgeSoon(): void {
    clearTimeout(this.judgeTimer);
    this.judgeTimer = setTimeout(() => this.judge(), REST);
  }

  /** Which share of the drawn pixels is expected to change visibly after the picture in hand; NaN: not known. */
  estimate(): number {
    const { shown, before, info, field } = this;
    // Colours that show the last change are others with each moment.
    if (info === null || shown === null || before === null || field.kind === "change") return Number.NaN;
    // Outside the region that comes first a layer is not there yet.
    if (![before, shown.moment].every(({ region }) => region === null || isInside(this.region, region)))
      return Number.NaN;
    const change = pictureChange(...this.stage.pictures(COMPARED));
    const finest = Math.min(this.wanted ?? shown.level, info.levels);
    return remainingShare(change, { before, now: shown.moment, finest }, info, field);
  }

  private tellEye(): void {
    if (!this.eyeDue || this.closed || this.shown === null) return;
    this.eyeDue = false;
    this.post({ kind: "eye", eye: this.stage.eye() });
  }

  private post(message: ToGeometry, transfer: Transferable[] = []): void {
    this.worker.postMessage(message, transfer);
  }

  /** Draws the moment that is to be seen, at the level that the view needs, if it is not drawn already. */
  private async pump(): Promise<void> {
    const { info } = this;
    const moment =
      this.chosen === null ? this.moments.at(-1) : this.moments.find(({ number }) => number === this.chosen);
    if (this.busy || this.closed || info === null || moment === undefined) return;
    const [width, height] = this.stage.size;
    const { shown, region } = this;
    const wanted = this.wanted ?? firstLevel(info, width * height);
    const { level, window } = drawingFor(info, this.triangles, wanted, moment.level, region, shown?.window ?? null);
    const finer = window === null ? level : Number.POSITIVE_INFINITY;
    const had = shown === null ? -1 : shown.window === null ? shown.level : Number.POSITIVE_INFINITY;
    const isShown =
      shown?.moment.number === moment.number && had >= finer && (window === null || window === shown.window);
    if (isShown && !this.outdated) return;
    const fresh = shown === null || this.outdated;
    this.outdated = false;
    this.busy = true;
    try {
      const { grids, moment: number } = await this.source.grids(
        this.chosen === null ? null : moment.number,
        level,
        window,
      );
      if (this.closed) return;
      const taken = this.moments.find((other) => other.number === number) ?? moment;
      const came = new Promise<Patches>((take, fail) => {
        this.awaited = { take, fail };
      });
      const buffers = grids.flatMap(({ points, mask, rowsAt, columnsAt, attributes }) =>
        [points, mask, rowsAt, columnsAt, ...attributes.map(({ values }) => values)].flatMap((array) =>
          array === null ? [] : [array.buffer as ArrayBuffer],
        ),
      );
      const { geographic, heights } = info;
      const joined = info.joined || info.blocks.length > 1;
      const [diagonal, relief] = heights ? [0, info.extent] : [info.extent, 0];
      const options = { joined, geographic, heights, diagonal, relief, fresh };
      const drawn = window === null ? level : info.levels - Math.log2(window.stride);
      this.post({ kind: "picture", picture: number, level: drawn, grids, options }, [...new Set(buffers)]);
      const patches = await came;
      if (this.closed) return;
      this.before = patches.patches.some(({ from }) => from !== null) ? (this.shown?.moment ?? null) : null;
      this.shown = { moment: taken, level, window };
      this.remaining = Number.NaN;
      // What is to be followed by another at once is not worth the time.
      const superseded = this.chosen === null && this.moments.at(-1) !== taken;
      const blended = !isStill() && !superseded && patches.patches.some(({ from }) => from !== null);
      await new Promise<void>((resolve) => {
        this.stage.show(patches.patches, true, blended, resolve);
        this.events.drawn(patches, taken);
        this.judge();
      });
    } catch (error) {
      if (!this.closed) this.events.failed(error instanceof Error ? error.message : String(error));
      return;
    } finally {
      this.busy = false;
    }
    this.eyeDue ||= this.wanted === null;
    this.tellEye();
    void this.pump();
  }

  private take(message: FromGeometry): void {
    if (this.closed) return;
    switch (message.kind) {
      case "patches":
        if (message.fresh) {
          this.awaited?.take(message);
          this.awaited = null;
        } else if (this.shown !== null) {
          this.stage.show(message.patches, false, false, () => {});
          this.events.drawn(message, this.shown.moment);
          this.judgeSoon();
        }
        break;
      case "wants":
        this.wanted = message.level;
        this.region = message.region;
        this.judgeSoon();
        this.considerFocus(message.region);
        void this.pump();
        break;
      case "hit":
        this.picks.get(message.id)?.(message.hit);
        this.picks.delete(message.id);
        break;
      case "failed":
        this.failed(message.detail);
        break;
    }
  }

  /** Says so, and waits no longer for a picture that does not come: the next moment may do. */
  private failed(detail: string): void {
    if (this.awaited === null) this.events.failed(detail);
    else this.awaited.fail(new Error(detail));
    this.awaited = null;
  }

  /** Asks for what is in the view before the rest, once the view rests and is another than before. */
  private considerFocus(region: Region | null): void {
    clearTimeout(this.focusTimer);
    if (this.focused === region || overlap(this.focused, region) > 0.7) return;
    this.focusTimer = setTimeout(() => {
      this.focused = region;
      this.source.focus(region);
      this.events.region(region);
    }, REST);
  }
}

/** Points that two regions share, by the points of both together. */
function overlap(a: Region | null, b: Region | null): number {
  if (a === null || b === null) return 0;
  const size = (of: readonly (readonly [number, number])[]): number =>
    of.reduce((product, [from, to]) => product * Math.max(0, to - from), 1);
  const shared = size(
    [0, 1].map((k) => [Math.max(a[k as 0 | 1][0], b[k as 0 | 1][0]), Math.min(a[k as 0 | 1][1], b[k as 0 | 1][1])]),
  );
  return shared / Math.max(size(a) + size(b) - shared, 1);
}
