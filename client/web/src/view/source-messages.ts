/** What `LodeSource` and its worker say to each other; arrays are transferred, not copied. */

import type { Part } from "../transfer/parts";
import type { DetailWindow, Moment, MomentGrids, NodeValues, Progress, Region, SurfaceInfo, Target } from "./source";

/** A question that has an answer. */
export type Question =
  | {
      readonly kind: "grids";
      readonly moment: number | null;
      readonly level: number;
      readonly window: DetailWindow | null;
    }
  | {
      readonly kind: "values";
      readonly moment: number;
      readonly block: number;
      readonly row: number;
      readonly column: number;
    };

/** From the page. Without an address, the worker asks it for the bytes (`read`). */
export type ToSource =
  | { readonly kind: "open"; readonly url: string | null; readonly token: string | null }
  | { readonly kind: "part"; readonly id: number; readonly part: Part }
  | { readonly kind: "no part"; readonly id: number; readonly detail: string; readonly code: string }
  | { readonly kind: "question"; readonly id: number; readonly question: Question }
  | { readonly kind: "focus"; readonly region: Region | null }
  | { readonly kind: "target"; readonly target: Target }
  | { readonly kind: "throttle"; readonly rate: number | null }
  | { readonly kind: "stop" | "resume" };

/** From the worker. */
export type FromSource =
  | { readonly kind: "info"; readonly info: SurfaceInfo }
  | { readonly kind: "moment"; readonly moment: Moment }
  | { readonly kind: "progress"; readonly progress: Progress }
  | { readonly kind: "grids"; readonly id: number; readonly picture: MomentGrids }
  | { readonly kind: "values"; readonly id: number; readonly values: NodeValues }
  | { readonly kind: "refined" }
  | { readonly kind: "read"; readonly id: number; readonly offset: number; readonly length: number }
  | { readonly kind: "refused"; readonly id: number; readonly detail: string };
