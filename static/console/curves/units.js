// Numbers with their units: how many digits of them mean something, and a unit short enough to stand beside them.

const ENDLESS = 2 * Math.PI; // a joint without a limit is offered one turn each way
const MOST = 4; // letters of a unit beside a field

/** A short unit; "" where it needs words, which then stand elsewhere. */
export function shortUnit(unit = "") {
  return unit.length <= MOST ? unit : "";
}

/** A number with its unit; one that is explained by words stands behind the first: "opening 0.500". */
export function withUnit(number, unit = "") {
  const [what, range] = unit.split(",", 2);
  return range ? `${what} ${number}` : `${number} ${unit}`.trim();
}

/** The step of a field: a five-hundredth of the range, as a round decimal. */
export function stepOf({ lower = -ENDLESS, upper = ENDLESS }) {
  return 10 ** Math.round(Math.log10((upper - lower) / 500));
}

/** Digits behind the point that a field needs: those of its step, of an angle thousandths. */
export function digitsOf({ unit, ...range }) {
  return unit === "rad" ? 3 : Math.max(0, -Math.round(Math.log10(stepOf(range))));
}
