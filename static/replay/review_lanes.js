// Flags and segments as bands under the time axis, and as lists that lead to their frames.

import { t } from "../site/sentences.js";

const RANK = { error: 0, warning: 1, info: 2 };

/** Bands of `items` ({first, last, ...}) in a strip; `dress` gives each its look. One about no frame has none. */
export function drawBands(strip, items, frames, dress) {
  strip.replaceChildren(
    ...items
      .filter(({ first }) => first >= 0)
      .map((item) => {
        const band = document.createElement("i");
        band.className = "lane-band";
        band.style.left = `${(100 * item.first) / frames}%`;
        band.style.width = `${(100 * (item.last - item.first + 1)) / frames}%`;
        dress(band, item);
        return band;
      }),
  );
}

/** Rows of a segment's lanes: those that overlap lie below each other. */
export function stackLanes(segments) {
  const ends = [];
  return segments.map((segment) => {
    const free = ends.findIndex((end) => end < segment.first);
    const lane = free < 0 ? ends.length : free;
    ends[lane] = segment.last;
    return { ...segment, lane };
  });
}

/** The flags in a row, the worst first. */
export function flagsAt(flags, row) {
  return flags.filter(({ first, last }) => first <= row && row <= last && first >= 0).sort((one, other) => RANK[one.severity] - RANK[other.severity]);
}

/** Where the next flag begins after `row`, or the one before it; none: null. */
export function nextFlag(flags, row, step) {
  const starts = [...new Set(flags.map(({ first }) => first))].filter((first) => first >= 0 && (step > 0 ? first > row : first < row));
  if (!starts.length) return null;
  return step > 0 ? Math.min(...starts) : Math.max(...starts);
}

/** A list in place of what it had; each item is { words, detail, mark, go }, `none` is said where there is none. */
export function fillList(element, items, none) {
  const made = items.map(({ words, detail, mark, go }) => {
    const item = document.createElement("li");
    const line = document.createElement(go ? "button" : "p");
    if (go) line.type = "button";
    if (mark) Object.assign(line, { className: "chip" }).dataset.mark = mark;
    line.append(words);
    if (detail) line.append(" ", Object.assign(document.createElement("span"), { className: "muted small", textContent: detail }));
    if (go) line.addEventListener("click", go);
    item.append(line);
    return item;
  });
  if (!made.length) made.push(Object.assign(document.createElement("li"), { className: "muted", textContent: none }));
  element.replaceChildren(...made);
}

/** Which rows a segment is, what it ends with, and whose it is. */
export function span({ first, last, milestone }, who) {
  if (milestone) return t("page.review.span_then", "{first} to {last}, then {milestone}, {who}", { first, last, milestone, who });
  return t("page.review.span", "{first} to {last}, {who}", { first, last, who });
}

/** What a verdict is called. */
export function verdictWord(verdict) {
  const words = { pass: t("page.review.pass", "pass"), fail: t("page.review.fail", "fail"), note: t("page.review.note", "note") };
  return words[verdict] ?? verdict;
}

/** Where several of the segments lie over each other: [{first, last, count}]. */
export function overlaps(segments) {
  const edges = segments.flatMap(({ first, last }) => [
    [first, 1],
    [last + 1, -1],
  ]);
  edges.sort((one, other) => one[0] - other[0]);
  const found = [];
  let count = 0;
  edges.forEach(([row, step], index) => {
    count += step;
    const next = edges[index + 1]?.[0];
    if (count > 1 && next > row) found.push({ first: row, last: next - 1, count });
  });
  return found;
}
