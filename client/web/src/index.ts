/** Lodestream in a browser or in Node: containers, their decoding, plans and transfer. */
export * from "./container";
export * from "./decoding";
export * from "./errors";
export { loadKernels } from "./kernels/instance";
export * from "./types";
