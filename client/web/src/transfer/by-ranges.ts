/** Receiving parts of a file: the loop around a `RangeDownload` that moves bytes. */

import { MIN_WINDOW } from "../protocol/messages";
import type { ViewInfo } from "../types";
import type { Journey } from "./journey";
import { RangeDownload, type RangeLimits, type RangeRequest } from "./range-download";
import type { RangeAnswer, RangeSource } from "./range-sources";
import { seconds } from "./waiting";

/** A request under way: its answer once there is one, and what comes next of it. */
interface Flight {
  readonly request: RangeRequest;
  readonly abort: AbortController;
  answer?: RangeAnswer;
  next: Promise<Landed>;
}

/** An answer, or bytes of its body; undefined at its end. */
interface Landed {
  readonly flight: Flight;
  readonly answer?: RangeAnswer;
  readonly slice?: Uint8Array | undefined;
}

/** Several requests at a time. */
export class RangeTransport<View extends ViewInfo> {
  private readonly download: RangeDownload<View>;
  private readonly flights = new Set<Flight>();
  private turns = 0;

  constructor(
    private readonly journey: Journey<View>,
    private readonly source: RangeSource,
    version?: string,
    limits?: RangeLimits,
  ) {
    this.download = new RangeDownload(journey.reception, version, limits);
  }

  /** Identifies this version of the file: its entity tag, or else its date; undefined if it has neither. */
  get version(): string | undefined {
    return this.download.version;
  }

  /**
   * Receive until the stream ends.
   *
   * @throws LodestreamError if a connection breaks before, or the other side does not do what it should.
   */
  async travel(): Promise<void> {
    const { journey, flights } = this;
    this.turns = journey.turns;
    try {
      for (;;) {
        // First: what was asked to stop has stopped, even if all that there is has come.
        const left = this.tick();
        this.turn();
        this.ask();
        if (journey.reception.ended !== undefined) return;
        const landed = await journey.waiting.first(
          [...flights].map((flight) => flight.next),
          left,
        );
        if (landed !== undefined && flights.has(landed.flight)) await this.land(landed);
        await journey.room();
      }
    } finally {
      for (const flight of [...flights]) this.leave(flight);
    }
  }

  /** Set the time; returns the seconds left of the target's. */
  private tick(): number | undefined {
    const left = this.journey.reception.tick(seconds());
    if (this.journey.stopped) this.download.stop();
    else if (left === 0) this.download.stop("seconds");
    return left;
  }

  /** Where something else is wanted first, leave what would take long. */
  private turn(): void {
    if (this.turns === this.journey.turns) return;
    this.turns = this.journey.turns;
    for (const flight of [...this.flights]) if (flight.request.left > MIN_WINDOW) this.leave(flight);
  }

  private ask(): void {
    for (;;) {
      let request: RangeRequest | undefined;
      this.journey.take(() => {
        const asked = this.download.request(seconds());
        request = asked.request;
        return asked.views;
      });
      if (request === undefined) return;
      this.launch(request);
    }
  }

  private launch(request: RangeRequest): void {
    const abort = new AbortController();
    const asked = this.source.ask(request, () => this.journey.patience(), abort.signal);
    const flight: Flight = { request, abort, next: asked.then((answer) => ({ flight, answer })) };
    flight.next.catch(ignore);
    this.flights.add(flight);
  }

  private async land({ flight, answer, slice }: Landed): Promise<void> {
    const { journey, download } = this;
    if (answer !== undefined) {
      download.answer(flight.request, answer.status, answer.headers, seconds());
      journey.met();
      flight.answer = answer;
    } else if (slice !== undefined) {
      await this.use(flight.request, slice);
    } else {
      this.flights.delete(flight);
      download.finish(flight.request, seconds());
      return;
    }
    // More is asked for when these bytes have been used.
    flight.next = flight.answer!.read().then((next) => ({ flight, slice: next }));
    flight.next.catch(ignore);
  }

  /** Take bytes of an answer, at a limited rate little by little. */
  private async use(request: RangeRequest, slice: Uint8Array): Promise<void> {
    const { journey, download } = this;
    for (let start = 0; start < slice.length && !journey.stopped; ) {
      const portion = slice.subarray(start, start + journey.portion);
      await journey.pace(portion.length);
      this.tick();
      if (journey.reception.ended !== undefined) return;
      journey.take(() => download.receive(request, portion));
      start += portion.length;
    }
  }

  private leave(flight: Flight): void {
    this.flights.delete(flight);
    this.download.leave(flight.request);
    flight.abort.abort();
  }
}

/** Of a request that is left nobody asks what became of it; of others the loop does. */
function ignore(): void {}
