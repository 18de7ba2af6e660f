// Rectangles on a picture, in shares of its width and height: {x, y, width, height}, always inside.

export const MIN_SIDE = 0.02; // of a side: less is a slip of the hand

/** The rectangle between two points, in whatever order they were pressed. */
export function fromPoints(a, b) {
  const [x, y] = [clamped(Math.min(a.x, b.x)), clamped(Math.min(a.y, b.y))];
  return rounded({ x, y, width: clamped(Math.max(a.x, b.x)) - x, height: clamped(Math.max(a.y, b.y)) - y });
}

/** The same rectangle elsewhere, pushed back where it would leave the picture. */
export function translate(rectangle, dx, dy) {
  const { width, height } = rectangle;
  return rounded({ ...rectangle, x: within(rectangle.x + dx, 1 - width), y: within(rectangle.y + dy, 1 - height) });
}

/** One of its numbers changed; the others give way where it would leave the picture. */
export function withValue(rectangle, key, value) {
  const along = { x: ["x", "width"], width: ["x", "width"], y: ["y", "height"], height: ["y", "height"] }[key];
  const given = clamped(Number.isFinite(value) ? value : 0);
  const [place, size] = along;
  if (key === place) return rounded({ ...rectangle, [place]: given, [size]: Math.min(rectangle[size], 1 - given) });
  return rounded({ ...rectangle, [size]: given, [place]: Math.min(rectangle[place], 1 - given) });
}

/** A name that none of the others has. */
export function unusedName(names) {
  let k = 1;
  while (names.includes(`object ${k}`)) k += 1;
  return `object ${k}`;
}

function clamped(value) {
  return within(value, 1);
}

function within(value, most) {
  return Math.min(Math.max(value, 0), most);
}

/** To tenths of a thousandth, so that numbers that are typed and shown are those that are saved. */
function rounded(rectangle) {
  const round = (value) => Math.round(value * 10000) / 10000;
  const { x, y, width, height } = rectangle;
  const corner = { x: round(x), y: round(y) };
  return { ...rectangle, ...corner, width: Math.min(round(width), round(1 - corner.x)), height: Math.min(round(height), round(1 - corner.y)) };
}
