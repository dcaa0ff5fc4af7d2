/** A container as it arrives: sections however its bytes are cut, each checked before it is handed on. */
import { CorruptStreamError, UnsupportedVersionError } from "../errors";
import { ByteBuffer } from "./buffer";
import { crc32 } from "./crc";
import { checkCount, LIMITS } from "./limits";
import {
  checkMetadataLength,
  checkSignature,
  KIND,
  OPTIONAL,
  SIGNATURE_LENGTH,
  VERSION,
  WINDOW_ERRORS,
} from "./sections";

/** A section whose CRC holds: its payload stands at `payloadOffset`, all of it at `offset` to `end`. */
export interface Frame {
  readonly kind: number;
  readonly offset: number;
  readonly payloadOffset: number;
  readonly payload: Uint8Array;
  readonly end: number;
}

/** The kind and length of a section take at most so many bytes. */
const LONGEST_START = 10;
const CRC = 4; // bytes at the end of a section
const KNOWN: ReadonlySet<number> = new Set(Object.values(KIND));

/** A section whose bytes are checked as they pass, and not kept; `length` counts its CRC too. */
class Passing {
  #crc = 0;
  #told = 0;
  #place = 0;

  constructor(
    readonly kind: number,
    readonly offset: number,
    readonly length: number,
  ) {}

  /** Bytes that have not passed. */
  get left(): number {
    return this.length - this.#place;
  }

  /** Take the next bytes, at most as many as are left. */
  take(data: Uint8Array): void {
    const checked = Math.max(Math.min(data.length, this.left - CRC), 0);
    this.#crc = crc32(data.subarray(0, checked), this.#crc);
    for (const byte of data.subarray(checked)) this.#told = ((this.#told >>> 8) | (byte << 24)) >>> 0;
    this.#place += data.length;
  }

  /** Refuse a section that does not match its CRC, or that is not known and must be; all bytes have passed. */
  check(): void {
    checkSound(this.#crc === this.#told, this.kind, this.offset);
  }
}

/**
 * Sections in file order.
 *
 * Memory grows with what has arrived, never with what a length promises. Sections that are not known are checked as
 * they pass. Metadata that are too long are refused as soon
 * as they say so.
 */
export class FrameReader {
  /** The index was read: nothing but the footer follows. */
  ended = false;
  readonly #data = new ByteBuffer();
  #offset = 0; // of #data in the container
  #started = false;
  #passing: Passing | null = null;
  #optional = 0; // sections so far
  #windows = 0; // those of errors of windows

  /** Bytes of the container taken so far, without those of a section that wait for the rest of it. */
  get position(): number {
    return this.#offset;
  }

  /** Bytes that wait for the rest of their section. */
  get pending(): number {
    return this.#data.length;
  }

  /** Whether a section has begun that is not whole. */
  get partial(): boolean {
    return this.pending > 0 || this.#passing !== null;
  }

  /**
   * Take bytes, yield the sections that are now complete.
   *
   * Throws `CorruptStreamError` where the bytes are no container, or a section fails its CRC; `UnsupportedVersionError`
   * where the container is of another version, or a section that must be understood is not known.
   */
  *feed(data: Uint8Array): Generator<Frame> {
    this.#data.append(data);
    while (!this.ended && this.#begin()) {
      if (this.#passing !== null) {
        if (!this.#pass(this.#passing)) return;
        continue;
      }
      const frame = this.#next();
      if (frame === null) return;
      this.ended = frame.kind === KIND.index;
      yield frame;
    }
  }

  /** Take the bytes that are no whole section, as those after the index. */
  rest(): Uint8Array {
    return this.#data.take(this.#data.length);
  }

  /** Look at the start of the next section, unless one is passing; false: not enough of it has come. */
  #begin(): boolean {
    if (this.#passing !== null) return true;
    if (!this.#started && !this.#start()) return false;
    const head = this.#data.peek(LONGEST_START);
    if (this.#offset === SIGNATURE_LENGTH && head.length && head[0] !== KIND.header) {
      throw new CorruptStreamError(`expected the header section first, got kind ${head[0]}`, SIGNATURE_LENGTH);
    }
    const extent = sectionExtent(head, this.#offset);
    if (extent === null) return false;
    const kind = head[0]!;
    if (!KNOWN.has(kind)) {
      if (kind >= OPTIONAL) this.#optional += 1;
      if (kind === WINDOW_ERRORS) this.#windows += 1;
      checkCount(this.#optional, LIMITS.optional, "optional sections", this.#offset);
      checkCount(this.#windows, 1, "sections of errors of windows", this.#offset);
      this.#passing = new Passing(kind, this.#offset, extent.end);
    }
    return true;
  }

  /** Let bytes of a section pass; false: there are more to come. */
  #pass(passing: Passing): boolean {
    const data = this.#data.peek(passing.left);
    passing.take(data);
    this.#offset += data.length;
    this.#data.drop(data.length);
    if (passing.left > 0) return false;
    passing.check();
    this.#passing = null;
    return true;
  }

  #next(): Frame | null {
    const extent = sectionExtent(this.#data.peek(LONGEST_START), this.#offset);
    if (extent === null || this.#data.length < extent.end) return null;
    const offset = this.#offset;
    const frame = this.#data.take(extent.end);
    this.#offset += extent.end;
    return checked(frame, offset, extent.start);
  }

  #start(): boolean {
    checkSignature(this.#data.peek(SIGNATURE_LENGTH));
    if (this.#data.length < SIGNATURE_LENGTH) return false;
    this.#data.take(SIGNATURE_LENGTH);
    this.#offset = SIGNATURE_LENGTH;
    this.#started = true;
    return true;
  }
}

/** Where the payload of the section at the start of `data` begins and the section ends; null: not yet to be told. */
export function sectionExtent(data: Uint8Array, offset: number): { start: number; end: number } | null {
  let length = 0;
  let scale = 1;
  for (let place = 1; place < Math.min(data.length, LONGEST_START); place++) {
    length += (data[place]! & 127) * scale;
    scale *= 128;
    if (data[place]! < 128) {
      if (data[0] === KIND.metadata) checkMetadataLength(length, offset);
      return { start: place + 1, end: place + 1 + length + 4 };
    }
  }
  if (data.length >= LONGEST_START) {
    throw new CorruptStreamError("expected the length of a section, got a number of more than 9 bytes", offset);
  }
  return null;
}

/** Where the index ends that stands at the start of `data`: its pages and its root; null: not yet to be told. */
export function indexExtent(data: Uint8Array, offset: number): number | null {
  const pages = sectionExtent(data.subarray(0, LONGEST_START), offset);
  if (pages === null) return null;
  const root = sectionExtent(data.subarray(pages.end, pages.end + LONGEST_START), offset + pages.end);
  return root && pages.end + root.end;
}

/** The pages and the root of an index that was fetched by itself. Throws where these are not two whole sections. */
export function indexSections(data: Uint8Array, offset: number): { pages: Frame; root: Frame } {
  const extent = sectionExtent(data.subarray(0, LONGEST_START), offset);
  const end = Math.min(extent === null ? data.length : extent.end, data.length);
  const rootOffset = offset + (extent === null ? data.length : extent.end);
  const root = wholeSection(data.subarray(end), rootOffset, KIND.index);
  return { pages: wholeSection(data.subarray(0, end), offset, KIND.pages), root };
}

/** A section that was fetched by itself. Throws where it is not one whole section of that kind. */
export function wholeSection(data: Uint8Array, offset: number, kind: number): Frame {
  const extent = sectionExtent(data.subarray(0, LONGEST_START), offset);
  if (extent === null || extent.end !== data.length || data[0] !== kind) {
    throw new CorruptStreamError(`expected one whole section of kind ${kind}, got other bytes`, offset);
  }
  return checked(data, offset, extent.start);
}

/** A whole section, whose payload starts at `start` of it, after its CRC was checked. */
function checked(frame: Uint8Array, offset: number, start: number): Frame {
  const kind = frame[0]!;
  const end = frame.length - CRC;
  const crc = new DataView(frame.buffer, frame.byteOffset + end, CRC).getUint32(0, true);
  checkSound(crc32(frame.subarray(0, end)) === crc, kind, offset);
  return {
    kind,
    offset,
    payloadOffset: offset + start,
    payload: frame.subarray(start, end),
    end: offset + frame.length,
  };
}

/** Refuse a section that is not sound, or that is not known and must be. */
function checkSound(sound: boolean, kind: number, offset: number): void {
  if (!sound) {
    throw new CorruptStreamError(`expected a section of kind ${kind} to match its CRC, got other bytes`, offset);
  }
  if (!KNOWN.has(kind) && kind < OPTIONAL) {
    throw new UnsupportedVersionError(
      `expected sections of version ${VERSION}, got an unknown one of kind ${kind} that must not be skipped`,
    );
  }
}
