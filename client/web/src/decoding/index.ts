/** Slices of a container in, states of the surface out. */

export { Decoder, type DecoderOptions, decode } from "./decoder";
export { View } from "./view";
export { serveDecoder } from "./worker/host";
export type { Port } from "./worker/messages";
export { RemoteDecoder, type RemoteView } from "./worker/remote";
