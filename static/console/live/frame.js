// Binary frames as evaweb/core/binary_frames.py lays them out: header length as little-endian u32, JSON header in UTF-8, and
// the body from the next multiple of 8 on. Offsets in the header count from the start of the body.

const ARRAYS = { f4: Float32Array, f8: Float64Array, i4: Int32Array, i8: BigInt64Array, u1: Uint8Array };

/** Error for a message that is not a frame. */
export class BadFrame extends Error {}

function count(shape) {
  return shape.reduce((product, size) => product * size, 1);
}

/**
 * Return a view of the numbers that `place` {offset, dtype, shape} describes in the body, which starts at byte `body` of
 * `buffer`; nothing is copied.
 */
export function numbers(buffer, body, place) {
  const kind = ARRAYS[place.dtype.replace(/^[<|=]/, "")];
  if (!kind) throw new BadFrame(`numbers of type ${place.dtype}; known: ${Object.keys(ARRAYS).join(", ")}`);
  return new kind(buffer, body + place.offset, count(place.shape));
}

/** Decode a message into {header, bytes(place), numbers(place)}; throw BadFrame if it is not a frame. */
export function decode(buffer) {
  if (buffer.byteLength < 4) throw new BadFrame(`a frame of ${buffer.byteLength} bytes`);
  const length = new DataView(buffer).getUint32(0, true);
  if (4 + length > buffer.byteLength) throw new BadFrame(`a header of ${length} bytes in ${buffer.byteLength}`);
  const header = JSON.parse(new TextDecoder().decode(new Uint8Array(buffer, 4, length)));
  const body = Math.ceil((4 + length) / 8) * 8;
  return {
    header,
    bytes: (place) => new Uint8Array(buffer, body + place.offset, place.length),
    numbers: (place) => numbers(buffer, body, place),
  };
}
