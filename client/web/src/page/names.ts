/** How surfaces are called and found. */

import type { Choice, ListedSurface } from "./api";

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

/** What is to be chosen, by the option that chooses it. */
const CHOSEN: Readonly<Record<string, string>> = {
  array: "an array",
  at: "a place",
  group: "a group",
  time: "a time",
  variable: "a variable",
};

/** How one of the surfaces of a file is called where one has to be chosen. */
export function choiceName({ options, shape }: Choice): string {
  const { x, y, at, time } = options;
  const points = shape.length === 0 ? "" : ` (${shape.join(" × ")})`;
  if (x !== undefined && y !== undefined) return `positions ${x} and ${y}${points}`;
  if (at !== undefined) return `${at.replaceAll(":", " ").replaceAll(",", ", ")}${points}`;
  return `${time === undefined ? "" : "time "}${Object.values(options).join(", ")}${points}`;
}

/** What one is asked to choose among choices. */
export function choiceQuestion(choices: readonly Choice[]): string {
  return `Choose ${CHOSEN[Object.keys(choices[0]?.options ?? {})[0] ?? ""] ?? "a surface"}`;
}
