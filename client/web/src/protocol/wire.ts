/**
 * Messages as bytes: one MessagePack map each, with a `type`.
 *
 * Keys that a receiver does not know are ignored, so that later versions can add some; everything else is checked,
 * since the other side is a stranger. JavaScript has one type of number, so 2.0 is taken where an integer is meant.
 */

import { encode } from "@msgpack/msgpack";
import { OptionError, UnsupportedVersionError } from "../errors";
import { unpack } from "../msgpack";
import type { Place } from "../planning/byte-ranges";
import { makeTarget, type TargetOptions } from "../planning/target";
import type { ChannelLimit, Region, Span, Target, Tolerance } from "../types";
import {
  BASE_CREDIT,
  type Event,
  type EventType,
  MAX_DATA,
  MAX_HELD,
  MAX_MESSAGE,
  MessageError,
  VERSION,
} from "./messages";

// Integers stay exact in every language that reads them as a double.
const MAX_INTEGER = 2 ** 53;

/** What a field should have been. */
class Mismatch extends Error {}

type Read = (value: unknown) => unknown;

function integer(value: unknown, least = 0): number {
  const found = typeof value === "bigint" && value <= MAX_INTEGER ? Number(value) : value;
  if (typeof found !== "number" || !Number.isInteger(found) || found < least || found > MAX_INTEGER) {
    throw new Mismatch(`an integer from ${least} to 2^53`);
  }
  return found;
}

const count: Read = (value) => integer(value);
const positive: Read = (value) => integer(value, 1);

const credit: Read = (value) => integer(value, BASE_CREDIT);

function number(value: unknown): number {
  const found = typeof value === "bigint" ? Number(value) : value;
  if (typeof found !== "number" || !Number.isFinite(found)) throw new Mismatch("a finite number");
  return found;
}

const text: Read = (value) => {
  if (typeof value !== "string") throw new Mismatch("text");
  return value;
};

const data: Read = (value) => {
  if (!(value instanceof Uint8Array) || value.length === 0 || value.length > MAX_DATA) {
    throw new Mismatch(`1 to ${MAX_DATA} bytes`);
  }
  return value;
};

const digest: Read = (value) => {
  if (typeof value !== "string" || !/^[0-9a-f]{64}$/.test(value)) throw new Mismatch("64 hexadecimal digits");
  return value;
};

const pair = (value: unknown): value is [unknown, unknown] => Array.isArray(value) && value.length === 2;

const heldPlaces: Read = (value) => {
  if (!Array.isArray(value) || !value.every(pair)) throw new Mismatch("a list of [offset, length]");
  if (value.length > MAX_HELD) {
    throw new MessageError("bad-held", `expected open.held to be at most ${MAX_HELD} ranges, got ${value.length}`);
  }
  return value.map(([offset, length]): Place => [integer(offset), integer(length, 1)]);
};

const place: Read = (value) => {
  if (!pair(value)) throw new Mismatch("[offset, length]");
  return [integer(value[0]), integer(value[1], 1)];
};

const section: Read = (value) => {
  if (!pair(value)) throw new Mismatch("[offset, length]");
  return [integer(value[0]), integer(value[1])];
};

const flag: Read = (value) => {
  if (typeof value !== "boolean") throw new Mismatch("true or false");
  return value;
};

const tolerance: Read = (value): Tolerance => {
  if (!pair(value) || typeof value[1] !== "boolean") throw new Mismatch("[number, whether it is relative]");
  return { value: number(value[0]), relative: value[1] };
};

const region: Read = (value): Region => {
  if (!pair(value) || !value.every(pair)) {
    throw new Mismatch("[[first row, past the last], [first column, past the last]]");
  }
  const [rows, columns] = value as unknown as [unknown[], unknown[]];
  const span = (ends: unknown[]): Span => [integer(ends[0]), integer(ends[1])];
  return [span(rows), span(columns)];
};

const names: Read = (value) => {
  if (!Array.isArray(value) || !value.every((name) => typeof name === "string")) throw new Mismatch("a list of names");
  return value;
};

const limits: Read = (value): ChannelLimit[] => {
  const expected = "a list of [name, rms or max, number]";
  if (!Array.isArray(value)) throw new Mismatch(expected);
  return value.map((limit: unknown) => {
    if (!Array.isArray(limit) || limit.length !== 3) throw new Mismatch(expected);
    const [name, which, most] = limit as unknown[];
    if (typeof name !== "string" || (which !== "rms" && which !== "max")) throw new Mismatch(expected);
    return [name, which, number(most)];
  });
};

const measured: Read = (value) => (value === null || value === undefined ? Number.NaN : number(value));

/** The keys of a target: how the wire and how `Target` calls them, and how each is read. */
const TARGET: readonly (readonly [wire: string, key: keyof Target, read: Read])[] = [
  ["level", "level", count],
  ["until_rms", "untilRms", tolerance],
  ["until_max", "untilMax", tolerance],
  ["channels", "channels", limits],
  ["max_bytes", "maxBytes", count],
  ["order", "order", text],
  ["region", "region", region],
  ["attributes", "attributes", names],
  ["first", "first", region],
];

const target: Read = (value) => {
  if (!isMap(value)) throw new Mismatch("a map");
  const found: Partial<Record<keyof Target, unknown>> = {};
  for (const [wire, key, read] of TARGET) {
    const given = value[wire];
    if (given !== undefined && given !== null) found[key] = checked(`target.${wire}`, read, given);
  }
  const { channels, ...rest } = found as Target;
  return makeTarget(channels === undefined ? rest : { ...rest, ...byName(channels, rest) });
};

/** Errors of channels as callers write them. */
function byName(channels: readonly ChannelLimit[], rest: Target): TargetOptions {
  if ((rest.untilRms ?? rest.untilMax) !== undefined) {
    throw new OptionError("expected either an error of the whole surface or errors of channels, got both");
  }
  const of = (which: string) => channels.filter((limit) => limit[1] === which).map(([name, , most]) => [name, most]);
  const found = { untilRms: Object.fromEntries(of("rms")), untilMax: Object.fromEntries(of("max")) };
  if (Object.keys(found.untilRms).length + Object.keys(found.untilMax).length < channels.length) {
    throw new OptionError("expected one error of each channel, got two");
  }
  return found;
}

const FIELDS: Readonly<Record<EventType, readonly (readonly [name: string, read: Read])[]>> = {
  open: [
    ["target", target],
    ["credit", count],
    ["held", heldPlaces],
    ["container", digest],
    ["token", text],
    ["window_errors", flag],
    ["decodes", flag],
  ],
  credit: [["bytes", positive]],
  stop: [],
  bye: [],
  header: [
    ["container", digest],
    ["size", count],
    ["planned", count],
    ["extent", number],
    ["index", place],
    ["metadata", place],
    ["prefix", flag],
    ["credit", credit],
    ["window_errors", section],
    ["channels", flag],
  ],
  segments: [
    ["offset", count],
    ["data", data],
  ],
  layer: [
    ["number", count],
    ["level", count],
    ["bytes", count],
    ["rms", measured],
    ["max", measured],
  ],
  end: [["why", text]],
  error: [
    ["code", text],
    ["title", text],
    ["detail", text],
  ],
};

/** What may be left out, and what it then is. */
const DEFAULTS: Readonly<Record<string, unknown>> = {
  "open.target": undefined,
  "open.held": [],
  "open.container": undefined,
  "open.token": undefined,
  "open.window_errors": undefined,
  "open.decodes": undefined,
  "header.credit": undefined,
  "header.window_errors": undefined,
  "header.channels": undefined,
  "layer.rms": Number.NaN,
  "layer.max": Number.NaN,
};

/** The bytes of a message. */
export function serialize(event: Event): Uint8Array {
  const fields: Record<string, unknown> = { type: event.type };
  if (event.type === "open") fields.version = VERSION;
  for (const [name] of FIELDS[event.type]) {
    const value = plain(name, (event as unknown as Record<string, unknown>)[name]);
    if (value !== undefined) fields[name] = value;
  }
  return encode(fields);
}

/**
 * The event that a message stands for.
 *
 * @throws MessageError if it is too large, not one MessagePack map, of an unknown type, or has a field that is missing
 * or wrong; with the code `bad-target` if the fields of a target contradict each other.
 * @throws UnsupportedVersionError if an `open` names another version of the protocol.
 */
export function parse(message: Uint8Array): Event {
  if (message.length > MAX_MESSAGE) {
    throw new MessageError(
      "message-too-large",
      `expected a message of at most ${MAX_MESSAGE} bytes, got ${message.length}`,
    );
  }
  const fields = unpacked(message);
  const type = fields.type;
  if (typeof type !== "string" || !Object.hasOwn(FIELDS, type)) {
    throw new MessageError(
      "bad-message",
      `expected a type out of ${Object.keys(FIELDS).join(", ")}, got ${show(type)}`,
    );
  }
  if (type === "open") checkVersion(fields.version);
  try {
    return values(type as EventType, fields);
  } catch (error) {
    if (error instanceof OptionError) throw new MessageError("bad-target", escaped(error.message));
    throw error;
  }
}

function unpacked(message: Uint8Array): Record<string, unknown> {
  let fields: unknown;
  try {
    fields = unpack(message);
  } catch (error) {
    throw new MessageError(
      "bad-message",
      `expected one MessagePack map, got ${message.length} bytes that are not: ${(error as Error).message}`,
    );
  }
  if (!isMap(fields)) throw new MessageError("bad-message", `expected a MessagePack map, got ${show(fields)}`);
  return fields;
}

function checkVersion(version: unknown): void {
  if (typeof version !== "bigint" && !Number.isInteger(version)) {
    throw new MessageError("bad-message", `expected open.version to be an integer, got ${show(version)}`);
  }
  if (version !== VERSION) {
    throw new UnsupportedVersionError(`expected version ${VERSION} of the protocol, got version ${version}`);
  }
}

function values(type: EventType, fields: Record<string, unknown>): Event {
  const event: Record<string, unknown> = { type };
  for (const [name, read] of FIELDS[type]) {
    const known = `${type}.${name}`;
    if (Object.hasOwn(fields, name)) event[name] = checked(known, read, fields[name]);
    else if (Object.hasOwn(DEFAULTS, known)) event[name] = known === "open.target" ? makeTarget() : DEFAULTS[known];
    else throw new MessageError("bad-message", `expected ${known}, got ${show(Object.keys(fields))}`);
  }
  return event as unknown as Event;
}

function checked(where: string, read: Read, value: unknown): unknown {
  try {
    return read(value);
  } catch (error) {
    if (!(error instanceof Mismatch)) throw error;
    throw new MessageError("bad-message", `expected ${where} to be ${error.message}, got ${show(value)}`);
  }
}

function plain(name: string, value: unknown): unknown {
  if (name === "target") {
    const chosen: Record<string, unknown> = {};
    for (const [wire, key] of TARGET) {
      const given = (value as Target)[key];
      if (given === undefined) continue;
      chosen[wire] = key === "untilRms" || key === "untilMax" ? asPair(given as Tolerance) : given;
    }
    return chosen;
  }
  // An error that is not known, of a window that is not complete.
  return Number.isNaN(value) ? undefined : value;
}

const asPair = (limit: Tolerance): [number, boolean] => [limit.value, limit.relative];

function isMap(value: unknown): value is Record<string, unknown> {
  if (typeof value !== "object" || value === null) return false;
  const prototype: unknown = Object.getPrototypeOf(value);
  return prototype === Object.prototype || prototype === null;
}

const LONGEST = 60;

/** What a stranger sent may be long, deep or unprintable: it is shortened and escaped before it is repeated. */
function show(value: unknown): string {
  if (value === undefined) return "nothing";
  if (value instanceof Uint8Array) return `${value.length} bytes`;
  const told =
    JSON.stringify(value, (_, item: unknown) => {
      if (typeof item === "bigint") return String(item);
      return item instanceof Uint8Array ? `${item.length} bytes` : item;
    }) ?? "nothing";
  return escaped(told.length > LONGEST ? `${told.slice(0, LONGEST)}...` : told);
}

/** A text in printable ASCII. */
function escaped(text: string): string {
  return text.replace(/[^ -~]/g, (character) => `\\u${character.charCodeAt(0).toString(16).padStart(4, "0")}`);
}
