// The binary layout of evaweb/core/binary_frames.py: u32 little-endian header length, UTF-8 JSON header, and from the next
// multiple of 8 on the body; offsets in the header count from the start of the body.

const ARRAYS = { f4: Float32Array, f8: Float64Array, i4: Int32Array, i8: BigInt64Array, u1: Uint8Array };

/** A message that is not a frame. */
export class BadFrame extends Error {}

function count(shape) {
  return shape.reduce((product, size) => product * size, 1);
}

/** A view on the numbers that `place` {offset, dtype, shape} describes behind `body`; nothing is copied. */
export function numbers(buffer, body, place) {
  const kind = ARRAYS[place.dtype.replace(/^[<|=]/, "")];
  if (!kind) throw new BadFrame(`numbers of type ${place.dtype}; known: ${Object.keys(ARRAYS).join(", ")}`);
  return new kind(buffer, body + place.offset, count(place.shape));
}

/** {header, bytes(place), numbers(place)} of a message. */
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
