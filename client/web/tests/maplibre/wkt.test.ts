import { describe, expect, it } from "vitest";
import { InputError } from "../../src/errors";
import { readCrs } from "../../src/maplibre/wkt";

const DATUM = 'DATUM["World Geodetic System 1984",ELLIPSOID["WGS 84",6378137,298.257223563]]';
const DEGREES =
  'CS[ellipsoidal,2],AXIS["latitude",north],AXIS["longitude",east],ANGLEUNIT["degree",0.0174532925199433]';
const GPS = `GEOGCRS["WGS 84",${DATUM},${DEGREES},ID["EPSG",4326]]`;
const UTM =
  'PROJCS["WGS 84 / UTM zone 11N",GEOGCS["WGS 84",DATUM["WGS_1984",SPHEROID["WGS 84",6378137,298.257223563]],' +
  'PRIMEM["Greenwich",0],UNIT["degree",0.0174532925199433],AUTHORITY["EPSG","4326"]],' +
  'PROJECTION["Transverse_Mercator"],UNIT["metre",1],AXIS["Easting",EAST],AXIS["Northing",NORTH],' +
  'AUTHORITY["EPSG","32611"]]';

describe("a WKT", () => {
  it("says what its CRS is called, and whether it is of degrees", () => {
    expect(readCrs(GPS)).toEqual({ flat: GPS, name: "WGS 84", code: "EPSG:4326", degrees: true, vertical: undefined });
    expect(readCrs(UTM)).toMatchObject({ name: "WGS 84 / UTM zone 11N", code: "EPSG:32611", degrees: false });
    expect(readCrs(` ${GPS.replaceAll(",", " ,\n ")} `)).toMatchObject({ code: "EPSG:4326" });
    expect(readCrs(GPS.replaceAll("[", "(").replaceAll("]", ")"))).toMatchObject({ code: "EPSG:4326" });
  });

  it.each([
    [
      'GEOGCS["GCS_WGS_1984",DATUM["D_WGS_1984",SPHEROID["WGS_1984",6378137,298.257223563]],PRIMEM["Greenwich",0],',
      "EPSG:4326",
    ],
    [
      'GEOGCS["GCS_WGS_1984",DATUM["D_WGS_1984",SPHEROID["WGS_1984",6378137,298.257223563]],PRIMEM["Paris",2.3],',
      undefined,
    ],
    [
      'GEOGCS["NAD27",DATUM["North_American_Datum_1927",SPHEROID["Clarke 1866",6378206.4,294.9786982]],PRIMEM["G",0],',
      undefined,
    ],
  ])("without an identifier is known by its datum: %s", (begin, code) => {
    expect(readCrs(`${begin}UNIT["Degree",0.0174532925199433]]`).code).toBe(code);
  });

  it("says in its vertical part what heights are", () => {
    const with_ = (vertical: string) => readCrs(`COMPOUNDCRS["both",${UTM},${vertical}]`);
    const feet =
      'VERTCRS["NAVD88 (ftUS)",VDATUM["N"],CS[vertical,1],AXIS["height (H)",up,LENGTHUNIT["foot",0.3048006]]]';
    expect(with_(feet)).toMatchObject({ flat: UTM, code: "EPSG:32611", vertical: 0.3048006 });
    const depth = 'VERT_CS["MSL depth",VERT_DATUM["MSL",2005],UNIT["metre",1],AXIS["Depth",DOWN]]';
    expect(with_(depth).vertical).toBe(-1);
    expect(readCrs(`BOUNDCRS[SOURCECRS[${UTM}],TARGETCRS[${GPS}]]`)).toMatchObject({ flat: UTM });
  });

  it.each([
    ["", /expected the WKT of a CRS/],
    ["EPSG:4326", /expected the WKT of a CRS/],
    [GPS.slice(0, -2), /expected the WKT of a CRS/],
    ['GEOGCRS["a" "b"]', /expected the WKT of a CRS/],
    [`${"A[".repeat(100)}1${"]".repeat(100)}`, /expected the WKT of a CRS/],
    [`GEOGCRS["${"a".repeat(70_000)}"]`, /got a longer text/],
    ['LOCAL_CS["a site",UNIT["metre",1]]', /expected a CRS on the Earth's surface, got LOCAL_CS "a site"/],
    ['COMPOUNDCRS["nothing",VERTCRS["up"]]', /expected a CRS within COMPOUNDCRS/],
    ['GEOGCS["in grads",DATUM["NTF"],UNIT["grad",0.0157079632679489]]', /expected a geographic CRS in degrees/],
  ])("that cannot be used is refused: %.40s", (wkt, words) => {
    expect(() => readCrs(wkt)).toThrow(words);
    expect(() => readCrs(wkt)).toThrow(InputError);
  });
});
