/** How a surface looks, as programs set it: some of it, or left to follow the surface. */

import type { ColourMapName } from "./colour-maps";
import type { Field } from "./geometry-messages";
import { type Look, mapFor, sameField } from "./look";
import type { SurfaceInfo } from "./source";
import type { SharedView } from "./url-state";

/** What is set; what is left out stays, null follows the surface. */
export interface Appearance {
  readonly field?: Field;
  readonly map?: ColourMapName | null;
  readonly range?: readonly [number, number] | null;
  readonly exaggeration?: number | null;
  readonly lines?: boolean;
}

/**
 * A look with some of it set. Another field brings its own map and range.
 *
 * @param natural - The exaggeration that follows the surface.
 */
export function withAppearance(look: Look, by: Appearance, info: SurfaceInfo | null, natural: number): Look {
  const field = by.field === undefined || sameField(by.field, look.field) ? look.field : by.field;
  const other = field !== look.field;
  const map = by.map === undefined && !other ? look.map : (by.map ?? mapFor(field, info));
  const range = by.range === undefined && !other ? look.range : (by.range ?? null);
  const exaggeration = by.exaggeration === undefined ? look.exaggeration : (by.exaggeration ?? natural);
  return { field, map, range, exaggeration, lines: by.lines ?? look.lines };
}

/** What the first picture is to look like, with some of it set. */
export function sharedWith(shared: SharedView, by: Appearance): SharedView {
  const { field, map, range, exaggeration, lines } = { ...shared, ...by };
  return {
    ...(shared.camera === undefined ? {} : { camera: shared.camera }),
    ...(field === undefined ? {} : { field }),
    ...(map == null ? {} : { map }),
    ...(range == null ? {} : { range }),
    ...(exaggeration == null ? {} : { exaggeration }),
    ...(lines === undefined ? {} : { lines }),
  };
}

/** What somebody has changed of a look. Map and range that came with another field follow it. */
export function changesOf(before: Look, now: Look): Appearance {
  if (!sameField(before.field, now.field)) return { field: now.field, map: null, range: null };
  return {
    ...(before.map === now.map ? {} : { map: now.map }),
    ...(before.range === now.range ? {} : { range: now.range }),
    ...(before.exaggeration === now.exaggeration ? {} : { exaggeration: now.exaggeration }),
    ...(before.lines === now.lines ? {} : { lines: now.lines }),
  };
}
