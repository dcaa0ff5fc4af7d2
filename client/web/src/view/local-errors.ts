/** Which errors hold at a place of a surface, from the errors of windows that its container may tell. */

import type { Header } from "../container/header";
import type { WindowErrors } from "../planning/window-errors";
import type { Region, ViewInfo } from "../types";
import type { NodeValues, Price } from "./source";

/** Errors and the part of the block, rows and columns, for which they hold; null: all of the surface. */
export type LocalErrors = Pick<NodeValues, "rms" | "max" | "within">;

/**
 * The errors around a node of a state.
 *
 * @param windows - null: they are not known. They are told for states that are layers, of surfaces of one block.
 * @param prices - Of all layers in order; by its errors a state is known as one of them.
 */
export function localErrors(
  view: Pick<ViewInfo, "number" | "rms" | "maxError">,
  header: Header,
  windows: WindowErrors | null,
  prices: readonly Price[] | null,
  row: number,
  column: number,
): LocalErrors {
  const { number, rms, maxError: max } = view;
  const layer = number < header.layerCount ? prices?.[number] : undefined;
  const isLayer = layer !== undefined && layer.rms === rms && layer.max === max;
  if (windows === null || !isLayer || header.blocks.length > 1) return { rms, max, within: null };
  const part = (at: number, axis: 0 | 1): readonly [number, number] => {
    const size = 2 ** windows.cell[axis];
    const first = at - (at % size);
    return [first, Math.min(first + size, header.shape[axis])];
  };
  const region: Region = [part(row, 0), part(column, 1)];
  // Of a whole cell every point weighs the same, so that its mask does not matter.
  const bound = windows.bounds(region, number);
  // Bounds are told in steps, and may lie above what is known of the whole.
  const within = [region[0][1] - region[0][0], region[1][1] - region[1][0]] as const;
  return { rms: bound.rms, max: Math.min(bound.maximum, max), within };
}
