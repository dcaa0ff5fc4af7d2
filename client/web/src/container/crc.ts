/** CRC-32 as in zlib and PNG. */

const TABLES = makeTables();

function makeTables(): Int32Array[] {
  const tables = Array.from({ length: 8 }, () => new Int32Array(256));
  for (let byte = 0; byte < 256; byte++) {
    let crc = byte;
    for (let bit = 0; bit < 8; bit++) crc = crc & 1 ? (crc >>> 1) ^ 0xedb88320 : crc >>> 1;
    tables[0]![byte] = crc;
  }
  for (let byte = 0; byte < 256; byte++) {
    for (let k = 1; k < 8; k++) {
      const before = tables[k - 1]![byte]!;
      tables[k]![byte] = (before >>> 8) ^ tables[0]![before & 255]!;
    }
  }
  return tables;
}

/** The CRC-32 of bytes, 0 to 2^32 - 1; of bytes that follow others, given the CRC of those. */
export function crc32(data: Uint8Array, before = 0): number {
  const [t0, t1, t2, t3, t4, t5, t6, t7] = TABLES as [
    Int32Array,
    Int32Array,
    Int32Array,
    Int32Array,
    Int32Array,
    Int32Array,
    Int32Array,
    Int32Array,
  ];
  let crc = ~before;
  let place = 0;
  for (const end = data.length - 7; place < end; place += 8) {
    crc ^= data[place]! | (data[place + 1]! << 8) | (data[place + 2]! << 16) | (data[place + 3]! << 24);
    crc =
      t7[crc & 255]! ^
      t6[(crc >>> 8) & 255]! ^
      t5[(crc >>> 16) & 255]! ^
      t4[crc >>> 24]! ^
      t3[data[place + 4]!]! ^
      t2[data[place + 5]!]! ^
      t1[data[place + 6]!]! ^
      t0[data[place + 7]!]!;
  }
  for (; place < data.length; place++) crc = (crc >>> 8) ^ t0[(crc ^ data[place]!) & 255]!;
  return ~crc >>> 0;
}

/** What tells that a segment or a chunk by itself is whole: the lower half of its CRC-32. */
export function checkOf(data: Uint8Array): number {
  return crc32(data) & 0xffff;
}
