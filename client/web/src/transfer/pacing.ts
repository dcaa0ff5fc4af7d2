/** Receiving at a limited rate: the time that each message would take on a link of that rate. */

import { OptionError } from "../errors";
import { MAX_CREDIT } from "../protocol/messages";

// A window holds a quarter of a second of the link, so that the server is stopped soon, and never less than what carries
// a message and its framing well, nor more than the server grants anyway.
const WINDOW_SECONDS = 0.25;
const WINDOW_LEAST = 1024;

const PORTION_LEAST = 128;

/**
 * A simulated link of limited rate behind the real one: a token bucket without burst; the caller passes the time.
 *
 * Credit is granted only for data that have passed it, so the server adapts its rate.
 */
export class Link {
  private freeAt = Number.NEGATIVE_INFINITY;

  /**
   * @param rate Bytes per second.
   * @throws OptionError if it is not positive.
   */
  constructor(readonly rate: number) {
    if (!(rate > 0)) throw new OptionError(`expected a positive rate, got ${rate}`);
  }

  /** Bytes that arrive at once: a twentieth of a second's. */
  get portion(): number {
    return Math.max(Math.round(this.rate / 20), PORTION_LEAST);
  }

  /** Seconds from `now` until `size` more bytes have passed. */
  delay(size: number, now: number): number {
    this.freeAt = Math.max(this.freeAt, now) + size / this.rate;
    return this.freeAt - now;
  }
}

/** The credit, in bytes, that keeps a link of `rate` bytes per second busy and no more. */
export function windowFor(rate: number): number {
  return Math.round(Math.min(Math.max(rate * WINDOW_SECONDS, WINDOW_LEAST), MAX_CREDIT));
}
