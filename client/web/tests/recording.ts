/** The exchange that docs/protocol.md shows byte by byte. */
import { readFileSync } from "node:fs";
import { join } from "node:path";
import { ROOT } from "./golden";

export interface Recorded {
  readonly number: number;
  readonly side: "client" | "server" | "lost";
  readonly name: string;
  readonly message: Uint8Array;
}

/** Who sends what, message by message; `lost` stands where the connection breaks. */
export function recording(): Recorded[] {
  const page = readFileSync(join(ROOT, "docs/protocol.md"), "utf8");
  const listing = page.split("<!-- recorded -->")[1]!.split("<!-- recorded until here -->")[0]!;
  const entries: Recorded[] = [];
  for (const paragraph of listing.split("\n\n")) {
    const [head, ...lines] = paragraph
      .replaceAll(/```\w*/g, "")
      .trim()
      .split("\n");
    const found = /^(client|server): (\w+)/.exec(head!);
    const number = entries.length;
    if (found !== null) {
      const message = new Uint8Array(Buffer.from(lines.join("").replaceAll(" ", ""), "hex"));
      entries.push({ number, side: found[1] as "client" | "server", name: found[2]!, message });
    } else if (head!.startsWith("the connection breaks")) {
      entries.push({ number, side: "lost", name: "lost", message: new Uint8Array() });
    }
  }
  return entries;
}

export function hex(message: Uint8Array): string {
  return Buffer.from(message).toString("hex");
}
