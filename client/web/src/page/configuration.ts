/** What the page shows: a server's surfaces, or those that the file `view.json` beside the page names. */

/** One surface of a static host. */
export interface ShownSurface {
  /** Address of the container, relative to the page. */
  readonly src: string;
  /** What follows # in the address of this surface; it stays when the container changes. */
  readonly name: string;
  /** What it is called on the page. */
  readonly title: string;
  readonly bytes: number | null;
  /** 0 to 1 while the container is still being made; null: it is there. */
  readonly progress: number | null;
}

/** The file beside the page. */
export const CONFIGURATION = "view.json";

/** Checks what a configuration says. @throws TypeError if it is none. */
export function parseConfiguration(value: unknown): ShownSurface[] {
  const { surfaces } = (typeof value === "object" && value !== null ? value : {}) as Record<string, unknown>;
  if (!Array.isArray(surfaces)) throw new TypeError(`expected a list of surfaces in ${CONFIGURATION}, got none`);
  return surfaces.map((surface: unknown) => {
    const { src, name, title, bytes, progress } = (surface ?? {}) as Record<string, unknown>;
    if (typeof src !== "string" || src === "")
      throw new TypeError(`expected the "src" of a surface in ${CONFIGURATION}`);
    const number = (given: unknown): number | null =>
      typeof given === "number" && Number.isFinite(given) ? given : null;
    const called = typeof name === "string" && name !== "" ? name : src;
    return {
      src,
      name: called,
      title: typeof title === "string" && title !== "" ? title : called,
      bytes: number(bytes),
      progress: number(progress),
    };
  });
}

/**
 * The surfaces that the page shows.
 *
 * @returns null for those of the server that the page came from: there is no file, or an empty one (`{}`).
 * @throws Error if there is one that cannot be read.
 */
export async function configured(): Promise<ShownSurface[] | null> {
  const answer = await fetch(new URL(CONFIGURATION, document.baseURI), {
    cache: "no-store",
    credentials: "same-origin",
  });
  if (!answer.ok || answer.status === 204) return null;
  const value: unknown = await answer.json();
  const empty = typeof value === "object" && value !== null && Object.keys(value).length === 0;
  return empty ? null : parseConfiguration(value);
}
