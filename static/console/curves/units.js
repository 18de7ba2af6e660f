// Numbers with their units: how many digits are significant, and a unit short enough to stand beside the number.

/** Bounds offered for a joint without limits: one turn each way [rad]. */
export const ENDLESS = 2 * Math.PI;
const MOST = 4; // characters of a unit that fit beside a field

/** Return the unit if it is short; "" if it consists of words, which are then shown elsewhere. */
export function shortUnit(unit = "") {
  return unit.length <= MOST ? unit : "";
}

/**
 * Return a number with its unit. Of a unit like "opening, 0 to 1", which needs an explanation, only the word is used, before
 * the number: "opening 0.500".
 */
export function withUnit(number, unit = "") {
  const [what, range] = unit.split(",", 2);
  return range ? `${what} ${number}` : `${number} ${unit}`.trim();
}

/** Return the step of a field: a five-hundredth of the range, as a power of ten. */
export function stepOf({ lower = -ENDLESS, upper = ENDLESS }) {
  return 10 ** Math.round(Math.log10((upper - lower) / 500));
}

/** Return how many decimals a field needs: those of its step, or three for an angle in rad. */
export function digitsOf({ unit, ...range }) {
  return unit === "rad" ? 3 : Math.max(0, -Math.round(Math.log10(stepOf(range))));
}
