/**
 * How much credit a client keeps outstanding, measured from the link.
 *
 * With too little credit the link is idle between grants. With too much, data queue in front of the slowest part of the
 * link, and still have to be received after a `stop`. A link is busy with as many bytes in flight as it carries in one
 * round trip. The window is twice that. It starts small: if the link was idle for lack of credit, it doubles from one
 * round trip to the next, otherwise it stays.
 *
 * Both quantities are measured from the stream itself. The *round-trip time* is the shortest time seen between a grant
 * and the first byte that only this grant allowed, or the time until the first answer; queues make these times longer,
 * never shorter. The *rate* is that at which a whole window arrived, over at least one round trip, because bytes that
 * were held up arrive together.
 */

import { OptionError } from "../errors";
import { MAX_CREDIT, MIN_WINDOW } from "./messages";

const GAIN = 2;

/** The window of one connection. Times are seconds of any clock that does not go back. */
export class Window {
  /** Bytes that may be outstanding now. */
  size: number;
  /** Shortest round-trip time seen, in seconds; undefined before one was. */
  roundTrip: number | undefined;
  private readonly measured: boolean;
  private granted = 0;
  private arrived = 0;
  private grants: [granted: number, at: number][] = [];
  private round: [arrived: number, at: number] | undefined;

  /**
   * @param fixed A constant size, 1 to `MAX_CREDIT`; left out: measured, between `MIN_WINDOW` and `MAX_CREDIT`.
   * @throws OptionError
   */
  constructor(fixed?: number) {
    if (fixed !== undefined && !(0 < fixed && fixed <= MAX_CREDIT)) {
      throw new OptionError(`expected a window of 1 to ${MAX_CREDIT} bytes, got ${fixed}`);
    }
    this.size = fixed ?? MIN_WINDOW;
    this.measured = fixed === undefined;
  }

  /** A round trip took at most this long. */
  heard(seconds: number): void {
    if (seconds > 0 && (this.roundTrip === undefined || seconds < this.roundTrip)) this.roundTrip = seconds;
  }

  /** This many bytes have just been granted. */
  grant(size: number, now?: number): void {
    if (now !== undefined && this.granted) this.grants.push([this.granted, now]);
    this.granted += size;
  }

  /** Forget what was granted and has not arrived; it will not arrive any more. */
  restart(): void {
    this.granted = this.arrived;
    this.grants = [];
    this.round = undefined;
  }

  /** This many bytes have arrived and been used. */
  arrive(size: number, now?: number): void {
    this.arrived += size;
    if (now === undefined || !this.measured) return;
    while (this.grants[0] !== undefined && this.grants[0][0] < this.arrived) this.heard(now - this.grants.shift()![1]);
    this.round ??= [this.arrived, now];
    const [start, since] = this.round;
    if (this.roundTrip === undefined || this.arrived - start < this.size) return;
    const rate = (this.arrived - start) / Math.max(now - since, this.roundTrip);
    this.size = Math.round(Math.min(Math.max(GAIN * rate * this.roundTrip, MIN_WINDOW), MAX_CREDIT));
    this.round = [this.arrived, now];
  }
}
