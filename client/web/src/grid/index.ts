/** Where the levels, bands and tiles of a surface lie: pure geometry. */
export type { Arrangement, Curve, Part, Side } from "./arrangement";
export { type AxisStep, axisStep } from "./axis";
export type { Band, Grid, Tile } from "./layout";
export { Layout } from "./layout";
export { levelPositions, partsByBlock } from "./parts";
