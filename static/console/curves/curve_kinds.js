// The kinds of curves of a joint on the live pages and in Replay, with the same names, colours and order in both.

import { css } from "../live/style.js";
import { t } from "../../site/sentences.js";

/** `title` is the name that is shown, `colour` a custom property, `means` the explanation in a legend. */
export const KINDS = [
  { name: "raw", title: t("page.curves.raw", "raw"), colour: "--curve-4", width: 1.5, means: t("page.curves.raw_means", "What the newest chunk of the policy wants") },
  { name: "smoothed", title: t("page.curves.smoothed", "smoothed"), colour: "--curve-3", width: 1.5, dash: [4, 4], means: t("page.curves.smoothed_means", "What the strategy made of all chunks, before safety") },
  { name: "state", title: t("page.curves.state", "state"), colour: "--curve-1", width: 2, means: t("page.curves.state_means", "Where the joint was measured") },
  { name: "executed", title: t("page.curves.executed", "executed"), colour: "--curve-2", width: 1.5, means: t("page.curves.executed_means", "What was sent to the robot, after safety") },
];

/** Look of a signal of another joint in the same plot, on an axis of its own. */
export const SECOND = { colour: "--text-strong", width: 1.5, dash: [1, 3] };

/** Replace NaN by null, because uPlot does not treat NaN as a missing value. */
export function blank(values) {
  return Array.from(values, (value) => (Number.isNaN(value) ? null : value));
}

/** Return uPlot's series for these kinds; a series for which `shown(name)` is false exists but is not drawn. */
export function series(kinds, shown) {
  const look = ({ name, colour, width, dash }) => ({ label: name, stroke: css(colour), width, dash, show: shown(name), points: { show: false } });
  return [{}, ...kinds.map(look)];
}

export const AXIS = 56; // width of the value axis [px]

/** Return the two axes: seconds, and the joint's unit. */
export function axes() {
  const line = { stroke: css("--text-muted"), grid: { stroke: css("--hairline"), width: 1 }, ticks: { show: false }, font: `13px ${css("--font")}` };
  return [
    { ...line, size: 24, values: (plot, ticks) => ticks.map((tick) => `${tick} s`) },
    { ...line, size: AXIS, values: (plot, ticks) => ticks.map((tick) => tick.toFixed(2)) },
  ];
}

/** Return the range of the value axis, never so narrow that noise looks like motion. */
export function spread(low, high) {
  if (low === null || !Number.isFinite(low)) return [-0.1, 0.1];
  const middle = (low + high) / 2;
  const half = Math.max((high - low) * 0.57, 0.02);
  return [middle - half, middle + half];
}
