/**
 * Which transport a stream uses, and when to try again after it broke: the policy, without I/O.
 *
 * The transport is a WebSocket, or HTTP Range if WebSockets do not get through or the URL is that of a plain file.
 */

import { type LodestreamError, NotFoundError, OptionError } from "../errors";
import { isName, isSurface, sourceUrl } from "./addresses";
import { NoStreamError, passes } from "./problems";

/** Transports that may be used: `auto` tries a WebSocket first. */
export type Transport = "auto" | "ws" | "http";

/** A transport. */
export type UsedTransport = "ws" | "http";

/** Seconds between attempts: at random within twice as long each time, so that clients do not return all at once. */
export interface Pauses {
  readonly first: number;
  readonly longest: number;
}

const PAUSES: Pauses = { first: 0.2, longest: 5 };

const FIRST_ATTEMPTS = 3;

/** The transports to one URL. */
export class Transports {
  readonly url: string;
  /** The transport of the next attempt. */
  current: UsedTransport;
  /**
   * Whether the server has answered as expected. Before that there are only three attempts, because a wrong URL should
   * be reported soon.
   */
  met = false;
  private readonly allowed: readonly UsedTransport[];
  private blocked: LodestreamError | undefined; // what became of its WebSocket
  private attempts = 0;
  private since = 0;

  /**
   * @param deadline Seconds without data after a connection was lost, after which the client gives up.
   * @throws OptionError
   */
  constructor(
    url: string,
    transport: Transport,
    private readonly deadline: number,
    private readonly pauses: Pauses = PAUSES,
  ) {
    if (!["auto", "ws", "http"].includes(transport)) {
      throw new OptionError(`expected a transport of auto, ws or http, got ${JSON.stringify(transport)}`);
    }
    if (!(deadline >= 0)) throw new OptionError(`expected 0 or more seconds until the deadline, got ${deadline}`);
    this.url = sourceUrl(url);
    if (!isSurface(this.url) && !isName(this.url)) {
      if (transport === "ws") {
        throw new OptionError(`expected a surface's address for a WebSocket, got that of a file: ${url}`);
      }
      this.allowed = ["http"];
    } else this.allowed = transport === "auto" ? ["ws", "http"] : [transport];
    this.current = this.allowed[0]!;
  }

  /** Begin the first attempt. */
  start(now: number): void {
    this.attempts = 0;
    this.since = now;
  }

  /**
   * Record that an attempt failed; returns the seconds to wait before the next one.
   *
   * @param progressed Whether new data had arrived before.
   * @throws LodestreamError the error itself, if no further attempt is made.
   */
  failed(error: LodestreamError, now: number, progressed: boolean): number {
    if (progressed) this.start(now);
    if (this.current === "ws" && this.allowed.includes("http") && error instanceof NoStreamError && !this.met) {
      this.current = "http";
      this.blocked = error;
      return 0;
    }
    // What is wrong by either transport in the same way, such as the address, is said once.
    const twice = error instanceof NotFoundError || error.message === this.blocked?.message;
    if (this.current === "http" && this.blocked !== undefined && !this.met && !twice) {
      error.message = `${error.message} (and by WebSocket: ${this.blocked.message})`;
    }
    if (!passes(error) || (!this.met && this.attempts >= FIRST_ATTEMPTS - 1)) throw error;
    if (!progressed) this.current = this.allowed[this.current === this.allowed[0] ? this.allowed.length - 1 : 0]!;
    const pause = this.pause();
    if (now + pause >= this.since + this.deadline) throw error;
    return pause;
  }

  private pause(): number {
    this.attempts += 1;
    return Math.random() * Math.min(this.pauses.first * 2 ** Math.min(this.attempts, 10), this.pauses.longest);
  }
}
