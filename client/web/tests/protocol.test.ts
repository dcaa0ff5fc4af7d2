/** The stream protocol in TypeScript is what docs/protocol.md says. */
import { readFileSync } from "node:fs";
import { join } from "node:path";
import { encode } from "@msgpack/msgpack";
import fc from "fast-check";
import { describe, expect, it } from "vitest";
import { LocalProtocolError, RemoteProtocolError, UnsupportedVersionError } from "../src/errors";
import { unpack } from "../src/msgpack";
import { makeTarget } from "../src/planning/target";
import { Connection, TRANSITIONS } from "../src/protocol/connection";
import { MAX_OPENING, toAddress } from "../src/protocol/handshake";
import {
  BASE_CREDIT,
  CODES,
  type Event,
  MAX_CREDIT,
  MAX_DATA,
  MAX_HELD,
  MAX_MESSAGE,
  MessageError,
  MIN_WINDOW,
  VERSION,
} from "../src/protocol/messages";
import { parse, serialize } from "../src/protocol/wire";
import { ROOT } from "./golden";
import { run } from "./python";
import { hex, recording } from "./recording";

const PAGE = readFileSync(join(ROOT, "docs/protocol.md"), "utf8");
const DIGEST = "0123456789abcdef".repeat(4);

/** The rows of the table with these headings. */
function table(...header: string[]): string[][] {
  const lines = PAGE.split("\n");
  const start = lines.indexOf(`| ${header.join(" | ")} |`) + 2;
  expect(start).toBeGreaterThan(2);
  const rows: string[][] = [];
  for (const line of lines.slice(start)) {
    if (!line.startsWith("|")) break;
    rows.push(
      line
        .slice(1, -1)
        .split("|")
        .map((cell) => cell.trim()),
    );
  }
  return rows;
}

describe("docs/protocol.md", () => {
  it("has the transitions of both sides", () => {
    const cell = (moves: object) =>
      Object.entries(moves)
        .map(([type, after]) => `\`${type}\` → ${after}`)
        .join(", ");
    const made = Object.entries(TRANSITIONS).flatMap(([side, states]) =>
      Object.entries(states).map(([state, [sends, receives]]) => [side, state, cell(sends), cell(receives)]),
    );
    expect(made).toEqual(table("side", "state", "sends", "receives"));
  });

  it("has the codes", () => {
    const made = Object.entries(CODES).map(([word, { close, title }]) => [`\`${word}\``, String(close), title]);
    expect(made).toEqual(table("code", "close code", "title"));
  });

  it("has the limits", () => {
    for (const limit of [BASE_CREDIT, MAX_CREDIT, MAX_DATA, MAX_MESSAGE, MAX_HELD, MIN_WINDOW, MAX_OPENING]) {
      expect(PAGE).toContain(limit.toLocaleString("en"));
    }
  });

  it.each(recording().filter((entry) => entry.side !== "lost"))("has message $number, which is read", (entry) => {
    const event = parse(entry.message);
    expect(event.type).toBe(entry.name);
    // Numbers that are whole are integers here: what the server writes is only read.
    if (entry.side === "client") expect(hex(serialize(event))).toBe(hex(entry.message));
    else expect(parse(serialize(event))).toEqual(event);
  });
});

const integer = fc.maxSafeNat();
const positive = fc.integer({ min: 1, max: Number.MAX_SAFE_INTEGER });
const place = fc.tuple(integer, positive);
const finite = fc.double({ noNaN: true, noDefaultInfinity: true }).map((value) => (value === 0 ? 0 : value));
const limit = fc.record({ value: fc.double({ min: 0, max: 1e300, noNaN: true }), relative: fc.boolean() });
const span = fc.tuple(fc.nat(1000), fc.integer({ min: 1, max: 1000 })).map(([start, size]) => [start, start + size]);
const region = fc.tuple(span, span) as unknown as fc.Arbitrary<[[number, number], [number, number]]>;
const order = fc.constantFrom("quality" as const, "level" as const);
const target = fc
  .oneof(
    fc.record({ level: integer, order, first: region }, { requiredKeys: [] }),
    fc.record(
      { untilRms: limit, untilMax: limit, maxBytes: positive, order, region, attributes: fc.uniqueArray(fc.string()) },
      { requiredKeys: [] },
    ),
  )
  .map((options) => makeTarget(options));
const data = fc.uint8Array({ minLength: 1, maxLength: 300 });
const event: fc.Arbitrary<Event> = fc.oneof(
  fc.record({
    type: fc.constant("open" as const),
    target,
    credit: integer,
    held: fc.array(place, { maxLength: 5 }),
    container: fc.constantFrom(undefined, DIGEST),
    token: fc.constantFrom(undefined, "lode_dG9rZW4"),
  }),
  fc.record({ type: fc.constant("credit" as const), bytes: positive }),
  fc.constantFrom({ type: "stop" as const }, { type: "bye" as const }),
  fc.record({
    type: fc.constant("header" as const),
    container: fc.constant(DIGEST),
    size: integer,
    planned: integer,
    extent: finite,
    index: place,
    metadata: place,
    prefix: fc.boolean(),
  }),
  fc.record({ type: fc.constant("segments" as const), offset: integer, data }),
  fc.record({
    type: fc.constant("layer" as const),
    number: integer,
    level: integer,
    bytes: integer,
    rms: fc.oneof(finite, fc.constant(Number.NaN)),
    max: finite,
  }),
  fc.record({ type: fc.constant("end" as const), why: fc.string() }),
  fc.record({
    type: fc.constant("error" as const),
    code: fc.constantFrom(...Object.keys(CODES)),
    title: fc.string(),
    detail: fc.string({ unit: "grapheme" }),
  }),
);

describe("messages", () => {
  it("are read as they were written", () => {
    fc.assert(
      fc.property(event, (sent) => {
        const known = Object.fromEntries(Object.entries(sent).filter(([, value]) => value !== undefined));
        const read = Object.fromEntries(Object.entries(parse(serialize(sent))).filter(([, v]) => v !== undefined));
        expect(read).toEqual(known);
      }),
    );
  });

  it("repeat what a stranger sent in printable letters alone, and shortened", () => {
    for (const order of ["\u007fuality", "ordn\u00fcng", "\u202egnp", "x".repeat(5000)]) {
      const message = encodable({ type: "open", version: 1, target: { order }, credit: 65536, held: [], token: null });
      try {
        parse(message);
        expect.unreachable();
      } catch (error) {
        if (!(error instanceof MessageError)) throw error;
        expect(error.message).toMatch(/^expected order quality or level, got [ -~]{3,200}$/);
      }
    }
  });

  it("are refused as such, whatever the bytes", () => {
    const bytes = fc.oneof(
      fc.uint8Array({ maxLength: 200 }),
      fc.tuple(event, fc.nat(), fc.nat(255)).map(([sent, at, value]) => {
        const message = serialize(sent).slice();
        message[at % message.length] = value;
        return message;
      }),
      fc.tuple(event, fc.nat()).map(([sent, at]) => {
        const message = serialize(sent);
        return message.subarray(0, at % message.length);
      }),
      fc
        .dictionary(fc.constantFrom("type", "version", "credit", "held", "data", "bytes", "target"), fc.anything())
        .map((fields) => encodable({ type: "open", version: 1, ...fields })),
    );
    fc.assert(
      fc.property(bytes, (message) => {
        try {
          parse(message);
        } catch (error) {
          if (!(error instanceof MessageError) && !(error instanceof UnsupportedVersionError)) throw error;
          expect(error.message).toMatch(/^[ -~]*$/);
        }
      }),
      { numRuns: 2000 },
    );
  });

  it.each([
    [{ type: "open", credit: 1 }, /open.version/],
    [{ type: "open", version: 1 }, /expected open.credit/],
    [{ type: "nonsense" }, /expected a type out of open, credit/],
    [{ type: 3 }, /expected a type out of/],
    [{ type: "toString" }, /expected a type out of/],
    [["open"], /expected a MessagePack map/],
    [{ type: "credit", bytes: 0 }, /integer from 1/],
    [{ type: "credit", bytes: 1.5 }, /integer from 1/],
    [{ type: "credit", bytes: true }, /integer from 1/],
    [{ type: "credit", bytes: -3 }, /integer from 1/],
    [{ type: "segments", offset: 0, data: new Uint8Array(0) }, /1 to 65536 bytes/],
    [{ type: "segments", offset: 0, data: "text" }, /1 to 65536 bytes/],
    [{ type: "segments", offset: -1, data: new Uint8Array(1) }, /segments.offset to be an integer/],
    [{ type: "layer", number: 0, level: 0, bytes: 0, rms: Number.POSITIVE_INFINITY, max: 0 }, /finite number/],
    [{ type: "end" }, /expected end.why/],
    [{ type: "header", container: DIGEST.toUpperCase() }, /64 hexadecimal/],
    [
      { type: "header", container: DIGEST, size: 1, planned: 1, extent: 1, index: [1], metadata: [1, 1], prefix: true },
      /header.index to be \[offset, length\]/,
    ],
    [{ type: "open", version: 1, credit: 1, held: [[1, 0]] }, /integer from 1/],
    [{ type: "open", version: 1, credit: 1, target: { level: 2, max_bytes: 3 } }, /got both/],
    [{ type: "open", version: 1, credit: 1, target: { until_rms: [1, 1] } }, /whether it is relative/],
    [
      {
        type: "open",
        version: 1,
        credit: 1,
        target: {
          first: [
            [3, 3],
            [0, 1],
          ],
        },
      },
      /at least one row/,
    ],
  ])("%j is refused by name", (fields, expected) => {
    expect(() => parse(encode(fields))).toThrow(expected);
    expect(() => parse(encode(fields))).toThrow(RemoteProtocolError);
  });

  it("of another version are refused by both versions", () => {
    const other = encode({ type: "open", version: VERSION + 1, credit: 1 });
    expect(() => parse(other)).toThrow(
      new UnsupportedVersionError("expected version 1 of the protocol, got version 2"),
    );
  });

  it("have bounds", () => {
    expect(() => parse(new Uint8Array(MAX_MESSAGE + 1))).toThrow(/at most 66560 bytes/);
    const held = Array.from({ length: MAX_HELD + 1 }, (_, at) => [2 * at, 1]);
    expect(() => parse(encode({ type: "open", version: 1, credit: 1, held }))).toThrow(/at most 4096 ranges/);
    expect(parse(encode({ type: "segments", offset: 0, data: new Uint8Array(MAX_DATA) })).type).toBe("segments");
  });

  it("may have keys from the future, and integers where a number is meant", () => {
    const layer = { type: "layer", number: 0, level: 0, bytes: 1, rms: 2, max: 3, later: [{ x: [null, 2n ** 60n] }] };
    expect(parse(encode(layer, { useBigInt64: true }))).toEqual({
      ...{ type: "layer", number: 0, level: 0, bytes: 1, rms: 2, max: 3 },
    });
    expect(parse(encode({ type: "layer", number: 0, level: 0, bytes: 1 }))).toMatchObject({ rms: Number.NaN });
    expect(parse(encode({ type: "open", version: 1, credit: 5, target: { level: null } }))).toMatchObject({
      target: { order: "quality" },
    });
  });

  it("do not make room for what they only announce", () => {
    // Arrays of four thousand million items, one in another.
    const deep = new Uint8Array(60_000);
    for (let at = 0; at < deep.length; at += 5) deep.set([0xdd, 0xff, 0xff, 0xff, 0xff], at);
    expect(() => parse(deep)).toThrow(MessageError);
    const nested = new Uint8Array(60_000).fill(0x91);
    expect(() => parse(nested)).toThrow(/nested more than 1024 deep/);
    expect(() => parse(Uint8Array.of(0x81, 0xa4, 0x74, 0x79, 0x70, 0x65, 0xa2, 0xff, 0xfe))).toThrow(MessageError);
  });
});

const SEED = Number(process.env.SEED ?? Math.floor(Math.random() * 2 ** 30));

describe(`random messages, seed ${SEED}`, () => {
  it("are taken for what Python takes them for", () => {
    const verdict = (message: Uint8Array): string => {
      try {
        return parse(message).type;
      } catch (error) {
        if (error instanceof MessageError) return error.code;
        if (error instanceof UnsupportedVersionError) return "unsupported-version";
        throw error;
      }
    };
    const seen = new Set<string>();
    for (const line of run("tests.web.messages", SEED, 20_000).trim().split("\n")) {
      const [text, expected] = JSON.parse(line) as [string, string];
      const message = new Uint8Array(Buffer.from(text, "hex"));
      const found = verdict(message);
      // Floats that are whole are integers here, and keys are text only.
      const lenient = expected === "bad-message" && (message.includes(0xcb) || message.includes(0xca));
      if (!lenient && !differs(message)) expect(found, text).toBe(expected);
      seen.add(found);
    }
    for (const each of ["bad-message", "bad-target", "unsupported-version", "segments", "header", "open"]) {
      expect(seen).toContain(each);
    }
  });
});

/** Whether a message has a key that is bytes, which Python ignores where it is not known. */
function differs(message: Uint8Array): boolean {
  try {
    unpack(message);
    return false;
  } catch (error) {
    return /a key that is not text/.test((error as Error).message);
  }
}

describe("unpack", () => {
  it("takes what MessagePack can hold", () => {
    const value = { text: "höhe", deep: [[1, -5, 2.5], null, true, 2n ** 60n], bytes: new Uint8Array([1, 2]) };
    expect(unpack(encode(value, { useBigInt64: true }))).toEqual(value);
    const nested = (depth: number) => Uint8Array.from({ length: depth + 1 }, (_, at) => (at < depth ? 0x91 : 0xc0));
    expect(JSON.stringify(unpack(nested(1024)))).toBe(`${"[".repeat(1024)}null${"]".repeat(1024)}`);
    expect(() => unpack(nested(1025))).toThrow(/nested more than 1024 deep/);
  });

  it("takes the last value of a key that a map has twice, as Python does", () => {
    const twice = Uint8Array.from([0x83, 0xa1, 97, 1, 0xa1, 98, 0x82, 0xa1, 97, 3, 0xa1, 97, 4, 0xa1, 97, 2]);
    expect(unpack(twice)).toEqual({ a: 2, b: { a: 4 } });
    const text = (word: string) => [0xa0 + word.length, ...new TextEncoder().encode(word)];
    const message = [...text("type"), ...text("credit"), ...text("bytes"), 7];
    expect(parse(Uint8Array.from([0x83, ...text("bytes"), 5, ...message]))).toEqual(
      parse(Uint8Array.from([0x82, ...message])),
    );
  });
});

describe("a connection", () => {
  it("allows each side what the table says, and no credit beyond the most", () => {
    const client = new Connection("client");
    const open: Event = { type: "open", target: makeTarget(), credit: 100, held: [] };
    expect(() => client.send({ type: "bye" })).toThrow(LocalProtocolError);
    const server = new Connection("server");
    expect(server.receive(client.send(open))).toMatchObject({ credit: 100 });
    expect(() => client.send({ type: "credit", bytes: BASE_CREDIT })).toThrow(/1 to 262044 bytes of credit/);
    expect(() => client.send(open)).toThrow(/expected to send credit or stop \(the client is opened\), got open/);
    const header: Event = {
      ...{ type: "header", container: DIGEST, size: 300, planned: 200, extent: 1 },
      ...{ index: [200, 50], metadata: [250, 50], prefix: true },
    };
    client.receive(server.send(header));
    expect(() => client.receive(serialize(header))).toThrow(/expected segments or layer or end or error/);
    expect(() => server.send({ type: "segments", offset: 0, data: new Uint8Array(101) })).toThrow(/1 to 100 bytes/);
    const lie = serialize({ type: "segments", offset: 0, data: new Uint8Array(101) });
    expect(() => client.receive(lie)).toThrow(/expected at most 100 bytes, got 101/);
    client.receive(server.send({ type: "segments", offset: 0, data: new Uint8Array(60) }));
    expect([client.credit, server.credit]).toEqual([40, 40]);
    server.receive(client.send({ type: "stop" }));
    expect(() => server.send({ type: "segments", offset: 0, data: new Uint8Array(1) })).toThrow(/expected to send end/);
    client.receive(server.send({ type: "end", why: "stopped" }));
    server.receive(client.send({ ...open, credit: 7 }));
    expect([client.state, client.credit, server.credit]).toEqual(["opened", 7, 7]);
  });
});

describe("the first message in an address", () => {
  it("is base64url without padding, and not too long", () => {
    fc.assert(
      fc.property(fc.uint8Array({ maxLength: 1536 }), (message) => {
        expect(toAddress(message)).toBe(`open=${Buffer.from(message).toString("base64url")}`);
      }),
    );
    expect(toAddress(new Uint8Array(1537))).toBeUndefined();
  });
});

/** MessagePack of what it can hold; of other values their text. */
function encodable(value: unknown): Uint8Array {
  try {
    return encode(value);
  } catch {
    return encode(String(Object.keys(value as object)));
  }
}
