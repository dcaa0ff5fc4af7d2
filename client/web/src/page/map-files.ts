/** Addresses of a surface's tiles, and files by which maps and globes open them. */

/** A surface whose server makes tiles of it. */
export interface Mapped {
  readonly name: string;
  /** Address of the surface, or of a name that leads to it. */
  readonly address: string;
  /** West, south, east, north, in degrees. */
  readonly bounds: readonly [number, number, number, number];
  readonly maxzoom: number;
}

/** An hour of the morning, by the sun: it stands in the east. */
const MORNING = 9;

/** What programs are given, with what it is for. */
export function addressesOf(address: string): [label: string, address: string][] {
  return [
    ["MapLibre: url of a raster-dem", `${address}/map.json`],
    ["CesiumJS: terrain", `${address}/terrain`],
    ["Heights as tiles (terrarium)", tilesOf(address, "terrarium")],
    ["Shaded relief as tiles", tilesOf(address, "shade")],
  ];
}

function tilesOf(address: string, encoding: string): string {
  return `${address}/tiles/{z}/{x}/{y}.png?encoding=${encoding}`;
}

/**
 * A page that shows the surface with MapLibre GL JS.
 *
 * @param library - Address of the folder with maplibre-gl.mjs.
 */
export function mapLibrePage(mapped: Mapped, library: string): string {
  const folder = library.replace(/\/+$/, "");
  return `<!doctype html><meta charset="utf-8" /><title>${escaped(mapped.name)}</title>
<link rel="stylesheet" href="${escaped(`${folder}/maplibre-gl.css`)}" />
<style>html, body, #map { height: 100%; margin: 0 }</style><div id="map"></div>
<script type="module">
  import * as maplibregl from ${literal(`${folder}/maplibre-gl.mjs`)};

  const dem = { type: "raster-dem", url: ${literal(`${mapped.address}/map.json`)} };
  const sources = { dem, relief: dem };
  const layers = [{ id: "relief", type: "hillshade", source: "relief" }];
  const style = { version: 8, sources, layers, terrain: { source: "dem" } };
  const map = new maplibregl.Map({ container: "map", style, bounds: ${literal(mapped.bounds)}, hash: true, maxPitch: 85 });
  map.addControl(new maplibregl.NavigationControl({ visualizePitch: true }));
</script>
`;
}

/**
 * A page that shows the surface with CesiumJS.
 *
 * @param library - Address of the folder with Cesium.js.
 */
export function cesiumPage(mapped: Mapped, library: string): string {
  const folder = library.replace(/\/+$/, "");
  return `<!doctype html><meta charset="utf-8" /><title>${escaped(mapped.name)}</title>
<link rel="stylesheet" href="${escaped(`${folder}/Widgets/widgets.css`)}" />
<style>html, body, #globe { height: 100%; margin: 0 }</style><div id="globe"></div>
<script>window.CESIUM_BASE_URL = ${literal(`${folder}/`)};</script>
<script src="${escaped(`${folder}/Cesium.js`)}"></script>
<script type="module">
  const options = { requestVertexNormals: true };
  const terrainProvider = await Cesium.CesiumTerrainProvider.fromUrl(${literal(`${mapped.address}/terrain`)}, options);
  // Without a base layer: pictures of the Earth would come from another host.
  const widget = new Cesium.CesiumWidget("globe", { terrainProvider, baseLayer: false });
  widget.scene.globe.baseColor = Cesium.Color.BEIGE;
  widget.scene.globe.enableLighting = true;
  widget.clock.currentTime = Cesium.JulianDate.fromIso8601("${morningOf(mapped.bounds)}");
  widget.camera.setView({ destination: Cesium.Rectangle.fromDegrees(...${literal(mapped.bounds)}) });
</script>
`;
}

/** A day on which the sun rises everywhere, and a time at which it is up in the middle of the bounds. */
function morningOf([west, , east]: Mapped["bounds"]): string {
  const longitude = (west + (east < west ? east + 360 : east)) / 2;
  const minutes = Math.round(((MORNING - longitude / 15 + 24) % 24) * 60) % 1440;
  const two = (value: number): string => String(value).padStart(2, "0");
  return `2026-03-21T${two(Math.floor(minutes / 60))}:${two(minutes % 60)}:00Z`;
}

/** Connections that QGIS loads into its list of XYZ tiles. */
export function qgisConnections({ name, address, maxzoom }: Mapped): string {
  const attributes = Object.entries({
    name,
    url: tilesOf(address, "terrarium"),
    zmin: 0,
    zmax: maxzoom,
    tilePixelRatio: 1,
    interpretation: "terrariumterrain",
    authcfg: "",
    username: "",
    password: "",
    referer: "",
  }).map(([key, value]) => `${key}="${escaped(String(value))}"`);
  return `<!DOCTYPE connections>
<qgsXYZTilesConnections version="1.0">
  <xyztiles ${attributes.join(" ")}/>
</qgsXYZTilesConnections>
`;
}

/** Text within HTML or XML, without the characters that XML does not have. */
function escaped(text: string): string {
  const references: Record<string, string> = { "&": "&amp;", "<": "&lt;", ">": "&gt;", '"': "&quot;" };
  return text.replace(/\p{Cc}/gu, " ").replace(/[&<>"]/g, (letter) => references[letter]!);
}

/** A value within a script of a page. */
function literal(value: unknown): string {
  return JSON.stringify(value).replaceAll("<", "\\u003c");
}
