// Flags and segments as bands under the time axis, and as lists that lead to their rows.

import { t } from "../site/sentences.js";

const RANK = { error: 0, warning: 1, info: 2 };

/**
 * Draw bands for `items` ({first, last, ...}) in a strip; `dress(band, item)` styles each. An item about no row has no band.
 */
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

/** Give each segment a `lane`, so that segments that overlap lie below each other. */
export function stackLanes(segments) {
  const ends = [];
  return segments.map((segment) => {
    const free = ends.findIndex((end) => end < segment.first);
    const lane = free < 0 ? ends.length : free;
    ends[lane] = segment.last;
    return { ...segment, lane };
  });
}

/** Return the flags at a row, the worst first. */
export function flagsAt(flags, row) {
  return flags.filter(({ first, last }) => first <= row && row <= last && first >= 0).sort((one, other) => RANK[one.severity] - RANK[other.severity]);
}

/** Return where the next flag begins after `row` or, for a negative `step`, the last one before it; null if there is none. */
export function nextFlag(flags, row, step) {
  const starts = [...new Set(flags.map(({ first }) => first))].filter((first) => first >= 0 && (step > 0 ? first > row : first < row));
  if (!starts.length) return null;
  return step > 0 ? Math.min(...starts) : Math.max(...starts);
}

/** Replace a list's content by `items` of {words, detail, mark, go}, or by the text `none` if there are none. */
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

/** Return in words which rows a segment covers, which milestone it ends with, and whose it is. */
export function span({ first, last, milestone }, who) {
  if (milestone) return t("page.review.span_then", "{first} to {last}, then {milestone}, {who}", { first, last, milestone, who });
  return t("page.review.span", "{first} to {last}, {who}", { first, last, who });
}

/** Return the name of a verdict. */
export function verdictWord(verdict) {
  const words = { pass: t("page.review.pass", "pass"), fail: t("page.review.fail", "fail"), note: t("page.review.note", "note") };
  return words[verdict] ?? verdict;
}

/** Return where several segments overlap: [{first, last, count}]. */
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
