/** The surfaces of a series, such as the steps of a forecast: a slider that goes from one to another. */

import { html, setText } from "../view/dom";
import type { ListedSurface } from "./api";
import { nameOf } from "./names";

/** The surfaces that can be shown of the series of one of them, by their place in it; of an equal place, the newest. */
export function seriesOf(surface: ListedSurface, all: Iterable<ListedSurface>): ListedSurface[] {
  const places = new Map<number, ListedSurface>();
  const { series } = surface;
  if (series === undefined) return [];
  for (const other of all) {
    if (other.state !== "ready" || other.series?.name !== series.name || other.series.along !== series.along) continue;
    const { index } = other.series;
    const known = places.get(index);
    if (other.id === surface.id || known === undefined || (known.id !== surface.id && known.created < other.created))
      places.set(index, other);
  }
  return [...places.values()].sort((a, b) => a.series!.index - b.series!.index);
}

/** What a surface is called beside the name of its series. */
export function stepOf(surface: ListedSurface): string {
  const name = nameOf(surface);
  const series = surface.series?.name ?? "";
  return series !== "" && name.startsWith(`${series} `) ? name.slice(series.length + 1) : name;
}

/** A slider over the surfaces of a series. */
export class SeriesSlider {
  private readonly slider: HTMLInputElement;
  private readonly text = html("output");
  readonly element: HTMLElement;

  /**
   * @param surfaces - Two or more, as `seriesOf` gives them.
   * @param choose - Called with the one that is chosen, once the slider is let go.
   */
  constructor(
    private readonly surfaces: readonly ListedSurface[],
    choose: (surface: ListedSurface) => void,
  ) {
    const along = surfaces[0]?.series?.along ?? "";
    this.slider = html("input", { type: "range", min: 0, max: surfaces.length - 1, step: 1, "aria-label": along });
    this.slider.addEventListener("input", () => this.tell());
    this.slider.addEventListener("change", () => {
      const surface = this.surfaces[Number(this.slider.value)];
      if (surface !== undefined) choose(surface);
    });
    this.element = html("div", { class: "series" }, html("span", {}, along), this.slider, this.text);
  }

  /** Shows which one is open. @returns false if it is none of them. */
  show(id: string): boolean {
    const place = this.surfaces.findIndex((surface) => surface.id === id);
    if (place < 0) return false;
    this.slider.value = String(place);
    this.tell();
    return true;
  }

  /** Puts the keyboard back, after the element was moved. */
  focus(): void {
    this.slider.focus();
  }

  private tell(): void {
    const surface = this.surfaces[Number(this.slider.value)];
    if (surface === undefined) return;
    const step = stepOf(surface);
    setText(this.text, `${step} (${Number(this.slider.value) + 1} of ${this.surfaces.length})`);
    this.slider.setAttribute("aria-valuetext", step);
  }
}
