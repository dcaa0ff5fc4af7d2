/** What the element and its geometry worker say to each other; arrays are transferred, not copied. */

import type { PictureOptions } from "./geometry";
import type { Frame } from "./lattice";
import type { Grid, Region } from "./source";

/** What the surface is coloured by. */
export type Field =
  | { readonly kind: "height" | "slope" | "change" | "none" }
  | { readonly kind: "attribute"; readonly name: string; readonly component: Component };

/** One of an attribute's numbers at a point, from 0; or the length of the vector that all of them are. */
export type Component = number | "magnitude";

/** What decides at which strides patches are drawn. */
export interface Eye {
  /** View and projection of drawn coordinates, 4 x 4, column by column. */
  readonly matrix: readonly number[];
  /** In drawn coordinates. */
  readonly position: readonly [number, number, number];
  /** Pixels of a length of 1 at a distance of 1. */
  readonly focal: number;
  /** What drawn z are multiplied by. */
  readonly exaggeration: number;
}

/** One patch, ready for the graphics card; nodes in row order. */
export interface PatchBuffers {
  readonly patch: number;
  /** [node, xyz]; what it was a picture before; null: the same. */
  readonly positions: Float32Array;
  readonly from: Float32Array | null;
  /** [node, xyz and 127 for a line], -127 to 127; likewise. */
  readonly normals: Int8Array;
  readonly fromNormals: Int8Array | null;
  /** [node], 0 to 1 over the span of `Colouring`; far below 0 where there is no value; likewise. */
  readonly values: Float32Array;
  readonly fromValues: Float32Array | null;
  /** [node, row and column], in lines of the level in hand. */
  readonly places: Float32Array;
  readonly triangles: Uint16Array | Uint32Array;
  /** Ends of the pieces of a line, two by two, of a block of one row or column; null: there are triangles. */
  readonly pieces: Uint32Array | null;
  /** Centre and radius. */
  readonly sphere: readonly [number, number, number, number];
}

/** How the values of `PatchBuffers` are to be read: value = low + span * v. */
export interface Colouring {
  readonly low: number;
  readonly span: number;
  /** Smallest and largest value now; NaN where there are none. */
  readonly range: readonly [number, number];
}

/** A box in the surface's coordinates. */
export type Box = readonly [readonly [number, number, number], readonly [number, number, number]];

/** A node under the pointer. */
export interface Hit {
  readonly block: number;
  /** In indices of the full resolution. */
  readonly row: number;
  readonly column: number;
  /** Where the ray meets the surface in hand, in the surface's coordinates. */
  readonly at: readonly [number, number, number];
  readonly distance: number;
}

/** From the element. */
export type ToGeometry =
  | {
      readonly kind: "picture";
      readonly picture: number;
      readonly level: number;
      readonly grids: readonly Grid[];
      readonly options: PictureOptions;
    }
  | { readonly kind: "eye"; readonly eye: Eye }
  | { readonly kind: "field"; readonly field: Field }
  | { readonly kind: "most"; readonly triangles: number }
  | {
      readonly kind: "pick";
      readonly id: number;
      readonly origin: readonly [number, number, number];
      readonly direction: readonly [number, number, number];
    };

/** From the worker. */
export type FromGeometry =
  | {
      readonly kind: "patches";
      readonly picture: number;
      readonly level: number;
      /** A new picture, to be blended in; all patches of the one before are gone. */
      readonly fresh: boolean;
      readonly patches: readonly PatchBuffers[];
      readonly frame: Frame;
      readonly box: Box;
      readonly colouring: Colouring;
      /** Triangles of all patches that are drawn now. */
      readonly triangles: number;
    }
  | {
      readonly kind: "wants";
      /** The finest level that shows a difference in the view. */
      readonly level: number;
      /** What of the only block is in the view; null: most of it, or there are several. */
      readonly region: Region | null;
    }
  | { readonly kind: "hit"; readonly id: number; readonly hit: Hit | null }
  | { readonly kind: "failed"; readonly detail: string };
