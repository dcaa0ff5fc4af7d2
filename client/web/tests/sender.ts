/** A server's end of a stream without I/O, as `lodestream.transfer.sender` is, for tests of the client's end. */
import { createHash } from "node:crypto";
import type { Index } from "../src/container";
import { type Place, RangeSet } from "../src/planning/byte-ranges";
import { endOf, type Mark, type Plan } from "../src/planning/plan";
import { plan } from "../src/planning/planner";
import { Connection } from "../src/protocol/connection";
import { type Event, MAX_DATA, type Open } from "../src/protocol/messages";
import type { ByteRange } from "../src/types";

/** All slices of a plan, in order. */
export function slicesOf(plan: Plan): ByteRange[] {
  return [...plan.before, ...plan.ranges, ...plan.after];
}

/** One surface being sent. */
export class Sender {
  readonly connection = new Connection("server");
  readonly given = new RangeSet();
  /** What was sent, in order. */
  readonly sent: Place[] = [];
  private held = new RangeSet();
  private outbox: Event[] = [];
  private slices: Place[] = [];
  private marks: [number, Mark][] = [];
  private provided = 0;
  private most = 0;
  private ended = "complete";
  /** Whether this is a server that knows errors of channels. */
  knowsChannels = true;

  constructor(
    private readonly index: Index,
    private readonly data: Uint8Array,
  ) {}

  /** Take one message. */
  receive(message: Uint8Array): void {
    const event = this.connection.receive(message);
    if (event.type === "open") this.plan(event);
    else if (event.type === "stop" && this.connection.state === "stopping") {
      this.outbox = [{ type: "end", why: "stopped" }];
      this.slices = [];
      this.marks = [];
    }
  }

  /** The next message, if there is one now. */
  next(): Uint8Array | undefined {
    if (this.outbox.length === 0) this.read();
    const event = this.outbox.shift();
    if (event === undefined) return undefined;
    if (event.type === "segments") {
      this.given.add(event.offset, event.data.length);
      this.sent.push([event.offset, event.data.length]);
    }
    return this.connection.send(event);
  }

  private plan(event: Open): void {
    const said = event.held.length > 0 || event.container !== undefined;
    if (said) this.held = new RangeSet(event.held);
    const { channels, ...rest } = event.target;
    const known = this.knowsChannels && channels !== undefined;
    const chosen = plan(
      this.index,
      known ? event.target : rest,
      said ? this.held : new RangeSet([...this.held, ...this.given]),
    );
    const before = chosen.before.reduce((sum, place) => sum + place.length, 0);
    this.slices = slicesOf(chosen).map(({ offset, length }) => [offset, length] as const);
    this.marks = chosen.marks.filter((mark) => mark.sent > 0).map((mark) => [this.provided + before + mark.sent, mark]);
    this.ended = chosen.ended;
    this.outbox.push({
      type: "header",
      container: createHash("sha256").update(this.data).digest("hex"),
      size: this.index.size,
      planned: endOf(chosen).bytes,
      extent: this.index.header.extent,
      index: [this.index.index.offset, this.index.index.length],
      metadata: [this.index.metadata.offset, this.index.metadata.length],
      prefix: chosen.prefix,
      channels: known || undefined,
    });
    if (this.slices.length === 0) this.outbox.push({ type: "end", why: this.ended });
  }

  private read(): void {
    const { credit, state } = this.connection;
    const slice = this.slices[0];
    if (state !== "streaming" || slice === undefined || credit === 0) return;
    this.most = Math.max(this.most, credit);
    const untilMark = this.marks[0] === undefined ? MAX_DATA : this.marks[0][0] - this.provided;
    const share = Math.min(credit, Math.max(Math.floor(this.most / 4), 4096));
    const size = Math.min(slice[1], untilMark, share, MAX_DATA);
    if (size === slice[1]) this.slices.shift();
    else this.slices[0] = [slice[0] + size, slice[1] - size];
    this.outbox.push({ type: "segments", offset: slice[0], data: this.data.slice(slice[0], slice[0] + size) });
    this.provided += size;
    while (this.marks[0] !== undefined && this.marks[0][0] <= this.provided) {
      const [, { number, level, bytes, rms, maxError: max }] = this.marks.shift()!;
      this.outbox.push({ type: "layer", number, level, bytes, rms, max });
    }
    if (this.slices.length === 0) this.outbox.push({ type: "end", why: this.ended });
  }
}
