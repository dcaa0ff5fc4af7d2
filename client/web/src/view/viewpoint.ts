/**
 * Where a surface is seen from, and by how much its heights are exaggerated: both follow what is known of the surface
 * until somebody sets them. Computes only; whoever has a clock calls `advance`.
 */

import { blended, nearly, type Orbit } from "./camera";
import type { Framing } from "./framing";

/** Milliseconds in which the camera follows a surface that turns out to lie elsewhere. */
const GLIDE = 500;

/** What decides the first view in place of the surface. */
export interface GivenView {
  /** In the surface's coordinates. */
  readonly camera?: Orbit | undefined;
  readonly exaggeration?: number | undefined;
}

interface Pose {
  readonly orbit: Orbit;
  readonly exaggeration: number;
}

/** Camera and exaggeration of one surface. */
export class Viewpoint {
  /** Of the last picture; null before the first. */
  framing: Framing | null = null;
  private pose: Pose | null = null;
  private home: Orbit | null = null;
  private aim: Pose | null = null;
  private aspect = 1;
  private held = false;
  private chosen: number | null = null;
  private glide: { readonly from: Pose; readonly began: number } | null = null;

  /** @param show - Takes what is to be drawn, whenever it is another. */
  constructor(private readonly show: (pose: Pose) => void) {}

  /** The camera as it is drawn; null before the first picture. */
  get orbit(): Orbit | null {
    return this.pose?.orbit ?? null;
  }

  /** The same in the surface's coordinates. */
  get camera(): Orbit | null {
    const { pose, framing } = this;
    return pose === null || framing === null ? null : framing.toSurface(pose.orbit, pose.exaggeration);
  }

  /** The exaggeration that holds, or towards which the picture is moving. */
  get exaggeration(): number {
    return this.aim?.exaggeration ?? this.chosen ?? 1;
  }

  /** Whether somebody has placed the camera: then it does not move by itself. */
  get isHeld(): boolean {
    return this.held;
  }

  /** Whether somebody has chosen the exaggeration. */
  get isChosen(): boolean {
    return this.chosen !== null;
  }

  /**
   * Takes the framing of another picture.
   *
   * @param aspect - Width of the view by its height.
   * @param now - Milliseconds of any clock; null: nothing is to move, what is seen from elsewhere is so at once.
   * @param given - Of the first picture only.
   */
  take(framing: Framing, aspect: number, now: number | null, given: GivenView = {}): void {
    const { framing: before, pose } = this;
    this.framing = framing;
    this.aspect = aspect;
    if (pose === null) {
      this.chosen ??= given.exaggeration ?? null;
      const exaggeration = this.chosen ?? framing.exaggeration;
      this.home = framing.home(exaggeration, aspect);
      this.held = given.camera !== undefined;
      const orbit = given.camera === undefined ? this.home : framing.toDrawn(given.camera, exaggeration);
      this.put({ orbit, exaggeration });
      return;
    }
    if (before === null) this.put({ orbit: pose.orbit, exaggeration: this.chosen ?? framing.exaggeration });
    else if (before.differs(framing.frame)) {
      // The same view in the other frame; where it is seen from follows.
      const moved = (orbit: Orbit, by: number): Orbit => framing.toDrawn(before.toSurface(orbit, by), by);
      this.home = this.home === null ? null : moved(this.home, this.exaggeration);
      this.put({ ...pose, orbit: moved(pose.orbit, pose.exaggeration) });
    }
    this.settle(now);
  }

  /** The next picture has other coordinates: what is seen stays where it is drawn. */
  relocate(): void {
    this.framing = null;
  }

  /** Takes another size of the view. */
  resize(aspect: number): void {
    this.aspect = aspect;
    this.settle(null);
  }

  /** Places the camera, as somebody wants it. */
  place(orbit: Orbit): void {
    this.held = true;
    this.put({ orbit, exaggeration: this.exaggeration });
  }

  /** Shows all, and from then on follows the surface again. */
  goHome(): void {
    if (this.home === null) return;
    this.held = false;
    this.put({ orbit: this.home, exaggeration: this.exaggeration });
  }

  /** Shows all from above. */
  goAbove(): void {
    if (this.framing !== null) this.place(this.framing.above(this.exaggeration, this.aspect));
  }

  /** Exaggerates heights, as somebody wants it; what the camera looks at stays where it is seen. */
  exaggerate(exaggeration: number): void {
    this.chosen = exaggeration;
    const { pose, framing } = this;
    if (pose === null || framing === null) return;
    const [x, y, z] = pose.orbit.target;
    const target = [x, y, (z / pose.exaggeration) * exaggeration] as const;
    this.home = framing.home(exaggeration, this.aspect);
    this.put({ orbit: { ...pose.orbit, target }, exaggeration });
  }

  /** Lets the exaggeration follow the surface again. */
  unchoose(): void {
    this.chosen = null;
  }

  /** Draws what has moved until now. @returns whether it goes on. */
  advance(now: number): boolean {
    const { glide, aim } = this;
    if (glide === null || aim === null) return false;
    const share = Math.min(Math.max((now - glide.began) / GLIDE, 0), 1);
    if (share === 1) {
      this.put(aim);
      return false;
    }
    const eased = share * share * (3 - 2 * share);
    const { from } = glide;
    this.pose = {
      orbit: blended(from.orbit, aim.orbit, eased),
      exaggeration: from.exaggeration * (aim.exaggeration / from.exaggeration) ** eased,
    };
    this.show(this.pose);
    return true;
  }

  /** Computes anew what shows all, and goes there if nobody has placed the camera. Small differences are left. */
  private settle(now: number | null): void {
    const { framing, pose, aspect } = this;
    if (framing === null || pose === null) return;
    const exaggeration = this.chosen ?? (this.held ? this.exaggeration : framing.exaggeration);
    const home = framing.home(exaggeration, aspect);
    if (this.home !== null && exaggeration === this.exaggeration && nearly(this.home, home)) return;
    this.home = home;
    if (this.held) return;
    const aim = { orbit: home, exaggeration };
    if (now === null) this.put(aim);
    else {
      this.aim = aim;
      this.glide = { from: pose, began: now };
    }
  }

  private put(pose: Pose): void {
    this.pose = pose;
    this.aim = pose;
    this.glide = null;
    this.show(pose);
  }
}
