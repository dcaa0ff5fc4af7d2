import { describe, expect, it, vi } from "vitest";
import { type Choice, type ListedSurface, problemOf, Server } from "../src/page/api";
import { parseConfiguration } from "../src/page/configuration";
import { choiceName, choiceQuestion, matches, nameOf } from "../src/page/names";
import { seriesOf, stepOf } from "../src/page/series";

const surface: ListedSurface = {
  id: "5f1c0a9b3d7e42a68c10",
  url: "/v1/surfaces/5f1c0a9b3d7e42a68c10",
  name: "Jacksboro",
  state: "ready",
  progress: 1,
  reason: null,
  created: "2026-01-31T12:00:00.000+00:00",
  upload_bytes: 1,
};

describe("the list", () => {
  it("is searched by words of names and ids", () => {
    for (const search of ["", "jacks", "5f1c JACK", "boro"]) expect(matches(surface, search)).toBe(true);
    for (const search of ["jackson", "jacks tif"]) expect(matches(surface, search)).toBe(false);
    expect(matches({ ...surface, name: null }, "5f1c")).toBe(true);
    expect(matches({ ...surface, name: null }, "null")).toBe(false);
  });

  it("calls a surface by its name or its id", () => {
    expect(nameOf(surface)).toBe("Jacksboro");
    for (const name of [null, ""]) expect(nameOf({ ...surface, name })).toBe(surface.id);
  });
});

describe("the surfaces of a file", () => {
  const choice = (options: Record<string, string>, shape: number[] = [68, 64]): Choice => ({ options, shape });

  it("are called by what chooses them, with their points", () => {
    expect(choiceName(choice({ variable: "Te0" }))).toBe("Te0 (68 × 64)");
    expect(choiceName(choice({ x: "Rxy", y: "Zxy" }))).toBe("positions Rxy and Zxy (68 × 64)");
    expect(choiceName(choice({ group: "forecast/surface" }, []))).toBe("forecast/surface");
    expect(choiceName(choice({ time: "3" }, []))).toBe("time 3");
    expect(choiceName(choice({ at: "lev:2,depth:0" }, []))).toBe("lev 2, depth 0");
  });

  it("are asked for by what is to be chosen", () => {
    expect(choiceQuestion([choice({ variable: "Te0" }), choice({ x: "R", y: "Z" })])).toBe("Choose a variable");
    expect(choiceQuestion([choice({ array: "a" })])).toBe("Choose an array");
    expect(choiceQuestion([choice({ layer: "a" })])).toBe("Choose a surface");
    expect(choiceQuestion([])).toBe("Choose a surface");
  });
});

describe("a series", () => {
  const step = (index: number, more: object = {}): ListedSurface => ({
    ...surface,
    id: `air ${index}`,
    name: `day air 2001-01-0${index + 1}`,
    series: { name: "day air", along: "time", index, value: 24 * index, unit: "hours since 2001-01-01" },
    ...more,
  });

  it("is of the surfaces that can be shown and have its name, by their place", () => {
    const others = [
      surface,
      step(1, { state: "building" }),
      step(2, { series: { ...step(2).series, name: "day wind" } }),
      step(3, { series: { ...step(3).series, along: "variable" } }),
    ];
    const found = seriesOf(step(5), [step(7), ...others, step(0), step(5)]);
    expect(found.map(({ id }) => id)).toEqual(["air 0", "air 5", "air 7"]);
    expect(seriesOf(surface, [surface, step(0)])).toEqual([]);
  });

  it("has the newest of two at one place, but always the one that is open", () => {
    const [old, recent] = [step(0, { id: "old" }), step(0, { id: "recent", created: "2026-02-01T12:00:00.000+00:00" })];
    for (const all of [
      [old, recent, step(1)],
      [recent, old, step(1)],
    ]) {
      expect(seriesOf(step(1), all).map(({ id }) => id)).toEqual(["recent", "air 1"]);
      expect(seriesOf(old, all).map(({ id }) => id)).toEqual(["old", "air 1"]);
    }
  });

  it("calls a step by what follows the name of the series", () => {
    expect(stepOf(step(2))).toBe("2001-01-03");
    expect(stepOf(step(2, { name: "storm" }))).toBe("storm");
    expect(stepOf(surface)).toBe("Jacksboro");
  });
});

describe("the server", () => {
  it("explains refusals by its problem documents, and those of proxies by their status", () => {
    const problem = problemOf(401, '{"title": "A token is needed", "code": "no-token", "detail": "No token came"}');
    expect([problem.status, problem.code, problem.message]).toEqual([401, "no-token", "No token came"]);
    expect(problemOf(502, "<html>").code).toBe("http-502");
  });

  it.each([
    ["a head", new Response(null, { headers: { date: "Sun" } })],
    ["a document", new Response('{"id": "a')],
    ["a link", new Response(new ReadableStream({ start: (stream) => stream.error(new TypeError("network error")) }))],
  ])("that breaks off in the middle of %s could not be reached", async (_, answer) => {
    vi.spyOn(globalThis, "fetch").mockResolvedValue(answer);
    await expect(new Server("https://host/").look("v1/surfaces/a")).rejects.toMatchObject({ code: "network" });
    vi.restoreAllMocks();
  });

  it("stands below any path, and is the only host", () => {
    const server = new Server("https://host/sub/");
    expect(server.address("v1/surfaces")).toBe("https://host/sub/v1/surfaces");
    expect(server.address("/sub/v1/surfaces/1")).toBe("https://host/sub/v1/surfaces/1");
    expect(() => server.address("https://elsewhere/v1")).toThrow("another host");
    expect(() => server.address("//elsewhere/v1")).toThrow("another host");
  });
});

describe("the configuration of a static host", () => {
  it("names surfaces", () => {
    expect(
      parseConfiguration({
        surfaces: [
          { name: "a", src: "a.lode", bytes: 7 },
          { name: "b", title: "The second", src: "b.lode", bytes: 8 },
          { src: "c.lode", progress: 0.4 },
        ],
        live: false,
      }),
    ).toEqual([
      { name: "a", title: "a", src: "a.lode", bytes: 7, progress: null },
      { name: "b", title: "The second", src: "b.lode", bytes: 8, progress: null },
      { name: "c.lode", title: "c.lode", src: "c.lode", bytes: null, progress: 0.4 },
    ]);
  });

  it.each([null, 3, {}, { surfaces: 3 }, { surfaces: [{}] }, { surfaces: [null] }, { surfaces: [{ src: 5 }] }])(
    "refuses %j",
    (value) => {
      expect(() => parseConfiguration(value)).toThrow(TypeError);
    },
  );
});
