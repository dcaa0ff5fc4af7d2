/** Bytes into frames, and the index of a complete container. */

export type { BlockShape } from "./arrangement";
export { Capacity } from "./capacity";
export { type ChunkPlace, chunkPlaces, countWindows } from "./chunks";
export { checkOf, crc32 } from "./crc";
export type { CoordinateRule, Plane } from "./extras";
export { type Frame, FrameReader, indexExtent, sectionExtent } from "./frames";
export { Header, parseHeader, parseMasks } from "./header";
export { PAGE, type PagePlace, parseIndex, parseRoot, type Root } from "./index-section";
export { Index } from "./model";
export { INDEX_GROWTH, indexFrom, type Read, readIndex, readMetadata } from "./reader";
export { FOOTER_LENGTH, isContainer, KIND, type Metadata, SIGNATURE_LENGTH } from "./sections";
