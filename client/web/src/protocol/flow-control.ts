/**
 * How much credit a client keeps outstanding, measured from the link.
 *
 * With too little credit the link is idle between grants. With too much, data queue in front of the slowest part of the
 * link, and still have to be received after a `stop`. A link is busy with as many bytes in flight as it carries in one
 * round trip. The window is 1.1 times that, with what the link carries while both ends think, and two messages. It
 * starts small, and grows fourfold from one round trip to the next as long as more comes for it, and again where whole
 * windows take hardly longer than the shortest round trip: then the link is idle for lack of credit.
 *
 * Both quantities are measured from the stream itself. The *round-trip time* is the shortest time seen between a grant
 * and the first byte that only this grant allowed, or the time until the first answer; queues make these times longer,
 * never shorter. The *rate* is that at which the last four windows arrived, over at least one round trip, because bytes
 * that were held up arrive together.
 */

import { OptionError } from "../errors";
import { BASE_CREDIT, MAX_CREDIT, MIN_WINDOW } from "./messages";

/** What the smallest `segments` of a long slice carry: for fewer bytes its framing costs too much. */
export const SMALL_MESSAGE = 4096;

const GAIN = 1.1;
const GROWTH = 4;
// A window that takes more round trips than this nearly fills the link, and grows half as fast; so does one that was
// large enough before.
const NEARLY = 1.25;
// Growing has an end when the rate grows by less than this.
const RISE = 1.25;
// A window that takes at most so many round trips was too small for the link. One that is large enough takes 1.15.
const IDLE = 1.1;
// How long both ends together may take to answer, in seconds.
const THINKING = 0.005;
// Windows over which the rate is measured: programs that wait for a processor make those of single ones uneven.
const WINDOWS = 4;
// Grants a window at most: few would need a larger window, since the link goes on with what is left between them.
const GRANTS = 32;

/** The window of one connection. Times are seconds of any clock that does not go back. */
export class Window {
  /** Bytes that may be outstanding now. */
  size: number;
  /** Shortest round-trip time seen, in seconds; undefined before one was. */
  roundTrip: number | undefined;
  private most = BASE_CREDIT;
  private granted = 0;
  private arrived = 0;
  private grants: [granted: number, at: number][] = [];
  private rounds: [arrived: number, at: number][] = []; // where, and when, each of the last began
  private growing = true;
  private wasFull = false;
  private wasIdle = false;
  private lastRate = 0;

  /**
   * @param fixed A constant size, 1 to `MAX_CREDIT`; left out: measured, between `MIN_WINDOW` and what the server allows.
   * @throws OptionError
   */
  constructor(private readonly fixed?: number) {
    if (fixed !== undefined && !(0 < fixed && fixed <= MAX_CREDIT)) {
      throw new OptionError(`expected a window of 1 to ${MAX_CREDIT} bytes, got ${fixed}`);
    }
    this.size = Math.min(fixed ?? MIN_WINDOW, this.most);
  }

  /** The server keeps so much credit: `BASE_CREDIT` or more. */
  allow(most: number): void {
    this.most = most;
    if (this.fixed !== undefined) this.size = Math.min(this.fixed, most);
  }

  /** The first window was asked for at this time: it is measured from there on, and can grow when it has come. */
  began(now: number): void {
    if (this.rounds.length === 0) this.rounds.push([this.arrived, now]);
  }

  /** A round trip took at most this long. */
  heard(seconds: number): void {
    if (seconds > 0 && (this.roundTrip === undefined || seconds < this.roundTrip)) this.roundTrip = seconds;
  }

  /** Bytes to grant now, where so many are outstanding; 0 as long as they are not worth a message. */
  due(credit: number): number {
    const missing = this.size - credit;
    return missing >= Math.max(this.size / GRANTS, Math.min(this.size / 4, SMALL_MESSAGE)) ? missing : 0;
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
    this.rounds = [];
  }

  /** This many bytes have arrived and been used. */
  arrive(size: number, now?: number): void {
    this.arrived += size;
    if (now === undefined || this.fixed !== undefined) return;
    while (this.grants[0] !== undefined && this.grants[0][0] < this.arrived) this.heard(now - this.grants.shift()![1]);
    const last = this.rounds.at(-1);
    if (last === undefined) this.rounds.push([this.arrived, now]);
    else if (this.roundTrip !== undefined && this.arrived - last[0] >= this.size) this.measure(now, this.roundTrip);
  }

  /** Set the window by the one that has just arrived and those before it. */
  private measure(now: number, roundTrip: number): void {
    const [first, begun] = this.rounds[0]!;
    const [start, since] = this.rounds.at(-1)!;
    const took = now - since;
    const rate = (this.arrived - start) / Math.max(took, roundTrip);
    const idle = took <= IDLE * roundTrip;
    // Once the link was full, a single window that came early is no reason to grow.
    this.growing = this.growing ? rate >= RISE * this.lastRate : idle && this.wasIdle;
    this.wasIdle = idle;
    this.lastRate = rate;
    let size: number;
    if (this.growing) {
      this.rounds = [];
      const fast = took <= NEARLY * roundTrip && !this.wasFull;
      size = (fast ? GROWTH : GROWTH / 2) * rate * roundTrip;
    } else {
      this.wasFull = true;
      const answered = roundTrip + THINKING;
      size = ((GAIN * (this.arrived - first)) / Math.max(now - begun, answered)) * answered + 2 * SMALL_MESSAGE;
    }
    this.size = Math.trunc(Math.min(Math.max(size, MIN_WINDOW), this.most));
    this.rounds = [...this.rounds, [this.arrived, now] as [number, number]].slice(-WINDOWS);
  }
}
