/** The codecs that a container needs: a reader that lacks one refuses it at its header, whatever else stands there. */
import { CorruptStreamError, UnsupportedVersionError } from "../errors";
import type { FieldReader } from "./fields";
import { checkCount, LIMITS } from "./limits";

/** What this reader decodes, by number, see docs/format.md, section 3. */
export const CODECS: ReadonlyMap<number, string> = new Map([
  [1, "bit-planes"],
  [2, "large units"],
  [3, "indices of quantised coordinates"],
  [4, "masks"],
  [5, "differences"],
  [6, "offsets"],
]);

/** The list at the start of a header. Throws `UnsupportedVersionError` where one of them is not known. */
export function parseCodecs(fields: FieldReader): number[] {
  const start = fields.at;
  const count = fields.varint();
  checkCount(count, LIMITS.codecs, "codecs", start);
  const needed: number[] = [];
  for (let i = 0; i < count; i++) needed.push(fields.varint());
  if (needed.some((codec, i) => codec <= (needed[i - 1] ?? 0))) {
    throw new CorruptStreamError(`expected the numbers of codecs, each above the one before, got ${needed}`, start);
  }
  for (const codec of needed) {
    if (!CODECS.has(codec)) {
      const had = [...CODECS.keys()].join(", ");
      throw new UnsupportedVersionError(`expected codecs among ${had}, got a container that needs codec ${codec}`);
    }
  }
  return needed;
}
