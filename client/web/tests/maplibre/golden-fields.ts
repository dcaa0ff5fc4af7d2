/** Fields of heights, and tiles of theirs as the Python library makes them. */
import { inflateSync } from "node:zlib";
import { run } from "../python";

/** A tile; its arrays are compressed. */
interface GoldenTile {
  readonly z: number;
  readonly x: number;
  readonly y: number;
  readonly heights: string;
  /** Colours, red, green and blue, where holes have a height of -7.3. */
  readonly "terrain-rgb"?: string;
  readonly terrarium?: string;
}

/** A field. */
export interface GoldenField {
  readonly name: string;
  readonly container: string;
  readonly scale: number | null;
  readonly bounds: readonly number[];
  readonly zoom: number;
  readonly tiles: readonly GoldenTile[];
}

/** All of them. */
export function goldenFields(): GoldenField[] {
  const lines = run("tests.web.map_tiles").trimEnd().split("\n");
  return lines.map((line) => JSON.parse(line) as GoldenField);
}

/** The bytes of a container. */
export function containerOf({ container }: GoldenField): Uint8Array {
  return new Uint8Array(Buffer.from(container, "base64"));
}

/** The bytes of an array of a tile. */
export function unpacked(text: string): Uint8Array<ArrayBuffer> {
  return new Uint8Array(inflateSync(Buffer.from(text, "base64")));
}
