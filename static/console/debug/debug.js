// The Debug page: figures of the station as the runtime measures them.

import { summary, trouble } from "../live/camera_words.js";
import { Distribution } from "./distribution.js";
import { reachWords } from "../scene/reach.js";
import { age, figure } from "../live/words.js";

const TELL_MS = 500; // figures that flicker cannot be read
const NO_ANSWER = "no answer yet";

const TEXTS = [
  ["Control", ({ control: c }) => `${figure(c.rate, 0, "Hz")}, ${c.behaviour || "–"}, ${c.scheduling}`],
  ["Late by", ({ control: c }) => lateness(c)],
  ["Missed", ({ control: c }) => `${c.missed} of ${c.ticks} ticks`],
  ["Policy", ({ policy: p, strategy }) => `${p.name || p.kind}, ${strategy}`],
  ["Connection", ({ policy: p }) => (p.lost ? `lost; next try ${soon(p.retry_in_s)}` : ""), "warn"],
  ["Predicted", ({ policy: p, strategy }) => (strategy === "rtc" ? predicted(p.rtc ?? {}) : "")],
  ["RTC", ({ policy: p, strategy }) => (strategy === "rtc" ? p.rtc?.warning : ""), "warn"],
  ["Poses", ({ policy: p }) => (p.ik?.over ? "" : reachWords(p.ik))],
  ["Out of reach", ({ policy: p }) => (p.ik?.over ? reachWords(p.ik) : ""), "warn"],
  ["Joints", ({ link: l }) => `${age(l.ages.joints ?? Infinity)} old`],
  ["Received", ({ link: l }) => received(l)],
  ["Own cameras", ({ link: l, clock }) => (troubled(l) ? "" : summary(l.cameras, clock))],
  ["Camera", ({ link: l, clock }) => (troubled(l) ? summary(l.cameras, clock) : ""), "warn"],
  ["Commands", ({ link: l }) => Object.entries(l.unheard ?? {}).map(([topic, why]) => why || `no listener on ${topic}`).join("; "), "warn"],
  ["Faults seen", ({ link: l }) => Object.entries(l.faults).filter(([, count]) => count).map(([name, count]) => `${name} ${count}`).join(", ") || "none"],
  ["Task", (snapshot) => snapshot.task || "–"],
  ["Last episode", ({ episode }) => episode?.uuid || "–"],
  ["Boot", (snapshot) => snapshot.boot],
];

/** After which text they stand, what they show, and how. */
const DISTRIBUTIONS = [
  ["Connection", "Latency", ({ policy: p }) => p.latencies_ms, { unit: "ms", nothing: NO_ANSWER, narrow: 10 }],
  ["Connection", "Delay", ({ policy: p }) => p.delays, { unit: "ticks", nothing: NO_ANSWER, whole: true }],
];

function received({ age_ms: ages, scheduling }) {
  return ages?.p99 === undefined ? "" : `p50 ${figure(ages.p50, 1, "ms")}, p99 ${figure(ages.p99, 1, "ms")} old, ${scheduling}`;
}

function troubled(link) {
  return Object.values(link.cameras ?? {}).some((told) => trouble(told, 0));
}

/** Fill the list of figures with the newest state, twice a second. */
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

/** One figure in words; without words it is not there. */
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

function distribution(list, name, values, look) {
  const { value } = entry(list, name);
  value.dataset.figure = name.toLowerCase();
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
  if (!ticks) return "no tick yet";
  const parts = [["p50", p50], ["p99", p99], ["p99.9", p999], ["most", most]];
  return `${parts.map(([name, ms]) => `${name}\u00a0${Number.isFinite(ms) ? ms.toFixed(2) : "–"}`).join(", ")} ms`;
}

function predicted({ predicted_delay: delay, conditioned }) {
  if (!Number.isFinite(delay)) return "no delay measured yet";
  return `delay ${delay} ticks; the last request ${conditioned ? "carried what is committed" : "carried nothing"}`;
}

function soon(seconds) {
  return Number.isFinite(seconds) ? `in ${Math.max(0, seconds).toFixed(1)} s` : "at once";
}
