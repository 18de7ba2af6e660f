// How well the poses of a chunk were met, in words.

/** A number that is not shown as 0 where it is not. */
function small(value, digits) {
  const least = 10 ** -digits;
  return value > 0 && value < least ? `below ${least.toFixed(digits)}` : value.toFixed(digits);
}

/** `ik` as the station tells it: rows, over, limit, velocity, singular, worst_mm, worst_deg; "" where it is about joints. */
export function reachWords({ rows = 0, over = 0, limit = 0, velocity = 0, singular = 0, worst_mm: mm, worst_deg: deg } = {}) {
  if (!rows) return "";
  const known = Number.isFinite(mm) && Number.isFinite(deg);
  const worst = known ? `, worst ${small(mm, over ? 1 : 3)} mm and ${small(deg, over ? 1 : 3)}°` : "";
  const met = over ? `${over} of ${rows} poses not reached` : `${rows} poses reached`;
  const flags = [[limit, "at a joint limit"], [velocity, "as fast as joints may"], [singular, "near singular"]];
  const said = flags.filter(([count]) => count).map(([count, words]) => `${count} ${words}`);
  return [met + worst, ...said].join("; ");
}
