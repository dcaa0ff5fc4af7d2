/** Slices of a container in, states of the surface out. */
export { Decoder, type DecoderOptions, decode } from "./decoder";
export { coordinatesOf, type Placement, placementOf } from "./heights";
export type { RulePlane } from "./rules";
export { View } from "./view";
