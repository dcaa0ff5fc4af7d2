/** Slices of a container in, states of the surface out. */

export type { RulePlane } from "../coordinates/coordinate-rules";
export { coordinatesOf, type Placement, placementOf } from "../coordinates/height-fields";
export { Decoder, type DecoderOptions, decode } from "./decoder";
export { View } from "./view";
export { serveDecoder } from "./worker/host";
export type { Port } from "./worker/messages";
export { RemoteDecoder, type RemoteView } from "./worker/remote";
