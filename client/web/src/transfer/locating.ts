/** Names, on servers and on published pages (docs/publishing.md): which surface or container they lead to now. */

import { NotFoundError, RemoteProtocolError } from "../errors";
import { isName, isSurface, sameOrigin } from "./addresses";
import { Patience } from "./patience";
import { brokeOff, fromResponse, isCutShort } from "./problems";

/** Bytes of the longest answer that is read. */
const LONGEST = 16 * 1024 * 1024;
const LONGEST_PROBLEM = 64 * 1024;

/** The address of the list of a published page, and the name on it; undefined if this is no `PAGE#NAME`. */
export function publishedName(url: string): { readonly list: string; readonly name: string } | undefined {
  const page = new URL(url);
  // What has an equals sign, and what the page adds after &, tell how a surface is looked at.
  const [name] = page.hash.slice(1).split("&", 1);
  if (!name || name.includes("=") || isSurface(url) || isName(url)) return undefined;
  page.hash = page.search = "";
  return { list: new URL("view.json", page).href, name: unescaped(name) };
}

/** Whether an address leads to one surface now and perhaps to another one later. */
export function isNamed(url: string): boolean {
  return isName(url) || publishedName(url) !== undefined;
}

/** Where a surface or container is. A name is asked for once: a stream ends on what it begins. */
export class Place {
  /** The address; that of a name until it is known where this leads. */
  url: string;

  /** @param token Goes to no other origin. */
  constructor(
    private readonly home: string,
    private readonly token: string | undefined,
    private readonly fetch: typeof globalThis.fetch,
  ) {
    this.url = home;
  }

  /** The header with the token for an address. */
  authorization(url: string): Record<string, string> {
    return this.token !== undefined && sameOrigin(url, this.home) ? { Authorization: `Bearer ${this.token}` } : {};
  }

  /**
   * The address of the surface or container.
   *
   * @param patience Gives the seconds without an answer after which it counts as lost.
   * @throws LodestreamError if a name leads nowhere, or there is no answer.
   */
  async find(patience: () => number, signal: AbortSignal): Promise<string> {
    if (isNamed(this.url)) {
      const timer = new Patience(patience, signal);
      const headers = this.authorization(this.url);
      this.url = await timer.wait(this.url, () => locate(this.url, headers, this.fetch, timer.signal));
      timer.end();
    }
    return this.url;
  }
}

/**
 * The address of the surface or container to which a name leads now; any other address as it is.
 *
 * @throws NotFoundError if there is no such server or page, or no such name on it.
 * @throws RemoteProtocolError if the answer cannot be read, or leads to another host.
 */
export async function locate(
  url: string,
  headers: Readonly<Record<string, string>>,
  fetch: typeof globalThis.fetch,
  signal: AbortSignal,
): Promise<string> {
  if (!isNamed(url)) return url;
  const place = publishedName(url);
  const asked = place?.list ?? url;
  const answer = await fetch(asked, { headers, cache: "no-store", credentials: "same-origin", signal });
  const text = await textOf(answer, answer.ok ? LONGEST : LONGEST_PROBLEM);
  if (text === "" && isCutShort(answer)) throw brokeOff(asked);
  if (!answer.ok) throw fromResponse(answer.status, answer.statusText, text ?? "", asked);
  if (place === undefined) {
    const surface = urlOf(text);
    const found = resolved(surface, url);
    if (found !== undefined && isSurface(found)) return found;
    throw new RemoteProtocolError(`expected a surface of ${new URL(url).origin}, got ${told(surface)}`);
  }
  const { list, name } = place;
  const entries = text === undefined ? undefined : entriesOf(text);
  if (entries === undefined) throw new RemoteProtocolError(`expected the surfaces of a published page from ${list}`);
  const found = entries.find((entry) => entry.name === name);
  if (found === undefined) throw new NotFoundError(`nothing is published at ${list} under the name ${name}`);
  const container = resolved(found.src, list);
  if (container !== undefined) return container;
  throw new RemoteProtocolError(`expected a container of ${new URL(list).origin}, got ${told(found.src)}`);
}

/** An address that an answer names, if it is one of the same host. */
function resolved(address: string, base: string): string | undefined {
  const url = URL.canParse(address, base) ? new URL(address, base) : undefined;
  return url !== undefined && sameOrigin(url.href, base) && url.hash === "" ? url.href : undefined;
}

function told(address: string): string {
  return JSON.stringify(address.slice(0, 200));
}

/** The address of a surface in its description; "" if there is none. */
function urlOf(text: string | undefined): string {
  try {
    const { url } = JSON.parse(text ?? "") as Record<string, unknown>;
    return typeof url === "string" ? url : "";
  } catch {
    return "";
  }
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
