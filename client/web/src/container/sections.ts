/** Kinds and bounds of a container's sections, and the payloads of those that are short (docs/format.md). */
import { CorruptStreamError, UnsupportedVersionError } from "../errors";
import { unpack as unpackStrictly } from "../msgpack";
import type { ByteRange } from "../types";
import { crc32 } from "./crc";
import { FieldReader } from "./fields";

/** Version of the format that is read. */
export const VERSION = 1;
/** The first bytes of a container: a byte that UTF-8 never has, the name, a line end that text transfer would damage. */
export const MAGIC = Uint8Array.of(0xf5, 0x4c, 0x4f, 0x44, 0x45, 0x0d, 0x0a);
/** Bytes before the first section: the magic bytes and the version. */
export const SIGNATURE_LENGTH = MAGIC.length + 1;
/** Containers began so while the format was made; none was released. */
const EARLIER_MAGIC = Uint8Array.of(0x89, 0x4c, 0x4f, 0x44, 0x45, 0x0d, 0x0a);

/** Kinds of sections. */
export const KIND = {
  header: 1,
  layer: 2,
  residual: 3,
  metadata: 4,
  index: 5,
  masks: 6,
  keptMasks: 7,
  pages: 8,
} as const;
/** Kinds from here on may be skipped by a reader that does not know them. */
export const OPTIONAL = 128;
/** Errors of windows. */
export const WINDOW_ERRORS = 128;

/** Bytes of a footer. */
export const FOOTER_LENGTH = 28;
const FOOTER_MAGIC = Uint8Array.of(0x4c, 0x4f, 0x44, 0x45, 0x45, 0x4e, 0x44, 0x0a);

/** Most bytes of metadata. */
export const MOST_METADATA = 1 << 16;
// Kind, length and CRC of the section around them.
const METADATA_FRAME = 1 + 9 + 4;

/** The key of metadata that holds the SHA-256 of all values. */
export const DIGEST = "values_sha256";

/** Bytes of a section before a payload of so many. */
export function sectionStart(length: number): number {
  let bytes = 2;
  for (let rest = length; rest >= 128; rest = Math.floor(rest / 128)) bytes++;
  return bytes;
}

/** Refuse a container's metadata by their announced length, of the map or of the whole section, before they are read. */
export function checkMetadataLength(length: number, offset: number, section = false): void {
  if (length > MOST_METADATA + (section ? METADATA_FRAME : 0)) {
    throw new CorruptStreamError(`expected at most ${MOST_METADATA} bytes of metadata, got ${length}`, offset);
  }
}

/** Metadata: values that MessagePack can hold. Integers beyond 2^53 are bigints. */
export type Metadata = Record<string, unknown>;

/** One MessagePack value and nothing after it; throws any kind of error where that is not so. */
export function unpack(data: Uint8Array): unknown {
  return withNumbers(unpackStrictly(data));
}

/** Integers that numbers hold exactly as numbers. */
function withNumbers(value: unknown): unknown {
  if (typeof value === "bigint") {
    const number = Number(value);
    return Number.isSafeInteger(number) ? number : value;
  }
  if (Array.isArray(value)) return value.map(withNumbers);
  if (isMap(value)) return Object.fromEntries(Object.entries(value).map(([key, inner]) => [key, withNumbers(inner)]));
  return value;
}

/** Whether a MessagePack value is a map. */
export function isMap(value: unknown): value is Record<string, unknown> {
  return (
    typeof value === "object" &&
    value !== null &&
    !Array.isArray(value) &&
    Object.getPrototypeOf(value) === Object.prototype
  );
}

/** The map of a metadata section's payload, which stands at `offset`. */
export function parseMetadata(payload: Uint8Array, offset: number): Metadata {
  checkMetadataLength(payload.length, offset);
  let values: unknown;
  try {
    values = unpack(payload);
  } catch (error) {
    throw new CorruptStreamError(`expected a MessagePack map of metadata: ${reason(error)}`, offset);
  }
  if (!isMap(values)) throw new CorruptStreamError(`expected a map of metadata, got ${typeof values}`, offset);
  return values;
}

/** What an error of another library says. */
export function reason(error: unknown): string {
  return error instanceof Error ? error.message : String(error);
}

/** The places of the index and of its root, from the last bytes of a container, which stand at `offset`. */
export function parseFooter(data: Uint8Array, offset: number): { index: ByteRange; root: ByteRange } {
  const magic = data.subarray(-FOOTER_MAGIC.length);
  if (data.length !== FOOTER_LENGTH || !startsWith(magic, FOOTER_MAGIC)) {
    throw new CorruptStreamError("expected the footer of a container, got other bytes", offset);
  }
  const fields = new FieldReader(data, offset);
  const [index, root, crc] = [fields.u64(), fields.u64(), fields.u32()];
  if (crc32(data.subarray(0, 16)) !== crc || !(0 < root && root < index && index <= offset)) {
    throw new CorruptStreamError("expected a footer that points at the index before it, got another place", offset);
  }
  return { index: { offset: offset - index, length: index }, root: { offset: offset - root, length: root } };
}

function startsWith(data: Uint8Array, magic: Uint8Array): boolean {
  return data.length >= magic.length && magic.every((byte, i) => data[i] === byte);
}

/** Whether the first bytes of a file are those of a container, of whichever version. */
export function isContainer(head: Uint8Array): boolean {
  return startsWith(head, MAGIC) || startsWith(head, EARLIER_MAGIC);
}

/** Refuse what does not begin like a container of this version; `start` are as many of its first bytes as have come. */
export function checkSignature(start: Uint8Array): void {
  const own = start.subarray(0, MAGIC.length);
  const begins = (magic: Uint8Array) => own.every((byte, i) => byte === magic[i]);
  if (!begins(MAGIC) && !begins(EARLIER_MAGIC)) {
    throw new CorruptStreamError(`expected a Lodestream container, got ${[...start].join(" ")}`, 0);
  }
  const version = start[MAGIC.length];
  if (version === undefined || (version === VERSION && begins(MAGIC))) return;
  const earlier = begins(MAGIC) ? "" : " of an earlier numbering";
  throw new UnsupportedVersionError(
    `expected a container of version ${VERSION}, the one this program reads, got version ${version}${earlier}`,
  );
}
