/** `<lodestream-view>`: a surface that comes into focus, with its controls. */

import { type Appearance, changesOf, sharedWith, withAppearance } from "./appearance";
import type { Orbit } from "./camera";
import { html, isStill, setText } from "./dom";
import { FocusPanel } from "./focus-panel";
import { Framing } from "./framing";
import type { FromGeometry } from "./geometry-messages";
import { type Command, listen } from "./gestures";
import { Legend, ScaleBar } from "./legend";
import { fieldsOf, type Look, legendOf, mapFor, sameField, shownRange } from "./look";
import { LookPanel } from "./look-panel";
import { Probe } from "./probe";
import { Session } from "./session";
import { Sharing } from "./sharing";
import type { Moment, Source, SurfaceInfo, Target } from "./source";
import { Stage } from "./stage";
import { styles } from "./styles";
import type { SharedView } from "./url-state";
import { Viewpoint } from "./viewpoint";

type Patches = Extract<FromGeometry, { kind: "patches" }>;

/** Makes the source of an address; null: this is not its kind of address. */
export type SourceMaker = (src: string, options: { readonly token: string | null }) => Source | null;

/**
 * Shows the surface at `src`.
 *
 * Attributes: `src`, the address of a surface or container; `max-triangles`, 4 million unless given; `autostop="off"`
 * goes on when the picture looks done; `share` keeps the view in the address of the page, after #; `name` is shown
 * in place of the surface's.
 *
 * Events: `lodestream-info`, `lodestream-moment`, `lodestream-progress`, each with what has come as `detail`, and
 * `lodestream-drawn` when a picture is drawn; `lodestream-look` with what the user has changed of the `Appearance`,
 * `lodestream-region` with the region in the view that is asked for first or null, and `lodestream-values` with the
 * `NodeValues` under the pointer or null.
 */
export class LodestreamView extends HTMLElement {
  static readonly observedAttributes = ["src", "max-triangles", "autostop"];
  /** Makers of sources; the first that knows an address is used. */
  static readonly sources: SourceMaker[] = [];

  private readonly canvas = html("canvas", { tabindex: 0, role: "application", "aria-describedby": "values status" });
  private readonly notice = html("div", { class: "notice", role: "alert" });
  private readonly values = html("p", { class: "values", id: "values", "aria-live": "polite", "aria-label": "Values" });
  private readonly mark = html("div", { class: "mark", "aria-hidden": "true", hidden: true });
  private readonly legend = new Legend();
  private readonly scales = new ScaleBar();
  private readonly focusPanel: FocusPanel;
  private readonly lookPanel: LookPanel;
  private readonly probe: Probe;
  private readonly sharing = new Sharing(() => this.sharedView());
  private stage: Stage | null = null;
  private session: Session | null = null;
  private viewpoint = this.newViewpoint();
  private gliding = 0;
  private latest: Patches | null = null;
  private look: Look = { field: { kind: "height" }, map: "viridis", range: null, exaggeration: 1, lines: false };
  private shared: SharedView = {};
  private silentSince = 0;
  private lastBytes = -1;
  private life: AbortController | null = null;
  private failed = false;
  private pending = 0;
  private secret: string | null = null;

  constructor() {
    super();
    const root = this.attachShadow({ mode: "open" });
    root.adoptedStyleSheets = [styles()];
    this.focusPanel = new FocusPanel({
      stop: () => this.session?.stop(),
      resume: () => this.goOn(),
      show: (moment) => {
        this.session?.show(moment);
        this.refresh();
      },
      setTarget: (target) => this.session?.setTarget(target),
      throttle: (rate) => this.throttle(rate),
      limit: (rate) => this.session?.source.throttle(rate),
      endByItself: (on) => this.endByItself(on),
    });
    this.lookPanel = new LookPanel(
      (look) => this.changeLook(look),
      (which) => this.command(which),
    );
    this.probe = new Probe(
      this.values,
      () => this.stage?.draw(),
      (values) => this.tell("values", values),
    );
    root.append(
      html(
        "div",
        { class: "frame" },
        html("div", { class: "stage" }, this.canvas, this.mark, this.scales.element, this.legend.element, this.notice),
        this.values,
        html(
          "div",
          { class: "panel", tabindex: 0, role: "group", "aria-label": "Controls" },
          this.focusPanel.element,
          this.lookPanel.element,
          this.lookPanel.keys,
        ),
      ),
    );
    this.lookPanel.draw(this.look, [Number.NaN, Number.NaN], false);
    this.legend.draw(null);
    this.scales.draw(0, "", null);
    this.probe.clear();
  }

  /** The address of the surface. */
  get src(): string {
    return this.getAttribute("src") ?? "";
  }

  set src(value: string) {
    this.setAttribute("src", value);
  }

  /** A token for servers that want one; never an attribute, so that it does not stand in the document. */
  set token(value: string | null) {
    this.secret = value;
  }

  /** The surface's description; null while it is not known. */
  get info(): SurfaceInfo | null {
    return this.session?.info ?? null;
  }

  /** All moments so far. */
  get moments(): readonly Moment[] {
    return this.session?.moments ?? [];
  }

  /** What is asked for; kept for other surfaces too. Of several limits the first that is given counts. */
  set target(target: Target) {
    this.focusPanel.choose(target);
  }

  /** Ends the transmission. */
  stop(): void {
    this.session?.stop();
  }

  /** Goes on, after the end of a target or a failure too. */
  resume(): void {
    this.goOn();
  }

  /** Sets some of how the surface looks; what is null follows the surface. */
  setAppearance(by: Appearance): void {
    const { framing } = this.viewpoint;
    if (framing === null) this.shared = sharedWith(this.shared, by);
    const info = this.session?.info ?? null;
    const look = withAppearance(this.look, by, info, framing?.exaggeration ?? 1);
    if (look.field !== this.look.field) this.setLook({ ...this.look, field: look.field });
    this.setLook(look);
    if (by.exaggeration === null) this.viewpoint.unchoose();
  }

  connectedCallback(): void {
    this.life = new AbortController();
    const { signal } = this.life;
    try {
      this.stage = new Stage(this.canvas, () => this.drawOver());
    } catch {
      setText(this.notice, "This browser does not offer WebGL2, which drawing needs.");
      return;
    }
    const watcher = new ResizeObserver(() => {
      this.stage?.resize();
      this.viewpoint.resize(this.aspect);
      this.session?.viewChanged();
    });
    watcher.observe(this.canvas);
    signal.addEventListener("abort", () => watcher.disconnect());
    listen(
      this.canvas,
      {
        orbit: () => this.viewpoint.orbit ?? { azimuth: 0, elevation: 30, distance: 5, target: [0, 0, 0] },
        setOrbit: (orbit) => this.viewpoint.place(orbit),
        anchor: () => this.anchor(),
        point: (at) => this.point(at),
        command: (name) => this.command(name),
      },
      signal,
    );
    const timer = setInterval(() => this.watchSilence(), 1000);
    signal.addEventListener("abort", () => clearInterval(timer));
    if (this.hasAttribute("share")) {
      this.shared = this.sharing.given;
      addEventListener("hashchange", () => this.takeShared(this.sharing.given), { signal });
    }
    this.open();
  }

  disconnectedCallback(): void {
    this.life?.abort();
    cancelAnimationFrame(this.gliding);
    this.gliding = 0;
    this.session?.close();
    this.session = null;
    this.stage?.dispose();
    this.stage = null;
  }

  attributeChangedCallback(name: string, before: string | null, value: string | null): void {
    if (before === value || this.stage === null) return;
    if (name === "src") this.open();
    else if (name === "max-triangles") this.session?.setTriangles(this.mostTriangles);
    else this.endByItself(value !== "off");
  }

  private get mostTriangles(): number {
    const given = Number(this.getAttribute("max-triangles") ?? Number.NaN);
    return Number.isFinite(given) && given >= 2 ? given : 4_000_000;
  }

  private open(): void {
    this.session?.close();
    this.session = null;
    this.viewpoint = this.newViewpoint();
    this.latest = null;
    this.notice.textContent = "";
    const { src, stage } = this;
    if (src === "" || stage === null) return;
    const source = LodestreamView.sources.reduce<Source | null>(
      (made, maker) => made ?? maker(src, { token: this.secret }),
      null,
    );
    if (source === null) {
      setText(this.notice, `This is not the address of a surface: ${src}`);
      return;
    }
    this.session = new Session(
      source,
      stage,
      {
        info: (info) => this.takeInfo(info),
        moment: (moment) => this.changed("moment", moment),
        progress: (progress) => {
          if (progress.bytes !== this.lastBytes) this.silentSince = performance.now();
          this.lastBytes = progress.bytes;
          if (progress.state === "failed") setText(this.notice, progress.detail);
          else if (this.failed) setText(this.notice, "");
          this.failed = progress.state === "failed";
          this.changed("progress", progress);
        },
        refined: () => this.session !== null && this.probe.again(this.session),
        drawn: (patches, moment) => this.drawn(patches, moment),
        failed: (detail) => setText(this.notice, detail),
        region: (region) => this.tell("region", region),
      },
      this.mostTriangles,
    );
    this.endByItself(this.getAttribute("autostop") !== "off");
    this.look = { ...this.look, field: this.shared.field ?? { kind: "height" }, range: this.shared.range ?? null };
    this.session.setField(this.look.field);
    this.colour();
    this.focusPanel.begin(this.shared.rate);
  }

  /** Goes on; where what has come is of no use, from the beginning, seen as it is now. */
  private goOn(): void {
    const { session } = this;
    if (session?.progress.state !== "failed" || session.progress.useless !== true) {
      session?.resume();
      this.focusPanel.setEndsByItself(session?.endsByItself ?? true); // whoever wants the rest wants all of it
      return;
    }
    this.again();
  }

  /** Begins anew, seen as it is now. */
  private again(): void {
    const below = this.session?.endsByItself ?? true;
    this.shared = this.viewpoint.framing === null ? this.ordered() : this.view();
    this.open();
    this.endByItself(below);
  }

  /** Asks for at most so many bytes a second; where nothing is under way any more, for all of them again. */
  private throttle(rate: number | null): void {
    const { session } = this;
    this.sharing.later();
    if (rate !== null && session !== null && !this.focusPanel.canStop) this.again();
    else session?.source.throttle(rate);
  }

  private endByItself(on: boolean): void {
    this.focusPanel.setEndsByItself(on);
    if (this.session === null) return;
    this.session.endsByItself = on;
    this.session.judge();
    this.refresh();
  }

  private takeInfo(info: SurfaceInfo): void {
    this.viewpoint.relocate();
    const name = this.getAttribute("name") ?? info.name;
    this.canvas.setAttribute(
      "aria-label",
      `Surface ${name}. Arrow keys turn it, plus and minus zoom.`.replace("  ", " "),
    );
    this.lookPanel.offer(info);
    const { field } = this.look;
    if (!fieldsOf(info).some((other) => sameField(other, field)))
      this.setLook({ ...this.look, field: { kind: "height" } });
    this.setLook({
      ...this.look,
      map: this.shared.map ?? (this.latest === null ? mapFor(this.look.field, info) : this.look.map),
      lines: this.shared.lines ?? this.look.lines,
    });
    this.changed("info", info);
  }

  private drawn(patches: Patches, moment: Moment): void {
    const { stage, session } = this;
    if (stage === null || session?.info == null) return;
    this.latest = patches;
    if (patches.fresh) this.follow(new Framing(patches.frame, patches.box, session.info));
    this.colour();
    this.canvas.dataset.triangles = String(patches.triangles);
    this.refresh();
    if (!patches.fresh) return;
    this.probe.again(session);
    this.tell("drawn", { moment, level: patches.level, triangles: patches.triangles });
  }

  private get aspect(): number {
    const [width, height] = this.stage?.size ?? [1, 1];
    return width / height;
  }

  private newViewpoint(): Viewpoint {
    return new Viewpoint(({ orbit, exaggeration }) => {
      this.stage?.setOrbit(orbit);
      this.stage?.setExaggeration(exaggeration);
      this.session?.viewChanged();
      this.sharing.later();
    });
  }

  /** Camera and exaggeration follow what the picture shows of the surface, unless somebody has set them. */
  private follow(framing: Framing): void {
    const { viewpoint } = this;
    this.stage?.setRadius(framing.radius);
    viewpoint.take(framing, this.aspect, isStill() ? null : performance.now(), this.shared);
    this.shared = {};
    this.look = { ...this.look, exaggeration: viewpoint.exaggeration };
    if (this.gliding === 0) this.glide();
  }

  private glide(): void {
    this.gliding = requestAnimationFrame(() => {
      this.gliding = 0;
      if (this.viewpoint.advance(performance.now())) this.glide();
    });
  }

  private changed(kind: "info" | "moment" | "progress", detail: unknown): void {
    this.refresh();
    this.tell(kind, detail);
  }

  private tell(kind: string, detail: unknown): void {
    this.dispatchEvent(new CustomEvent(`lodestream-${kind}`, { detail }));
  }

  /** Draws the panel with the next frame. */
  private refresh(): void {
    if (this.pending !== 0) return;
    this.pending = requestAnimationFrame(() => {
      this.pending = 0;
      const { session } = this;
      if (session === null) return;
      const silent =
        session.progress.state === "receiving" ? Math.floor((performance.now() - this.silentSince) / 1000) : 0;
      this.focusPanel.draw({
        info: session.info,
        moments: session.moments,
        drawn: session.drawnMoment,
        drawnLevel: this.latest?.level ?? 0,
        following: session.following,
        awaited: session.awaitsChosen,
        progress: session.progress,
        looksDone: session.looksDone,
        silent,
      });
    });
  }

  private watchSilence(): void {
    if (this.session?.progress.state === "receiving" && performance.now() - this.silentSince > 2500) this.refresh();
  }

  /** Sets a look as the user wants it. */
  private changeLook(look: Look): void {
    const before = this.look;
    this.setLook(look);
    const changes = changesOf(before, this.look);
    if (this.viewpoint.framing === null) this.shared = sharedWith(this.shared, changes);
    this.tell("look", changes);
  }

  private setLook(look: Look): void {
    const { session } = this;
    const before = this.look;
    if (!sameField(look.field, before.field)) {
      session?.setField(look.field);
      look = { ...look, map: mapFor(look.field, session?.info ?? null), range: null };
    }
    this.look = look;
    if (look.exaggeration !== before.exaggeration) this.viewpoint.exaggerate(look.exaggeration);
    this.colour();
    this.session?.judgeSoon();
    this.sharing.later();
  }

  /** Colours and legend by the range that is chosen or found. */
  private colour(): void {
    const { latest, look, session, stage } = this;
    const range = latest === null ? null : shownRange(look, latest.colouring);
    this.lookPanel.draw(look, range ?? [Number.NaN, Number.NaN], this.viewpoint.framing?.isFitted ?? false);
    if (latest === null || range === null || stage === null) return;
    const { low, span } = latest.colouring;
    stage.setLook(look, (range[0] - low) / span, (range[1] - low) / span);
    this.legend.draw(legendOf(look, range, session?.info ?? null, this.viewpoint.framing?.isFitted));
  }

  /** Draws what lies over the picture: scale, north, and the place whose values are shown. */
  private drawOver(): void {
    const { session, stage } = this;
    const { orbit, framing } = this.viewpoint;
    if (orbit === null || framing === null || stage === null || session?.info == null) return;
    const { pixels, unit } = framing.scale(orbit, stage.size[1]);
    this.scales.draw(pixels, unit, session.info.georeferenced ? orbit.azimuth : null);
    const { at } = this.probe;
    this.mark.hidden = at === null;
    if (at === null) return;
    const [x, y] = stage.project(framing.drawn(at, 1));
    this.mark.style.translate = `${x.toFixed(1)}px ${y.toFixed(1)}px`;
  }

  private command(name: Command): void {
    const { session } = this;
    switch (name) {
      case "home":
        this.viewpoint.goHome();
        break;
      case "top":
        this.viewpoint.goAbove();
        break;
      case "stop":
        if (this.focusPanel.canStop) session?.stop();
        else this.goOn();
        break;
      case "lines":
        this.changeLook({ ...this.look, lines: !this.look.lines });
        break;
      case "earlier":
        this.focusPanel.step(-1);
        break;
      case "later":
        this.focusPanel.step(1);
        break;
      case "latest":
        session?.show(null);
        break;
      case "probe":
        if (this.stage !== null) this.point([this.stage.size[0] / 2, this.stage.size[1] / 2]);
        break;
      case "exaggerate":
      case "flatten":
        this.changeLook({
          ...this.look,
          exaggeration: Math.min(Math.max(this.look.exaggeration * (name === "flatten" ? 0.8 : 1.25), 0.1), 100),
        });
        break;
    }
    this.refresh();
  }

  private point(at: readonly [number, number] | null): void {
    const { session, stage } = this;
    if (session === null || stage === null) return;
    this.probe.point(session, at === null ? null : stage.ray(...at));
  }

  /** The last place under the pointer, as it is drawn. */
  private anchor(): [number, number, number] | null {
    const { at } = this.probe;
    const { framing } = this.viewpoint;
    return at === null || framing === null ? null : framing.drawn(at, this.look.exaggeration);
  }

  private sharedView(): SharedView | null {
    return this.isConnected && this.hasAttribute("share") && this.camera !== null ? this.view() : null;
  }

  /** The view as it can be shown again: what nobody has set is left to follow the surface then too. */
  private view(): SharedView {
    const { camera, isHeld, isChosen } = this.viewpoint;
    const { chosenRate: rate } = this.focusPanel;
    const { field, map, range, exaggeration, lines } = this.look;
    return {
      ...(isHeld && camera !== null ? { camera } : {}),
      field,
      map,
      ...(isHeld || isChosen ? { exaggeration } : {}),
      lines,
      ...(range === null ? {} : { range }),
      ...(rate === null ? {} : { rate }),
    };
  }

  /** What the first picture is to look like: what nobody has set is left to the surface, which is not known yet. */
  private ordered(): SharedView {
    const { rate: _, ...shared } = this.shared;
    const { chosenRate: rate } = this.focusPanel;
    return rate === null ? shared : { ...shared, rate };
  }

  /** Shows the view of an address that the user has entered. */
  private takeShared({ camera, field, map, range, exaggeration, lines }: SharedView): void {
    const { framing } = this.viewpoint;
    if (framing === null) return;
    const { look } = this;
    if (field !== undefined && !sameField(field, look.field)) this.setLook({ ...look, field });
    const kept = this.look;
    this.setLook({
      ...kept,
      map: map ?? kept.map,
      range: range ?? null,
      exaggeration: exaggeration ?? kept.exaggeration,
      lines: lines ?? false,
    });
    if (camera !== undefined) this.viewpoint.place(framing.toDrawn(camera, this.look.exaggeration));
  }

  /** Where the surface is seen from, in its own coordinates; null before the first picture. */
  get camera(): Orbit | null {
    return this.viewpoint.camera;
  }
}
