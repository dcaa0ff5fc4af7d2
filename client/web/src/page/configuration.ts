/** What the page shows: a server's surfaces, or one surface that a file beside the page or its address names. */

/** One surface of a static host. */
export interface Configuration {
  /** Address of the container, relative to the page. */
  readonly src: string;
  readonly name: string;
}

/** Checks what a configuration file says. @throws TypeError if it is not one. */
export function parseConfiguration(value: unknown): Configuration {
  const { src, name } = (typeof value === "object" && value !== null ? value : {}) as Record<string, unknown>;
  if (typeof src !== "string" || src === "")
    throw new TypeError('expected a configuration with "src", the address of a container');
  return { src, name: typeof name === "string" ? name : "" };
}

/**
 * What the page is asked to show.
 *
 * @returns null for the surfaces of the server that the page came from.
 * @throws Error if the configuration cannot be read.
 */
export async function configured(): Promise<Configuration | null> {
  const asked = new URLSearchParams(location.search).get("src");
  if (asked !== null && asked !== "") return { src: asked, name: "" };
  const file = document.querySelector<HTMLMetaElement>('meta[name="lodestream-configuration"]')?.content ?? "";
  if (file === "") return null;
  const answer = await fetch(new URL(file, document.baseURI));
  if (!answer.ok) throw new Error(`expected ${file} beside the page, got ${answer.status}`);
  return parseConfiguration(await answer.json());
}
