/** The client's end of a stream, without I/O: messages in; views, credit and the last message out. */

import { RemoteError, TruncatedStreamError } from "../errors";
import type { Place } from "../planning/byte-ranges";
import { ErrorLimits } from "../planning/limits";
import { sameRegion } from "../planning/target";
import { Connection } from "../protocol/connection";
import { Window } from "../protocol/flow-control";
import { CODES, type Header, MAX_HELD, type Segments } from "../protocol/messages";
import type { Region, Target, ViewInfo } from "../types";
import type { ReceiverState } from "./receiver-state";

/** What may be given to a download beside its receiver state. */
export interface DownloadOptions {
  /**
   * Bytes that may be in flight at once, 1 to `MAX_CREDIT`, as far as the server keeps so much credit. Up to this many
   * bytes still arrive after `stop`. If it is less than what the link carries in one round trip, the link is idle at
   * times. Left out: measured, with times.
   */
  readonly window?: number | undefined;
  /** For a client that cannot send a header with the handshake; the first message then has no place in an address. */
  readonly token?: string | undefined;
}

/**
 * One connection over which a surface is received.
 *
 * The caller moves messages: it passes each received message to `receive`, and sends whatever `dataToSend` returns, at
 * the start and after every call. When the stream has ended, what `dataToSend` then returns is the last message, and the
 * server closes the connection. If the connection breaks earlier, another `Download` with the same receiver state
 * continues.
 */
export class Download<View extends ViewInfo> {
  /** The server's first message. */
  header: Header | undefined;
  /** The number of bytes that may be in flight. */
  readonly window: Window;
  /** The first message, for use in the address of the handshake, see `opened`; it may not be put there with a token. */
  readonly opening: Uint8Array;

  private readonly connection = new Connection("client");
  private openedAt: number | undefined;
  private turning = false; // this end has stopped in order to open again
  private reopened = false;
  private aiming = false; // with another target, even if the last one is met
  private outbox: Uint8Array[];

  constructor(
    readonly reception: ReceiverState<View>,
    options: DownloadOptions = {},
  ) {
    this.window = new Window(options.window);
    // Of a container that is not known by name, nothing can be said to be cached.
    const held = reception.container === undefined ? [] : largest(reception);
    this.opening = this.openWith(held, reception.container, options.token);
    this.outbox = [this.opening];
  }

  /** Bytes of the container that may still arrive without further credit. */
  get credit(): number {
    return this.connection.credit;
  }

  /** Whether another target can be asked for over this connection. */
  get open(): boolean {
    return this.running || this.stopping;
  }

  /**
   * Take one message; returns the views that it completes. Data that still arrive after `stop` are decoded but give no
   * views. Afterwards `reception.ended` says whether that was the last message.
   *
   * @param now Time in seconds, by the clock used for `tick`; without it a measured window does not change.
   * @param waited Seconds of them for which the caller waited for this message, and did nothing else; the first windows
   * then grow faster.
   * @throws RemoteError if the server refuses, with its code and reason.
   * @throws RemoteProtocolError, UnsupportedVersionError if it is not a message, or not one that is allowed now.
   * @throws CorruptStreamError if the bytes of the container are damaged.
   * @throws TruncatedStreamError if the server ends before it has sent what it announced.
   */
  receive(message: Uint8Array, now?: number, waited?: number): View[] {
    this.reception.wireBytes += message.length;
    if (waited !== undefined) this.window.waited(waited);
    const event = this.connection.receive(message);
    switch (event.type) {
      case "segments":
        return this.take(event, now);
      case "header":
        return this.begin(event, now);
      case "end":
        this.finish(event.why);
        return [];
      case "error":
        throw new RemoteError(event.code, event.detail || event.title);
      default:
        return [];
    }
  }

  /** The messages to send now, in order; each is returned once. */
  dataToSend(): Uint8Array[] {
    const messages = this.outbox;
    this.outbox = [];
    return messages;
  }

  /** Declare that `opening` was part of the handshake's address; `now`: when the handshake began. */
  opened(now: number): void {
    this.outbox = this.outbox.filter((message) => message !== this.opening);
    this.openedAt = now;
  }

  /**
   * Request the data of a region before the rest; undefined returns to the target's own order. Allowed at any time.
   *
   * The server is asked to stop, and the stream is opened again once it has. Data in flight still arrive first.
   *
   * @throws OptionError if the surface is known and has no such region; otherwise the server refuses it.
   */
  focus(region: Region | undefined): void {
    if (sameRegion(region, this.reception.target.first)) return;
    this.reception.focus(region);
    this.turn();
  }

  /**
   * Request something else of the same surface, before the stream has ended. The next answer to it is a new header.
   *
   * @throws OptionError see `ReceiverState.retarget`.
   */
  retarget(target: Target): void {
    this.reception.retarget(target);
    this.turn(true);
  }

  /**
   * End the current order, and open again with the changed target of the receiver state.
   *
   * @param aiming Whether more than the region that comes first has changed, so that what is under way may end and the
   * next target still be wanted.
   */
  turn(aiming = false): void {
    if (this.running) this.outbox.push(this.connection.send({ type: "stop" }));
    else if (!(aiming && this.stopping)) return;
    this.turning = true;
    this.aiming ||= aiming;
  }

  /** Ask the server to stop sending, at once. A second call, or one after the end, does nothing. */
  stop(why: "stopped" | "seconds" | "channels" = "stopped"): void {
    if (this.turning || this.running) this.reception.stoppedFor = why;
    if (this.running) this.outbox.push(this.connection.send({ type: "stop" }));
    this.turning = this.aiming = false;
  }

  /**
   * Set the time, in seconds of any clock that does not go back; stops when the target's time limit is over. The first
   * call starts the clock.
   *
   * @returns Seconds until the stop; undefined if there is no time limit or it is over.
   */
  tick(now: number): number | undefined {
    this.openedAt ??= now;
    if (this.reception.stoppedFor !== undefined || this.reception.ended !== undefined) return undefined;
    const left = this.reception.tick(now);
    if (left !== 0) return left;
    this.stop("seconds");
    return undefined;
  }

  /**
   * Declare that the connection is closed; does nothing if the stream has ended.
   *
   * @param code Close code of the WebSocket, if there was one.
   * @throws RemoteError if the close code stands for an error of the server.
   * @throws TruncatedStreamError if the connection broke before the end.
   */
  connectionLost(code?: number, reason = ""): void {
    if (this.reception.ended !== undefined) return;
    const words = Object.keys(CODES).filter((word) => CODES[word]!.close === code);
    if (words.length > 0) {
      // Where words share a code, the reason begins with the one that is meant.
      const word = words.find((each) => reason.startsWith(each)) ?? words[0]!;
      const detail = reason.startsWith(`${word}: `) ? reason.slice(word.length + 2) : reason;
      throw new RemoteError(word, detail || CODES[word]!.title);
    }
    const closed = code === undefined ? "was lost" : `was closed with code ${code} ${reason}`.trimEnd();
    throw new TruncatedStreamError(
      `expected an end message, got ${this.reception.dataBytes} bytes before the connection ${closed}`,
    );
  }

  private get running(): boolean {
    return this.connection.state === "opened" || this.connection.state === "streaming";
  }

  private get stopping(): boolean {
    return this.connection.state === "withdrawn" || this.connection.state === "stopping";
  }

  private openWith(held: readonly Place[] = [], container?: string, token?: string): Uint8Array {
    const credit = this.window.size;
    this.window.grant(credit);
    const { target } = this.reception;
    const window_errors = target.region === undefined ? undefined : true;
    const opening = { target, credit, held, container, token, window_errors, decodes: true };
    return this.connection.send({ type: "open", ...opening });
  }

  private begin(event: Header, now: number | undefined): View[] {
    this.header = event;
    if (now !== undefined && this.openedAt !== undefined) {
      this.window.heard(now - this.openedAt);
      if (!this.reopened) this.window.began(this.openedAt, now);
    }
    this.window.allow(this.connection.most);
    this.grant(now);
    this.reception.identify(event.container, event.size);
    // What answers the last target says nothing of the one that is asked for next.
    if (this.aiming) return [];
    return this.untilMet(this.reception.expect(event));
  }

  private take(event: Segments, now: number | undefined): View[] {
    const stopped = this.connection.state === "stopping";
    const views = this.reception.take(event.offset, event.data);
    this.window.arrive(event.data.length, now);
    this.grant(now);
    return !stopped || this.turning ? this.untilMet(views) : [];
  }

  /** The views up to the first that meets errors of channels, where the server does not know these: the last. */
  private untilMet(views: View[]): View[] {
    const { target, decoder } = this.reception;
    if (target.channels === undefined || this.turning || this.header?.channels || !decoder.header) return views;
    const limits = new ErrorLimits(target, decoder.header);
    const last = views.findIndex((view) => !view.complete && limits.met(view) !== undefined);
    if (last < 0) return views;
    this.stop("channels");
    return views.slice(0, last + 1);
  }

  private grant(now: number | undefined): void {
    const bytes = this.window.due(this.connection.credit);
    if (bytes === 0 || this.connection.state !== "streaming") return;
    this.outbox.push(this.connection.send({ type: "credit", bytes }));
    this.window.grant(bytes, now);
  }

  private finish(why: string): void {
    if (this.turning && (why === "stopped" || this.aiming)) {
      this.turning = this.aiming = false;
      // The server knows what it has sent, and that nothing more of the last grants will come.
      this.window.restart();
      this.reopened = true;
      this.outbox.push(this.openWith());
      return;
    }
    this.outbox.push(this.connection.send({ type: "bye" }));
    this.reception.end(why);
  }
}

/** What is cached, the smallest ranges left out where there are more than a message may name. */
function largest(reception: ReceiverState<ViewInfo>): Place[] {
  const ranges = [...reception.cached];
  if (ranges.length <= MAX_HELD) return ranges;
  return ranges
    .sort((a, b) => b[1] - a[1])
    .slice(0, MAX_HELD)
    .sort((a, b) => a[0] - b[0]);
}
