// The figures of the Debug page, as the runtime measures them.

import { cameraSummary, cameraProblem } from "../live/camera_text.js";
import { Distribution } from "./distribution.js";
import { ikText } from "../scene/ik_text.js";
import { formatAge, formatFigure } from "../live/labels.js";
import { t } from "../../site/sentences.js";

const TELL_MS = 500; // figures that change too often cannot be read
const NO_ANSWER = t("page.figures.no_answer", "no answer yet");
const CONNECTION = t("page.figures.connection", "Connection");

const TEXTS = [
  [t("page.figures.control", "Control"), ({ control: c }) => `${formatFigure(c.rate, 0, "Hz")}, ${c.behaviour || "–"}, ${c.scheduling}`],
  [t("page.figures.late", "Late by"), ({ control: c }) => lateness(c)],
  [t("page.figures.missed", "Missed"), ({ control: c }) => t("page.figures.missed_of", "{n} of {all} ticks", { n: c.missed, all: c.ticks })],
  [t("page.figures.policy", "Policy"), ({ policy: p, strategy }) => `${p.name || p.kind}, ${strategy}`],
  [CONNECTION, ({ policy: p }) => (p.lost ? t("page.figures.lost", "lost; next try {soon}", { soon: soon(p.retry_in_s) }) : ""), "warn"],
  [t("page.figures.predicted", "Predicted"), ({ policy: p, strategy }) => (strategy === "rtc" ? predicted(p.rtc ?? {}) : "")],
  ["RTC", ({ policy: p, strategy }) => (strategy === "rtc" ? p.rtc?.warning : ""), "warn"],
  [t("page.figures.poses", "Poses"), ({ policy: p }) => (p.ik?.over ? "" : ikText(p.ik))],
  [t("page.figures.out_of_reach", "Out of reach"), ({ policy: p }) => (p.ik?.over ? ikText(p.ik) : ""), "warn"],
  [t("page.figures.joints", "Joints"), ({ link: l }) => t("page.common.old", "{age} old", { age: formatAge(l.ages.joints ?? Infinity) })],
  [t("page.figures.received", "Received"), ({ link: l }) => received(l)],
  [t("page.figures.cameras", "Own cameras"), ({ link: l, clock }) => (troubled(l) ? "" : cameraSummary(l.cameras, clock))],
  [t("page.figures.camera", "Camera"), ({ link: l, clock }) => (troubled(l) ? cameraSummary(l.cameras, clock) : ""), "warn"],
  [t("page.figures.commands", "Commands"), ({ link: l }) => Object.entries(l.unheard ?? {}).map(([topic, why]) => why || t("page.figures.no_listener", "no listener on {topic}", { topic })).join("; "), "warn"],
  [t("page.figures.faults", "Faults seen"), ({ link: l }) => Object.entries(l.faults).filter(([, count]) => count).map(([name, count]) => `${name} ${count}`).join(", ") || t("page.figures.none", "none")],
  [t("page.figures.task", "Task"), (snapshot) => snapshot.task || "–"],
  [t("page.figures.episode", "Last episode"), ({ episode }) => episode?.uuid || "–"],
  [t("page.figures.boot", "Boot"), (snapshot) => snapshot.boot],
];

/** Distributions: name of the text they follow, key, name, function that returns the values, and options. */
const DISTRIBUTIONS = [
  [CONNECTION, "latency", t("page.figures.latency", "Latency"), ({ policy: p }) => p.latencies_ms, { unit: "ms", nothing: NO_ANSWER, narrow: 10 }],
  [CONNECTION, "delay", t("page.figures.delay", "Delay"), ({ policy: p }) => p.delays, { unit: t("page.figures.ticks", "ticks"), nothing: NO_ANSWER, whole: true }],
];

function received({ age_ms: ages, scheduling }) {
  return ages?.p99 === undefined ? "" : t("page.figures.received_ages", "p50 {p50}, p99 {p99} old, {scheduling}", { p50: formatFigure(ages.p50, 1, "ms"), p99: formatFigure(ages.p99, 1, "ms"), scheduling });
}

function troubled(link) {
  return Object.values(link.cameras ?? {}).some((told) => cameraProblem(told, 0));
}

/** Fill the list of figures with the newest state, at most twice a second. */
export function figures(store) {
  const list = document.getElementById("figures");
  if (!list) return;
  const shown = TEXTS.flatMap(([name, words, weight]) => [
    text(list, name, words, weight),
    ...DISTRIBUTIONS.filter(([after]) => after === name).map(([, ...what]) => distribution(list, ...what)),
  ]);
  let told = -Infinity;
  store.on("snapshot", (snapshot) => {
    if (performance.now() - told < TELL_MS) return;
    told = performance.now();
    for (const show of shown) show(snapshot);
  });
}

/** Add a figure in words; return the function that updates it. It is hidden while its text is empty. */
function text(list, name, words, weight = "") {
  const { term, value } = entry(list, name);
  if (weight) value.dataset.weight = weight;
  value.textContent = "–";
  return (snapshot) => {
    const said = String(words(snapshot) || "");
    term.hidden = value.hidden = !said;
    if (value.textContent !== said) value.textContent = said;
  };
}

function distribution(list, key, name, values, look) {
  const { value } = entry(list, name);
  value.dataset.figure = key;
  const shown = new Distribution();
  value.append(shown.element);
  return (snapshot) => shown.show(values(snapshot) ?? [], look);
}

function entry(list, name) {
  const term = document.createElement("dt");
  term.textContent = name;
  const value = document.createElement("dd");
  list.append(term, value);
  return { term, value };
}

function lateness({ ticks, lateness_p50_ms: p50, lateness_p99_ms: p99, lateness_p999_ms: p999, lateness_max_ms: most }) {
  if (!ticks) return t("page.figures.no_tick", "no tick yet");
  const parts = [["p50", p50], ["p99", p99], ["p99.9", p999], [t("page.figures.most", "most"), most]];
  return `${parts.map(([name, ms]) => `${name}\u00a0${Number.isFinite(ms) ? ms.toFixed(2) : "–"}`).join(", ")} ms`;
}

function predicted({ predicted_delay: delay, conditioned }) {
  if (!Number.isFinite(delay)) return t("page.figures.no_delay", "no delay measured yet");
  return conditioned ? t("page.figures.carried", "delay {delay} ticks; the last request carried what is committed", { delay }) : t("page.figures.carried_nothing", "delay {delay} ticks; the last request carried nothing", { delay });
}

function soon(seconds) {
  return Number.isFinite(seconds) ? t("page.figures.in", "in {seconds} s", { seconds: Math.max(0, seconds).toFixed(1) }) : t("page.figures.at_once", "at once");
}
