/** URLs of surfaces on a server, of names that lead to them, and of container files. */

import { OptionError } from "../errors";

const COLLECTIONS = /\/v1\/(?:surfaces|names)$/;

/**
 * The URL of something that can be received: a surface on a server, a name there that leads to one, a container file on
 * any web server, or a name on a published page, `PAGE#NAME`.
 *
 * @param base What a relative URL refers to; in a page the page's own address.
 * @throws OptionError if this is none of them.
 */
export function sourceUrl(given: string | URL, base?: string): string {
  const url = parsed(given, base);
  if (isSurface(url.href) || isName(url.href)) {
    url.hash = url.search = "";
    url.pathname = url.pathname.replace(/\/+$/, "");
    return url.href;
  }
  // The query may be what allows reading a file.
  if (url.hash.length > 1 && !/^#[^&]*=/.test(url.hash)) return url.href;
  url.hash = "";
  if (url.pathname === "/" || COLLECTIONS.test(url.pathname.replace(/\/+$/, ""))) {
    throw new OptionError(
      "expected a surface's address such as http://HOST/v1/surfaces/ID, a container's such as " +
        `http://HOST/NAME.lode, or a published name's such as http://HOST/#NAME, got ${url.href}`,
    );
  }
  return url.href;
}

/** Whether this is the URL of a surface, not of a file. */
export function isSurface(url: string): boolean {
  return /\/v1\/surfaces\/[^/]+\/*$/.test(new URL(url).pathname);
}

/** Whether this is the URL of a name on a server, which leads to one surface now and perhaps to another one later. */
export function isName(url: string): boolean {
  return /\/v1\/names\/[^/]+\/*$/.test(new URL(url).pathname);
}

/** The WebSocket URL of a surface's stream, perhaps with a query. */
export function streamUrl(url: string, query?: string): string {
  const address = `${url.replace(/^http/, "ws")}/stream`;
  return query === undefined ? address : `${address}?${query}`;
}

/** The URL from which a container can be fetched, given the URL of its surface or of its file. */
export function containerUrl(url: string): string {
  return isSurface(url) ? `${url}/container` : url;
}

/** Whether two URLs have the same scheme, host and port. A token is only ever sent to the origin it was given for. */
export function sameOrigin(one: string, other: string): boolean {
  return new URL(one).origin === new URL(other).origin;
}

function parsed(given: string | URL, base: string | undefined): URL {
  let url: URL;
  try {
    url = new URL(given, base);
  } catch {
    throw new OptionError(`expected an address such as http://HOST/v1/surfaces/ID, got ${String(given).slice(0, 200)}`);
  }
  if (url.protocol !== "http:" && url.protocol !== "https:") {
    throw new OptionError(`expected an address that begins with http:// or https://, got ${url.href.slice(0, 200)}`);
  }
  return url;
}
