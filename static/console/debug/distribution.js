// Small distributions: a row of bars with median and 90th percentile.

const SVG = "http://www.w3.org/2000/svg";
const BARS = 24;
const HEIGHT = 24;

/** Return the percentile of `values` in any order, interpolated linearly; NaN for no values. */
export function quantile(values, percent) {
  if (!values.length) return NaN;
  const sorted = [...values].sort((a, b) => a - b);
  const place = ((sorted.length - 1) * percent) / 100;
  const below = Math.floor(place);
  const above = Math.min(below + 1, sorted.length - 1);
  return sorted[below] + (place - below) * (sorted[above] - sorted[below]);
}

/**
 * Count how many of `values` fall into each of at most BARS bars: {low, high, counts}. With `whole`, the bars of whole numbers
 * have a whole width. `narrow` is the least range, so that noise does not look like a spread.
 */
export function bars(values, { whole = false, narrow = 0 } = {}) {
  let low = Math.min(...values);
  let high = Math.max(...values);
  if (whole) {
    const width = Math.ceil((high - low + 1) / BARS);
    const counts = new Array(Math.ceil((high - low + 1) / width)).fill(0);
    for (const value of values) counts[Math.floor((value - low) / width)] += 1;
    return { low, high: low + counts.length * width - 1, counts };
  }
  const missing = Math.max(0, narrow - (high - low)) / 2;
  low = Math.max(Math.min(0, low), low - missing);
  high += missing;
  const counts = new Array(BARS).fill(0);
  for (const value of values) counts[Math.min(BARS - 1, Math.floor(((value - low) / (high - low || 1)) * BARS))] += 1;
  return { low, high, counts };
}

/** A distribution that is updated, with its figures above it. */
export class Distribution {
  element = document.createElement("div");
  #picture = document.createElementNS(SVG, "svg");
  #ends = document.createElement("div");
  #words = document.createElement("span");
  #drawn = "";

  constructor() {
    this.element.className = "stack close distribution";
    this.#picture.setAttribute("preserveAspectRatio", "none");
    this.#picture.setAttribute("aria-hidden", "true");
    this.#ends.className = "row spread muted";
    this.#ends.append(document.createElement("span"), document.createElement("span"));
    this.element.append(this.#words, this.#picture, this.#ends);
  }

  /** Show `values` in `unit`; if there are none, show the text `nothing`. */
  show(values, { unit, nothing, digits = 0, whole = false, narrow = 0 }) {
    const key = `${values}`;
    if (key === this.#drawn && this.#words.textContent) return;
    this.#drawn = key;
    this.#picture.toggleAttribute("hidden", !values.length);
    this.#ends.hidden = !values.length;
    if (!values.length) {
      this.#words.textContent = nothing;
      return;
    }
    const [p50, p90] = [50, 90].map((percent) => quantile(values, percent));
    this.#words.textContent = `p50 ${p50.toFixed(digits)}, p90 ${p90.toFixed(digits)} ${unit} (n = ${values.length})`;
    const found = bars(values, { whole, narrow });
    this.#draw(found, p50, p90, whole);
    const ends = found.counts.length > 1 ? [found.low, found.high] : [found.low];
    [...this.#ends.children].forEach((end, index) => (end.textContent = index in ends ? `${ends[index].toFixed(digits)} ${unit}` : ""));
  }

  #draw({ low, high, counts }, p50, p90, whole) {
    const most = Math.max(...counts);
    const width = counts.length;
    const span = whole ? high - low + 1 : high - low || 1;
    this.#picture.setAttribute("viewBox", `0 0 ${width} ${HEIGHT}`);
    const made = counts.map((count, bar) => rectangle(bar + 0.06, 0.88, count ? Math.max(2, (count / most) * HEIGHT) : 0, "bar"));
    const at = (value) => ((value - low + (whole ? 0.5 : 0)) / span) * width;
    for (const [name, value] of [["p50", p50], ["p90", p90]]) made.push(line(at(value), name));
    this.#picture.replaceChildren(...made);
  }
}

function rectangle(x, width, height, name) {
  const made = document.createElementNS(SVG, "rect");
  const places = { x, y: HEIGHT - height, width, height, class: name };
  for (const [key, value] of Object.entries(places)) made.setAttribute(key, String(value));
  return made;
}

function line(x, name) {
  const made = document.createElementNS(SVG, "line");
  const places = { x1: x, x2: x, y1: 0, y2: HEIGHT, class: name, "vector-effect": "non-scaling-stroke" };
  for (const [key, value] of Object.entries(places)) made.setAttribute(key, String(value));
  return made;
}
