/** Containers in maps of MapLibre GL JS: `maplibregl.addProtocol("lode", lodeProtocol())`. */
export type { Proj4 } from "./proj4";
export { type LodeHandler, type LodeProtocolOptions, type LodeRequest, lodeProtocol, type TileJson } from "./protocol";
