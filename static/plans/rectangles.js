// Rectangles on a picture, as shares of its width and height: {x, y, width, height}, always inside the picture.

export const MIN_SIDE = 0.02; // least side of a rectangle; a smaller one was drawn by accident

/** Return the rectangle between two points, in any order. */
export function fromPoints(a, b) {
  const [x, y] = [clamped(Math.min(a.x, b.x)), clamped(Math.min(a.y, b.y))];
  return rounded({ x, y, width: clamped(Math.max(a.x, b.x)) - x, height: clamped(Math.max(a.y, b.y)) - y });
}

/** Return the rectangle moved, but not beyond the edges of the picture. */
export function translate(rectangle, dx, dy) {
  const { width, height } = rectangle;
  return rounded({ ...rectangle, x: within(rectangle.x + dx, 1 - width), y: within(rectangle.y + dy, 1 - height) });
}

/** Return the rectangle with one number changed; the other number of that direction gives way at the edge of the picture. */
export function withValue(rectangle, key, value) {
  const along = { x: ["x", "width"], width: ["x", "width"], y: ["y", "height"], height: ["y", "height"] }[key];
  const given = clamped(Number.isFinite(value) ? value : 0);
  const [place, size] = along;
  if (key === place) return rounded({ ...rectangle, [place]: given, [size]: Math.min(rectangle[size], 1 - given) });
  return rounded({ ...rectangle, [size]: given, [place]: Math.min(rectangle[place], 1 - given) });
}

/** Return a name that is not among `names`. */
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

/** Round to 1e-4, so that the numbers that are typed and shown are those that are saved. */
function rounded(rectangle) {
  const round = (value) => Math.round(value * 10000) / 10000;
  const { x, y, width, height } = rectangle;
  const corner = { x: round(x), y: round(y) };
  return { ...rectangle, ...corner, width: Math.min(round(width), round(1 - corner.x)), height: Math.min(round(height), round(1 - corner.y)) };
}
