/** What the page and the worker that makes tiles send to each other. */

import type { PlainError } from "../errors";
import type { FieldSource } from "./height-field";
import type { ForeignCrs } from "./projection";
import type { Tile } from "./tile-grid";
import type { Described, Look } from "./tiles";

/** From the page. Each question has a number of its own, and so has each question of the worker. */
export type ToTiles =
  | { readonly kind: "begin"; readonly cacheBytes: number }
  | { readonly kind: "describe"; readonly id: number; readonly source: FieldSource; readonly look: Look }
  | {
      readonly kind: "tile";
      readonly id: number;
      readonly source: FieldSource;
      readonly look: Look;
      readonly tile: Tile;
    }
  | { readonly kind: "leave"; readonly id: number }
  | { readonly kind: "transformed"; readonly id: number; readonly places: Float64Array }
  | { readonly kind: "not transformed"; readonly id: number; readonly error: PlainError };

/** From the worker. */
export type FromTiles =
  | { readonly kind: "described"; readonly id: number; readonly answer: Described }
  | { readonly kind: "tile"; readonly id: number; readonly answer: Uint8ClampedArray<ArrayBuffer> }
  | { readonly kind: "refused"; readonly id: number; readonly error: PlainError }
  | {
      readonly kind: "transform";
      readonly id: number;
      readonly crs: ForeignCrs;
      readonly places: Float64Array;
      readonly back: boolean;
    };
