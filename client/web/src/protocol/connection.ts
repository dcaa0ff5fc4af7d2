/**
 * One end of a stream, without I/O: the order of messages, and the credit.
 *
 * A `Connection` turns received messages into events and events into messages to send. It checks order, credit and
 * ends. It knows nothing of sockets, clocks, or the contents of a container.
 *
 * The client opens. The server answers with a header, then sends slices and layers as far as the credit goes, then
 * ends. The client opens again, for something else of the same surface, or says bye; the server closes. Two things make
 * this more than a list of steps:
 *
 * - *Messages cross.* A `credit` or `stop` may be in flight while the server ends by itself, and slices are in flight
 *   when the client stops. So each side has its own table: after its own `stop` the client still accepts what comes
 *   until `end`; after its own `end` the server still accepts these two until `open` or `bye`.
 * - *Stop takes effect at once.* After `stop` the server may send `end` and nothing else. A client that has stopped is
 *   in one of two states: it may stop before the header has come, and must not accept two headers.
 *
 * An `error` is the server's last message in any state; messages of the client that are still in flight are then
 * accepted and ignored.
 */

import { LocalProtocolError } from "../errors";
import { BASE_CREDIT, type Event, type EventType, MAX_CREDIT, MAX_DATA, MessageError } from "./messages";
import { parse, serialize } from "./wire";

/** The two ends of a stream. */
export type Side = "client" | "server";

/** The states of a side; `TRANSITIONS` lists the transitions. */
export type State = "idle" | "opened" | "streaming" | "withdrawn" | "stopping" | "ended" | "closed" | "failed";

type Moves = Readonly<Partial<Record<EventType, State>>>;

/** For each side and state: what it may send, what it may receive, and the state after it. */
export const TRANSITIONS: Readonly<Record<Side, Readonly<Partial<Record<State, readonly [Moves, Moves]>>>>> = {
  client: {
    idle: [{ open: "opened" }, { error: "failed" }],
    opened: [
      { credit: "opened", stop: "withdrawn" },
      { header: "streaming", error: "failed" },
    ],
    streaming: [
      { credit: "streaming", stop: "stopping" },
      { segments: "streaming", layer: "streaming", end: "ended", error: "failed" },
    ],
    withdrawn: [{}, { header: "stopping", end: "ended", error: "failed" }],
    stopping: [{}, { segments: "stopping", layer: "stopping", end: "ended", error: "failed" }],
    ended: [{ open: "opened", bye: "closed" }, { error: "failed" }],
    closed: [{}, { error: "failed" }],
    failed: [{}, {}],
  },
  server: {
    idle: [{ error: "failed" }, { open: "opened" }],
    opened: [
      { header: "streaming", error: "failed" },
      { credit: "opened", stop: "stopping" },
    ],
    streaming: [
      { segments: "streaming", layer: "streaming", end: "ended", error: "failed" },
      { credit: "streaming", stop: "stopping" },
    ],
    stopping: [{ end: "ended", error: "failed" }, {}],
    ended: [{ error: "failed" }, { open: "opened", credit: "ended", stop: "ended", bye: "closed" }],
    closed: [{}, {}],
    failed: [{}, { open: "failed", credit: "failed", stop: "failed", bye: "failed" }],
  },
};

/** One end of a stream. */
export class Connection {
  /** Current state of this side. */
  state: State = "idle";
  /** Bytes of `segments.data` that the server may still send, or that may still arrive; 0 to `most`. */
  credit = 0;

  /** @param most The most credit that the server keeps, `BASE_CREDIT` to `MAX_CREDIT`; a client learns it. */
  constructor(
    readonly side: Side,
    public most: number = BASE_CREDIT,
  ) {}

  /**
   * The message for an event that this side sends now.
   *
   * @throws LocalProtocolError if the event is not allowed now, or exceeds the credit; nothing has changed then.
   */
  send(event: Event): Uint8Array {
    const moves = this.moves(0);
    const next = moves[event.type];
    if (next === undefined) {
      throw new LocalProtocolError(`expected to send ${this.allowed(moves)}, got ${event.type}`);
    }
    if (event.type === "segments") this.spend(event.data.length);
    else if (event.type === "open") {
      this.credit = 0; // what was left of the last one's ended with it
      this.grant(event.credit, 0);
    } else if (event.type === "credit") this.grant(event.bytes, 1);
    this.state = next;
    return serialize(event);
  }

  /**
   * The event of a message from the other side.
   *
   * @throws MessageError if it is not a message, or not one that is allowed now. Nothing has changed then.
   * @throws UnsupportedVersionError if the other side speaks another version.
   */
  receive(message: Uint8Array): Event {
    const event = parse(message);
    const moves = this.moves(1);
    const next = moves[event.type];
    if (next === undefined) {
      throw new MessageError("out-of-turn", `expected ${this.allowed(moves)}, got ${event.type}`);
    }
    if (event.type === "segments") {
      if (event.data.length > this.credit) {
        throw new MessageError("out-of-turn", `expected at most ${this.credit} bytes, got ${event.data.length}`);
      }
      this.credit -= event.data.length;
    } else if (event.type === "open") this.credit = Math.min(event.credit, this.most);
    else if (event.type === "credit") {
      // What goes beyond the cap is forgotten rather than refused: a client that grants generously loses nothing.
      this.credit = Math.min(this.credit + event.bytes, this.most);
    } else if (event.type === "header") this.most = Math.min(event.credit ?? BASE_CREDIT, MAX_CREDIT);
    this.state = next;
    return event;
  }

  private moves(direction: 0 | 1): Moves {
    return TRANSITIONS[this.side][this.state]?.[direction] ?? {};
  }

  private spend(size: number): void {
    const most = Math.min(this.credit, MAX_DATA);
    if (!(0 < size && size <= most)) {
      throw new LocalProtocolError(`expected 1 to ${most} bytes (the credit is ${this.credit}), got ${size}`);
    }
    this.credit -= size;
  }

  private grant(size: number, least: number): void {
    const most = this.most - this.credit;
    if (!(least <= size && size <= most)) {
      throw new LocalProtocolError(
        `expected ${least} to ${most} bytes of credit on top of ${this.credit}, got ${size}`,
      );
    }
    this.credit += size;
  }

  private allowed(moves: Moves): string {
    return `${Object.keys(moves).join(" or ") || "nothing"} (the ${this.side} is ${this.state})`;
  }
}
