import { describe, expect, it } from "vitest";
import { addressesOf, cesiumPage, type Mapped, mapLibrePage, qgisConnections } from "../src/page/map-files";

const address = "https://maps.example.org/v1/names/hill";
const hill: Mapped = { name: 'Hill & "<Dale>"\u0001', address, bounds: [7, 45, 8.2, 46], maxzoom: 11 };

describe("files for maps and globes", () => {
  it("are beside the addresses of the server", () => {
    expect(addressesOf(address).map(([, each]) => each)).toEqual([
      `${address}/map.json`,
      `${address}/terrain`,
      `${address}/tiles/{z}/{x}/{y}.png?encoding=terrarium`,
      `${address}/tiles/{z}/{x}/{y}.png?encoding=shade`,
    ]);
  });

  it("load a library from where the user says, and nothing else but the surface", () => {
    for (const [page, own] of [
      [mapLibrePage(hill, "./libraries/maplibre//"), "./libraries/maplibre/maplibre-gl.mjs"],
      [cesiumPage(hill, "https://cdn.example.org/cesium"), "https://cdn.example.org/cesium/Cesium.js"],
    ] as const) {
      expect(page).toContain(`"${own}"`);
      const hosts = page.match(/https?:\/\/[^/"]+/g) ?? [];
      expect(hosts.every((host) => host === "https://maps.example.org" || own.startsWith(host))).toBe(true);
      expect(page.trimEnd().split("\n").length).toBeLessThanOrEqual(20);
      expect(page).toContain("[7,45,8.2,46]");
    }
  });

  it("hold names and addresses as text, whatever is in them", () => {
    const bad = '</script><script>alert("1")</script>';
    for (const page of [mapLibrePage, cesiumPage]) {
      const made = page({ ...hill, name: bad, address: bad }, `./${bad}`);
      expect(made).not.toContain("<script>alert");
      expect(made).not.toContain(bad);
    }
    expect(mapLibrePage(hill, ".")).toContain("<title>Hill &amp; &quot;&lt;Dale&gt;&quot; </title>");
  });

  it("show a globe by the light of its morning", () => {
    for (const [bounds, time] of [
      [[-1, 0, 1, 1], "09:00"],
      [[-120, 30, -118, 40], "16:56"],
      [[179, -20, -179, -10], "21:00"],
      [[20, -90, 380, 90], "19:40"],
    ] as const) {
      expect(cesiumPage({ ...hill, bounds }, ".")).toContain(`"2026-03-21T${time}:00Z"`);
    }
  });

  it("connect QGIS with tiles in terrarium up to the zoom of the cells", () => {
    const connections = qgisConnections(hill);
    expect(connections).toMatch(/^<!DOCTYPE connections>\n<qgsXYZTilesConnections version="1.0">\n {2}<xyztiles /);
    for (const attribute of [
      'name="Hill &amp; &quot;&lt;Dale&gt;&quot; "',
      `url="${address}/tiles/{z}/{x}/{y}.png?encoding=terrarium"`,
      'zmin="0"',
      'zmax="11"',
      'interpretation="terrariumterrain"',
    ]) {
      expect(connections).toContain(` ${attribute}`);
    }
  });
});
