/** Lodestream in a browser or in Node: containers, their decoding, plans and transfer. */
export { type ConnectOptions, connect, SurfaceStream, SurfaceView } from "./connect";
export * from "./container";
export * from "./decoding";
export * from "./errors";
export { loadKernels } from "./kernels/instance";
export { plan } from "./planning/plan";
export type { Ended, Mark, Plan } from "./planning/plans";
export { type Place, RangeSet } from "./planning/ranges";
export { makeTarget, type TargetOptions, tolerance } from "./planning/target";
export type { WorkerLike } from "./transfer/channel";
export type { Price } from "./transfer/prices";
export type { Description, Kept } from "./transfer/questions";
export type { Transport } from "./transfer/roads";
export { serveHost } from "./transfer/serve-host";
export type { SocketClass } from "./transfer/socket";
export { MemoryStore, type Store } from "./transfer/store";
export { type Phase, type Progress, Stream, type StreamOptions, type StreamState } from "./transfer/stream";
export * from "./types";
