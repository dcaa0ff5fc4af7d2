/** A complete container with random access: its index. */
import { CorruptStreamError, TruncatedStreamError } from "../errors";
import type { ByteRange } from "../types";
import type { Capacity } from "./capacity";
import { FrameReader, indexSections, wholeSection } from "./frames";
import { type Header, parseHeader, parseMasks } from "./header";
import { parseIndex } from "./index-section";
import type { Index } from "./model";
import { DIGEST, FOOTER_LENGTH, KIND, type Metadata, parseFooter, parseMetadata } from "./sections";

/** How many times its bytes an index takes in memory. */
export const INDEX_GROWTH = 64;

/** Bytes of a header that are read at once, at first and at most. */
const [FIRST_READ, MOST_AT_ONCE] = [512, 2 ** 22];

/** Reads bytes of a container; fewer than asked for only where it ends. */
export type Read = (offset: number, length: number) => Promise<Uint8Array>;

/** What reads an index: it asks for bytes, fewer only where the container ends, and ends with the index. */
export type IndexSteps = Generator<ByteRange, Index, Uint8Array>;

/**
 * Index of a complete container of `size` bytes.
 *
 * `capacity` is what the header, the index with all that it lists, and the metadata may take before they are asked for.
 * Throws `CorruptStreamError`, `UnsupportedVersionError`, `TooLargeError`, or `TruncatedStreamError` where the container
 * does not end with a footer, but is otherwise one.
 */
export async function readIndex(read: Read, size: number, capacity?: Capacity): Promise<Index> {
  const steps = indexSteps(size, capacity);
  for (let step = steps.next(); ; ) {
    if (step.done) return step.value;
    step = steps.next(await read(step.value.offset, step.value.length));
  }
}

/** What `readIndex` does, for callers that have bytes in other ways. */
export function* indexSteps(size: number, capacity?: Capacity): IndexSteps {
  const header = yield* headerSteps(size, capacity);
  capacity?.promise(0, [], { masked: 0, tables: header.tables });
  const tail = size - FOOTER_LENGTH;
  const place = footerIn(yield { offset: Math.max(tail, 0), length: FOOTER_LENGTH }, tail, size);
  capacity?.take(INDEX_GROWTH * place.length);
  const index = indexFrom(yield place, place.offset, header);
  if (index.size !== size) {
    throw new CorruptStreamError(`expected a container of ${index.size} bytes, got ${size}`, tail);
  }
  capacity?.take(index.metadata.length);
  const values = readMetadata(yield index.metadata, index.metadata.offset);
  const digest = takeDigest(values);
  return index.withMetadata(values, digest);
}

function footerIn(data: Uint8Array, tail: number, size: number): ByteRange {
  try {
    return parseFooter(data, tail).index;
  } catch (error) {
    if (!(error instanceof CorruptStreamError)) throw error;
    throw new TruncatedStreamError(`expected a container that ends with a footer, got ${size} bytes without`);
  }
}

/** The header, and the masks after it, of a container of which `size` bytes can be had. */
export function* headerSteps(size: number, capacity?: Capacity): Generator<ByteRange, Header, Uint8Array> {
  const reader = new FrameReader();
  let header: Header | null = null;
  let wanted = FIRST_READ;
  for (let position = 0; position < size; wanted = Math.min(2 * wanted, MOST_AT_ONCE)) {
    capacity?.take(Math.min(wanted, size - position));
    const data = yield { offset: position, length: Math.min(wanted, size - position) };
    for (const frame of reader.feed(data)) {
      if (header === null) header = parseHeader(frame.payload, frame.payloadOffset, frame.end);
      else if (frame.kind === KIND.masks || frame.kind === KIND.keptMasks) return parseMasks(header, frame);
      else throw new CorruptStreamError(`expected masks, got a section of kind ${frame.kind}`, frame.offset);
      if (!header.masked) return header;
    }
    if (!data.length) break;
    position += data.length;
  }
  throw new TruncatedStreamError(`expected a container with a whole header, got ${size} bytes without`);
}

/** Index from its bytes, pages and root, which stand at `offset`. */
export function indexFrom(data: Uint8Array, offset: number, header: Header): Index {
  const { pages, root } = indexSections(data, offset);
  return parseIndex(pages, root, header);
}

/** The values of a metadata section that stands at `offset`. */
export function readMetadata(data: Uint8Array, offset: number): Metadata {
  const frame = wholeSection(data, offset, KIND.metadata);
  return parseMetadata(frame.payload, frame.payloadOffset);
}

/** Take the SHA-256 of the values out of metadata. */
export function takeDigest(values: Metadata): string | null {
  const digest = values[DIGEST];
  delete values[DIGEST];
  return digest === undefined ? null : String(digest);
}
