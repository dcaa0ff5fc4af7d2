/** Where the levels, bands and tiles of a surface lie: pure geometry. */

export { type AxisStep, axisStep } from "./axis";
export type { Band, Grid, Tile } from "./layout";
export { Layout } from "./layout";
export type { Arrangement, Interface, Patch, Side } from "./multiblock";
export { levelPositions, patchesByBlock } from "./patches";
