/** The canvas: patches on the graphics card, the camera, and what is drawn when. */

import {
  BufferAttribute,
  BufferGeometry,
  Group,
  LineSegments,
  Matrix3,
  Matrix4,
  Mesh,
  PerspectiveCamera,
  Points,
  Scene,
  Sphere,
  Vector3,
  WebGLRenderer,
  WebGLRenderTarget,
} from "three";
import { clipping, type Orbit, positionOf, VIEW_ANGLE } from "./camera";
import type { Eye, PatchBuffers } from "./geometry-messages";
import { type Look, sameField } from "./look";
import { SurfaceMaterial } from "./material";

type Range = readonly [low: number, high: number];
type Drawable = Mesh<BufferGeometry, SurfaceMaterial> | LineSegments<BufferGeometry, SurfaceMaterial>;

/** Milliseconds in which new detail is blended in. */
const BLEND = 350;

/** What is drawn. Draws only when something has changed. */
export class Stage {
  private readonly material = new SurfaceMaterial();
  private readonly renderer: WebGLRenderer;
  private readonly scene = new Scene();
  private readonly group = new Group();
  private readonly camera = new PerspectiveCamera(VIEW_ANGLE, 1, 0.01, 100);
  private readonly meshes = new Map<number, Drawable>();
  private orbit: Orbit = { azimuth: 0, elevation: 30, distance: 5, target: [0, 0, 0] };
  private radius = 2;
  private exaggeration = 1;
  private frame = 0;
  private blend: { readonly began: number; readonly done: () => void } | null = null;
  private look: Look | null = null;
  private range: Range = [0, 1];
  private rangeBefore: Range | null = null;

  /**
   * @param canvas - Of any size; `resize` says how large it is shown.
   * @param drawn - Called after each drawing.
   * @throws Error if the browser has no WebGL2.
   */
  constructor(
    canvas: HTMLCanvasElement,
    private readonly drawn: () => void,
  ) {
    this.renderer = new WebGLRenderer({ canvas, antialias: true, alpha: true });
    this.camera.up.set(0, 0, 1);
    this.scene.add(this.group);
    this.material.uniforms.viewNormals!.value = new Matrix3();
  }

  /** Width and height of the view in CSS pixels. */
  get size(): [number, number] {
    const [width, height] = [this.renderer.domElement.clientWidth, this.renderer.domElement.clientHeight];
    return [Math.max(width, 1), Math.max(height, 1)];
  }

  /** Takes the size of the canvas as it is shown now. */
  resize(): void {
    const [width, height] = this.size;
    this.renderer.setPixelRatio(Math.min(devicePixelRatio, 2));
    this.material.set("thickness", 3 * this.renderer.getPixelRatio());
    this.renderer.setSize(width, height, false);
    this.camera.aspect = width / height;
    this.draw();
  }

  /**
   * Shows other patches.
   *
   * @param fresh - A new picture: it is blended in from what `from` of the buffers says, and nothing of the last stays.
   * @param done - Called when it is drawn as it is.
   */
  show(patches: readonly PatchBuffers[], fresh: boolean, blended: boolean, done: () => void): void {
    if (fresh) {
      this.finishBlend();
      this.rangeBefore = this.range;
      for (const mesh of this.meshes.values()) this.forget(mesh);
      this.meshes.clear();
    }
    for (const patch of patches) {
      const before = this.meshes.get(patch.patch);
      if (before !== undefined) this.forget(before);
      const mesh = this.drawable(patch);
      this.meshes.set(patch.patch, mesh);
      this.group.add(mesh);
    }
    if (fresh && blended) {
      this.material.set("morph", 0);
      this.blend = { began: performance.now(), done };
    } else {
      done();
    }
    this.draw();
  }

  /** Takes another place of the camera, in drawn coordinates with exaggeration. */
  setOrbit(orbit: Orbit): void {
    this.orbit = orbit;
    this.draw();
  }

  /** Colours by a map over a range of the values in the buffers. */
  setLook(look: Look, low: number, high: number): void {
    const { map, lines, field } = look;
    if (this.look === null || !sameField(this.look.field, field) || look.range !== null) this.rangeBefore = null;
    this.look = look;
    this.range = [low, high];
    this.material.setMap(map);
    this.material.setRange(low, high);
    this.material.set("lines", lines ? 1 : 0);
    this.material.set("plain", field.kind === "none" ? 1 : 0);
    this.draw();
  }

  /** Multiplies heights. */
  setExaggeration(exaggeration: number): void {
    this.exaggeration = exaggeration;
    this.group.scale.z = exaggeration;
    this.material.set("exaggeration", exaggeration);
    this.draw();
  }

  /** Says how far from 0 anything is drawn. */
  setRadius(radius: number): void {
    this.radius = radius;
    this.draw();
  }

  /** What the geometry worker needs to know of the view. */
  eye(): Eye {
    this.place();
    const matrix = new Matrix4().multiplyMatrices(this.camera.projectionMatrix, this.camera.matrixWorldInverse);
    const focal = (this.size[1] * this.renderer.getPixelRatio()) / (2 * Math.tan((VIEW_ANGLE * Math.PI) / 360));
    return { matrix: [...matrix.elements], position: positionOf(this.orbit), focal, exaggeration: this.exaggeration };
  }

  /**
   * The ray through a place of the view.
   *
   * @param x - CSS pixels from the left; `y` from the top.
   * @returns origin and direction in drawn coordinates before exaggeration.
   */
  ray(x: number, y: number): { origin: [number, number, number]; direction: [number, number, number] } {
    this.place();
    const [width, height] = this.size;
    const origin = positionOf(this.orbit);
    const far = new Vector3((2 * x) / width - 1, 1 - (2 * y) / height, 0.5).unproject(this.camera);
    const direction: [number, number, number] = [far.x - origin[0], far.y - origin[1], far.z - origin[2]];
    origin[2] /= this.exaggeration;
    direction[2] /= this.exaggeration;
    return { origin, direction };
  }

  /** Where a point of drawn coordinates (before exaggeration) is in the view, in CSS pixels. */
  project(point: readonly [number, number, number]): [number, number] {
    this.place();
    const [width, height] = this.size;
    const at = new Vector3(point[0], point[1], point[2] * this.exaggeration).project(this.camera);
    return [((at.x + 1) / 2) * width, ((1 - at.y) / 2) * height];
  }

  /**
   * Draws the picture before and the one in hand into memory, with one sample a pixel and at most so many pixels.
   *
   * @returns of each picture red, green, blue and alpha from 0 to 255, [row from below, column, 4]; alpha is 0 where
   * nothing is drawn. Without a picture before both are the same.
   */
  pictures(most: number): readonly [before: Uint8Array, now: Uint8Array] {
    const [width, height] = this.size;
    const share = Math.min(1, Math.sqrt(most / (width * height)));
    const target = new WebGLRenderTarget(
      Math.max(1, Math.floor(share * width)),
      Math.max(1, Math.floor(share * height)),
    );
    this.place();
    try {
      return [this.picture(target, 0, this.rangeBefore ?? this.range), this.picture(target, 1, this.range)];
    } finally {
      this.renderer.setRenderTarget(null);
      target.dispose();
      this.material.set("morph", this.blend === null ? 1 : 0); // while it is blended, the next frame sets it
    }
  }

  private picture(target: WebGLRenderTarget, morph: 0 | 1, range: Range): Uint8Array {
    const { width, height } = target;
    const colours = new Uint8Array(4 * width * height);
    this.material.set("morph", morph);
    this.material.setRange(...range);
    this.renderer.setRenderTarget(target);
    this.renderer.render(this.scene, this.camera);
    this.renderer.readRenderTargetPixels(target, 0, 0, width, height, colours);
    return colours;
  }

  /** Draws with the next frame. */
  draw(): void {
    if (this.frame === 0) this.frame = requestAnimationFrame(() => this.render());
  }

  /** Frees the graphics card. */
  dispose(): void {
    cancelAnimationFrame(this.frame);
    for (const mesh of this.meshes.values()) this.forget(mesh);
    this.meshes.clear();
    this.material.dispose();
    this.renderer.dispose();
  }

  /** Triangles; or the nodes of a line, and what joins them. */
  private drawable(patch: PatchBuffers): Drawable {
    const geometry = geometryOf(patch);
    if (patch.pieces === null) return new Mesh(geometry, this.material);
    const line = new LineSegments(geometry, this.material);
    line.add(new Points(geometry, this.material));
    return line;
  }

  private forget(mesh: Drawable): void {
    this.group.remove(mesh);
    mesh.geometry.dispose();
  }

  private finishBlend(): void {
    const blend = this.blend;
    this.blend = null;
    this.material.set("morph", 1);
    blend?.done();
  }

  private place(): void {
    const { camera, orbit } = this;
    camera.position.set(...positionOf(orbit));
    camera.lookAt(...orbit.target);
    [camera.near, camera.far] = clipping(orbit, this.radius * Math.max(1, this.exaggeration));
    camera.updateProjectionMatrix();
    camera.updateMatrixWorld();
    (this.material.uniforms.viewNormals!.value as Matrix3).setFromMatrix4(camera.matrixWorldInverse);
  }

  private render(): void {
    this.frame = 0;
    if (this.blend !== null) {
      const share = (performance.now() - this.blend.began) / BLEND;
      if (share >= 1) {
        this.finishBlend();
      } else {
        this.material.set("morph", share * share * (3 - 2 * share));
        this.draw();
      }
    }
    this.place();
    this.renderer.render(this.scene, this.camera);
    this.drawn();
  }
}

function geometryOf(patch: PatchBuffers): BufferGeometry {
  const geometry = new BufferGeometry();
  const set = (name: string, array: Float32Array | Int8Array, items: number, before?: typeof array | null): void => {
    const attribute = new BufferAttribute(array, items, array instanceof Int8Array);
    geometry.setAttribute(name, attribute);
    if (before === undefined) return;
    const from = before === null ? attribute : new BufferAttribute(before, items, array instanceof Int8Array);
    geometry.setAttribute(`from${name === "position" ? "" : name[0]!.toUpperCase() + name.slice(1)}`, from);
  };
  set("position", patch.positions, 3, patch.from);
  set("upright", patch.normals, 4, patch.fromNormals);
  set("shown", patch.values, 1, patch.fromValues);
  set("place", patch.places, 2);
  geometry.setIndex(new BufferAttribute(patch.pieces ?? patch.triangles, 1));
  const [x, y, z, radius] = patch.sphere;
  geometry.boundingSphere = new Sphere(new Vector3(x, y, z), radius);
  return geometry;
}
