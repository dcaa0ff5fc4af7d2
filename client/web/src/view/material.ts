/** How patches are shaded and coloured: one material for all of them. */

import { DataTexture, DoubleSide, GLSL3, LinearFilter, RawShaderMaterial, Vector2, Vector3 } from "three";
import { type ColourMapName, textureOf } from "./colour-maps";

const VERTEX = `
precision highp float;
uniform mat4 modelViewMatrix, projectionMatrix;
uniform mat3 viewNormals;
uniform float morph, exaggeration, thickness;
in vec3 position, from;
in vec4 upright, fromUpright;
in float shown, fromShown;
in vec2 place;
out vec3 normalInView, inView;
out float value;
out vec2 line;
out float thin;
void main() {
  vec4 seen = modelViewMatrix * vec4(mix(from, position, morph), 1.0);
  vec3 up = mix(fromUpright.xyz, upright.xyz, morph);
  normalInView = viewNormals * vec3(up.xy, up.z / exaggeration);
  inView = seen.xyz;
  value = mix(fromShown, shown, morph);
  if (min(fromShown, shown) < -1e20) value = shown;
  line = place;
  thin = upright.w;
  gl_PointSize = thickness;
  gl_Position = projectionMatrix * seen;
}`;

const FRAGMENT = `
precision highp float;
uniform sampler2D map;
uniform vec2 range;
uniform float lines, plain;
uniform vec3 light, blank, ink;
in vec3 normalInView, inView;
in float value;
in vec2 line;
in float thin;
out vec4 colour;
void main() {
  vec3 normal = normalize(normalInView);
  // The side that is seen, from the triangle itself: at the brink of a ridge the normal may already point away.
  if (dot(normal, cross(dFdx(inView), dFdy(inView))) < 0.0) normal = -normal;
  float at = clamp((value - range.x) / (range.y - range.x), 0.0, 1.0);
  vec3 base = plain > 0.5 || value < -1e20 ? blank : texture(map, vec2((at * 255.0 + 0.5) / 256.0, 0.5)).rgb;
  float lit = 0.42 + 0.7 * max(dot(normal, light), 0.0);
  vec3 shade = base * lit + 0.05 * pow(max(dot(normal, normalize(light + vec3(0.0, 0.0, 1.0))), 0.0), 24.0);
  if (lines > 0.5) {
    vec2 width = fwidth(line);
    vec2 off = abs(fract(line - 0.5) - 0.5) / max(width, vec2(1e-6));
    vec2 fade = 1.0 - smoothstep(0.16, 0.4, width);
    vec2 drawn = (1.0 - smoothstep(0.4, 1.3, off)) * fade;
    shade = mix(shade, ink, 0.55 * max(drawn.x, drawn.y));
  }
  // A line has no side that light falls on.
  colour = vec4(thin > 0.5 ? base * 0.85 : shade, 1.0);
}`;

/** The material of all patches. */
export class SurfaceMaterial extends RawShaderMaterial {
  private map: DataTexture;
  private mapName: ColourMapName = "viridis";

  constructor() {
    const map = lookup("viridis");
    super({
      vertexShader: VERTEX,
      fragmentShader: FRAGMENT,
      glslVersion: GLSL3,
      side: DoubleSide,
      uniforms: {
        viewNormals: { value: null },
        morph: { value: 1 },
        exaggeration: { value: 1 },
        thickness: { value: 3 },
        map: { value: map },
        range: { value: new Vector2(0, 1) },
        lines: { value: 0 },
        plain: { value: 0 },
        light: { value: new Vector3(-0.55, 0.6, 0.5).normalize() },
        blank: { value: new Vector3(0.72, 0.74, 0.76) },
        ink: { value: new Vector3(0.05, 0.07, 0.1) },
      },
    });
    this.map = map;
  }

  /** Sets a uniform. */
  set(name: "morph" | "exaggeration" | "lines" | "plain" | "thickness", value: number): void {
    this.uniforms[name]!.value = value;
  }

  /** What of the values' span the colours cover. */
  setRange(low: number, high: number): void {
    (this.uniforms.range!.value as Vector2).set(low, high > low ? high : low + 1e-6);
  }

  /** Takes another colour map. */
  setMap(name: ColourMapName): void {
    if (name === this.mapName) return;
    this.mapName = name;
    this.map.dispose();
    this.map = lookup(name);
    this.uniforms.map!.value = this.map;
  }

  override dispose(): void {
    this.map.dispose();
    super.dispose();
  }
}

function lookup(name: ColourMapName): DataTexture {
  const texture = new DataTexture(textureOf(name), 256, 1);
  texture.minFilter = LinearFilter;
  texture.magFilter = LinearFilter;
  texture.needsUpdate = true;
  return texture;
}
