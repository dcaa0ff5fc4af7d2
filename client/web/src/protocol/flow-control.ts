/**
 * How much credit a client keeps outstanding, measured from the link.
 *
 * With too little credit the link is idle between grants. With too much, data queue in front of the slowest part of the
 * link, and still have to be received after a `stop`. A link is busy with as many bytes in flight as it carries in one
 * round trip. The window is 1.1 times that, with what the link carries while both ends think, and two messages. It
 * starts small, and grows from one round trip to the next as long as more comes for it, and again where whole windows
 * take hardly longer than the shortest round trip: then the link is idle for lack of credit.
 *
 * Both quantities are measured from the stream itself. The *round-trip time* is the shortest time seen between a grant
 * and the first byte that only this grant allowed, or the time until the first answer; queues make these times longer,
 * never shorter. The *rate* is that at which the last four windows arrived, over at least one round trip, because bytes
 * that were held up arrive together.
 *
 * While the window grows, its *spread* says how much the link would have carried: how long the client waited for the
 * messages of a window, less the longest of these waits, in which the grant was under way. A link that carries a window
 * in a tenth of a round trip takes ten of them. The rest of the time the client computed, which bounds the growth less
 * strictly: the first layers take the most time for their bytes.
 */

import { OptionError } from "../errors";
import { BASE_CREDIT, MAX_CREDIT, MIN_WINDOW } from "./messages";

/** What the smallest `segments` of a long slice carry: for fewer bytes its framing costs too much. */
export const SMALL_MESSAGE = 4096;

/** The window while nothing is known of the link: as much as 256 kbit/s may have to carry after a stop. */
export const FIRST_WINDOW = 32 * 1024;

const GAIN = 1.1;
const GROWTH = 2;
// The most that a window grows by its spread, and of how many times what the client used in a round trip.
const [MOST_GROWTH, FASTER] = [16, 4];
// The spread counts up to so many round trips that a window takes: with more the link is nearly full, or the client so
// slow that its waits say little of the link.
const NEARLY = 1.5;
// Growing has an end when the rate grows by less than this.
const RISE = 1.25;
// A window that takes at most so many round trips was too small for the link. One that is large enough takes 1.15.
const IDLE = 1.1;
// How long both ends together may take to answer, in seconds. A client that computes longer for each message answers so
// much later, but of that no more counts than a part of the round trip.
const [THINKING, MOST_THINKING] = [0.005, 0.25];
// Windows over which the rate is measured: programs that wait for a processor make those of single ones uneven.
const WINDOWS = 4;
// A server's messages are this part of the most credit that there was. Where they are a larger part of the window, since
// it has shrunk or the server is of an earlier release, the window holds as much more.
const SHARES = 16;
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
  private together = 0; // seconds of waits for messages of this window
  private longest = 0; // of these waits
  private messages = 0;
  private largest = 0; // of these messages

  /**
   * @param fixed A constant size, 1 to `MAX_CREDIT`; left out: measured, first `FIRST_WINDOW`, then between `MIN_WINDOW`
   * and what the server allows.
   * @throws OptionError
   */
  constructor(private readonly fixed?: number) {
    if (fixed !== undefined && !(0 < fixed && fixed <= MAX_CREDIT)) {
      throw new OptionError(`expected a window of 1 to ${MAX_CREDIT} bytes, got ${fixed}`);
    }
    this.size = Math.min(fixed ?? FIRST_WINDOW, this.most);
  }

  /** The server keeps so much credit: `BASE_CREDIT` or more. */
  allow(most: number): void {
    this.most = most;
    if (this.fixed !== undefined) this.size = Math.min(this.fixed, most);
  }

  /** The first window was asked for, and is now answered: it is measured from there on, and can then grow. */
  began(asked: number, now: number): void {
    if (this.rounds.length > 0) return;
    this.rounds.push([this.arrived, asked]);
    this.together = this.longest = now - asked;
  }

  /** A round trip took at most this long. */
  heard(seconds: number): void {
    if (seconds > 0 && (this.roundTrip === undefined || seconds < this.roundTrip)) this.roundTrip = seconds;
  }

  /** The client waited so long for a message, with nothing else to do. */
  waited(seconds: number): void {
    this.together += seconds;
    this.longest = Math.max(this.longest, seconds);
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
    this.messages += 1;
    this.largest = Math.max(this.largest, size);
    if (now === undefined || this.fixed !== undefined) return;
    while (this.grants[0] !== undefined && this.grants[0][0] < this.arrived) this.heard(now - this.grants.shift()![1]);
    const last = this.rounds.at(-1);
    if (last === undefined) this.rounds.push([this.arrived, now]);
    else if (this.roundTrip !== undefined && this.arrived - last[0] >= this.size * (1 - 1 / GRANTS)) {
      this.measure(now, this.roundTrip);
    }
  }

  /** Set the window by the one that has just arrived and those before it. */
  private measure(now: number, roundTrip: number): void {
    const [first, begun] = this.rounds[0]!;
    const [start, since] = this.rounds.at(-1)!;
    const [came, took] = [this.arrived - start, now - since];
    const rate = came / Math.max(took, roundTrip);
    const idle = took <= IDLE * roundTrip;
    // Once the link was full, a single window that came early is no reason to grow.
    this.growing = this.growing ? rate >= RISE * this.lastRate : idle && this.wasIdle;
    this.wasIdle = idle;
    this.lastRate = rate;
    let size: number;
    if (this.growing) {
      this.rounds = [];
      size = GROWTH * rate * roundTrip;
      if (took <= NEARLY * roundTrip && !this.wasFull) size = Math.max(size, came * this.growth(took, roundTrip));
    } else {
      this.wasFull = true;
      const answered = roundTrip + this.thinking(took, roundTrip);
      size = ((GAIN * (this.arrived - first)) / Math.max(now - begun, answered)) * answered;
      size += Math.max(2 * SMALL_MESSAGE, this.largest - size / SHARES);
    }
    this.size = Math.trunc(Math.min(Math.max(size, MIN_WINDOW), this.most));
    this.rounds = [...this.rounds, [this.arrived, now] as [number, number]].slice(-WINDOWS);
    this.together = this.longest = this.messages = this.largest = 0;
  }

  /** How many windows like the last one are used in a round trip. */
  private growth(took: number, roundTrip: number): number {
    const { together, longest } = this;
    return roundTrip / Math.max(together - longest, (took - together) / FASTER, roundTrip / MOST_GROWTH);
  }

  /** Seconds between a message and the grant that answers it. */
  private thinking(took: number, roundTrip: number): number {
    const computing = (took - this.together) / this.messages;
    return Math.max(THINKING, Math.min(computing, MOST_THINKING * roundTrip));
  }
}
