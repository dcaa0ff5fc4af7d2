/** Fields by the names that Python has for them. */

import type { Field } from "../view/geometry-messages";
import type { SurfaceInfo } from "../view/source";
import type { Program } from "./program";

const KINDS = ["height", "slope", "change", "none"] as const;

/**
 * The field of a name: `height`, `slope`, `change`, `none`, the name of an attribute (of a vector its length), or
 * `name[0]` for one of its components; undefined: the surface has none of this name.
 */
export function fieldOf(name: string, info: SurfaceInfo | null, program: Program): Field | undefined {
  const kind = KINDS.find((other) => other === name);
  if (kind !== undefined) return { kind };
  if (info === null) return undefined;
  return program.fieldsOf(info).find((field) => field.kind === "attribute" && nameOf(field, info, program) === name);
}

/** The name of a field. */
export function nameOf(field: Field, info: SurfaceInfo | null, program: Program): string {
  if (field.kind !== "attribute") return field.kind;
  return field.component === "magnitude" ? field.name : program.fieldName(field, info);
}
