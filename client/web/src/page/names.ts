/** How surfaces are called and found. */

import type { ListedSurface } from "./api";

/** How a surface is called: by its id where it has no name. */
export function nameOf(surface: ListedSurface): string {
  return surface.name || surface.id;
}

/** Whether a surface is found by some words: each is part of its name or its id. */
export function matches(surface: ListedSurface, search: string): boolean {
  const text = `${surface.name ?? ""} ${surface.id}`.toLowerCase();
  return search
    .toLowerCase()
    .split(/\s+/)
    .every((word) => text.includes(word));
}
