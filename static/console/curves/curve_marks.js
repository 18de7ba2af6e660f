// The marks among the curves: where a chunk takes over, where chunks overlap, where safety changed something. They are found in
// all samples, before the points are thinned out: no mark is lost, and each is within one sample of its step.

import { t } from "../../site/sentences.js";

/**
 * The kinds of marks, in their order in the legend. `title` is the name that is shown, `colour` a custom property, `shape` that
 * of the swatch.
 */
export const MARKS = [
  { name: "chunk", title: t("page.curves.chunk", "chunk"), colour: "--mark-chunk", shape: "hairline", means: t("page.curves.chunk_means", "A hairline where another chunk takes over; beside it the chunk at the cursor, 0 for the held target") },
  { name: "overlap", title: t("page.curves.overlap", "overlap"), colour: "--mark-overlap", shape: "patch", means: t("page.curves.overlap_means", "A band where an action combines more than one chunk; beside it, how many at the cursor") },
  { name: "safety", title: t("page.curves.safety", "safety"), colour: "--warn", shape: "tick", means: t("page.curves.safety_means", "A tick where safety changed or refused the action") },
];

const SAMPLE_S = 0.1; // longest time that one sample stands for; samples may be late, and nothing lies between them

/**
 * Find the marks in `times` [s] and the columns of a trace. `seams` are times at which a chunk of the policy begins to lead,
 * `bands` [from, to] where more than one chunk contributes, `simulations` [from, to] where a simulated robot executed, and
 * `limits` times at which safety changed something.
 */
export function marks(times, { chunk, chunks, limited, simulated = [] }) {
  const seams = [];
  const limits = [];
  for (let at = 0; at < times.length; at += 1) {
    if (at && chunk[at] > 0 && chunk[at] !== chunk[at - 1]) seams.push(times[at]);
    if (limited[at]) limits.push(times[at]);
  }
  return { seams, limits, bands: stretches(times, chunks, 2), simulations: stretches(times, simulated, 1) };
}

/** Return [from, to] of every stretch of samples in which `numbers` are at least `least`. */
function stretches(times, numbers, least) {
  const found = [];
  for (let at = 0; at < numbers.length; at += 1) {
    if (numbers[at] < least) continue;
    const end = Math.min(times[at + 1] ?? Infinity, times[at] + SAMPLE_S);
    if (numbers[at - 1] >= least && times[at] - found.at(-1)[1] < 1e-6) found.at(-1)[1] = end;
    else found.push([times[at], end]);
  }
  return found;
}
