/** Lodestream in a browser or in Node: containers, their decoding, plans and transfer. */
export { type ConnectOptions, connect, SurfaceStream, SurfaceView } from "./connect";
export * from "./container";
export type { RulePlane } from "./coordinates/coordinate-rules";
export { coordinatesOf, type Placement, placementOf } from "./coordinates/height-fields";
export * from "./decoding";
export * from "./errors";
export { loadKernels } from "./kernels/instance";
export { type Place, RangeSet } from "./planning/byte-ranges";
export type { Ended, Mark, Plan } from "./planning/plan";
export { plan } from "./planning/planner";
export {
  checkSelection,
  restoredRegion,
  type SelectedSlices,
  type Selection,
  select,
  selectedChannels,
  selectedTiles,
} from "./planning/selection";
export { makeTarget, type TargetOptions, tolerance } from "./planning/target";
export { readWindowErrors, type WindowErrors } from "./planning/window-errors";
export type { WorkerLike } from "./transfer/channel";
export type { Phase, Progress, StreamOptions, StreamState } from "./transfer/options";
export type { Price } from "./transfer/prices";
export type { Description, Kept } from "./transfer/questions";
export { serveHost } from "./transfer/serve-host";
export type { SocketClass } from "./transfer/socket";
export { MemoryStore, type Store } from "./transfer/store";
export { Stream } from "./transfer/stream";
export type { Transport } from "./transfer/transports";
export * from "./types";
