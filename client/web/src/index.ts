/** Lodestream in a browser or in Node: containers, their decoding, plans and transfer. */
export * from "./container";
export * from "./errors";
export * from "./types";
