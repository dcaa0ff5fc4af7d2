/** Names on published pages, see docs/publishing.md: which container they lead to now. */

import { NotFoundError, RemoteProtocolError } from "../errors";
import { isSurface, sameOrigin } from "./addresses";
import { fromResponse } from "./problems";

/** Bytes of the longest list that is read. */
const LONGEST = 16 * 1024 * 1024;
const LONGEST_PROBLEM = 64 * 1024;

/** The address of the list of a published page, and the name on it; undefined if this is no `PAGE#NAME`. */
export function publishedName(url: string): { readonly list: string; readonly name: string } | undefined {
  const page = new URL(url);
  // What has an equals sign, and what the page adds after &, tell how a surface is looked at.
  const [name] = page.hash.slice(1).split("&", 1);
  if (!name || name.includes("=") || isSurface(url)) return undefined;
  page.hash = page.search = "";
  return { list: new URL("view.json", page).href, name: unescaped(name) };
}

/**
 * The address of the container to which a name leads now; any other address as it is.
 *
 * @throws NotFoundError if there is no such page, or no such name on it.
 * @throws RemoteProtocolError if its list cannot be read, or leads to another host.
 */
export async function locate(
  url: string,
  headers: Readonly<Record<string, string>>,
  fetch: typeof globalThis.fetch,
  signal: AbortSignal,
): Promise<string> {
  const place = publishedName(url);
  if (place === undefined) return url;
  const { list, name } = place;
  const answer = await fetch(list, { headers, cache: "no-store", credentials: "same-origin", signal });
  const text = await textOf(answer, answer.ok ? LONGEST : LONGEST_PROBLEM);
  if (!answer.ok) throw fromResponse(answer.status, answer.statusText, text ?? "", list);
  const entries = text === undefined ? undefined : entriesOf(text);
  if (entries === undefined) throw new RemoteProtocolError(`expected the surfaces of a published page from ${list}`);
  const found = entries.find((entry) => entry.name === name);
  if (found === undefined) throw new NotFoundError(`nothing is published at ${list} under the name ${name}`);
  const container = URL.canParse(found.src, list) ? new URL(found.src, list) : undefined;
  if (container === undefined || !sameOrigin(container.href, list) || container.hash !== "") {
    const { origin } = new URL(list);
    throw new RemoteProtocolError(`expected a container of ${origin}, got ${JSON.stringify(found.src.slice(0, 200))}`);
  }
  return container.href;
}

/** The text of a body; undefined if it has more bytes than allowed. */
async function textOf(answer: Response, most: number): Promise<string | undefined> {
  const reader = answer.body?.getReader();
  const decoder = new TextDecoder();
  let text = "";
  let size = 0;
  for (;;) {
    const { value } = (await reader?.read()) ?? {};
    if (value === undefined) return text + decoder.decode();
    size += value.length;
    if (size > most) {
      await reader!.cancel();
      return undefined;
    }
    text += decoder.decode(value, { stream: true });
  }
}

function entriesOf(text: string): { readonly name: string; readonly src: string }[] | undefined {
  let value: unknown;
  try {
    value = JSON.parse(text);
  } catch {
    return undefined;
  }
  const { surfaces } = (value ?? {}) as Record<string, unknown>;
  if (!Array.isArray(surfaces)) return undefined;
  const entries = surfaces.map((entry: unknown) => (entry ?? {}) as Record<string, unknown>);
  const valid = entries.every(({ name, src }) => typeof name === "string" && typeof src === "string");
  return valid ? (entries as { name: string; src: string }[]) : undefined;
}

function unescaped(text: string): string {
  try {
    return decodeURIComponent(text);
  } catch {
    return text; // anybody can write an address
  }
}
