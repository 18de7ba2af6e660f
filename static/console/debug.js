// The Debug page: figures of the station as the runtime measures them.

import { age, figure } from "./words.js";

const ROWS = [
  ["Control", ({ control: c }) => `${figure(c.rate, 0, "Hz")}, ${c.behaviour || "–"}, ${c.scheduling}`],
  ["Late by", ({ control: c }) => `p50 ${figure(c.lateness_p50_ms, 2, "ms")}, p99 ${figure(c.lateness_p99_ms, 2, "ms")}, most ${figure(c.lateness_max_ms, 1, "ms")}`],
  ["Missed ticks", ({ control: c }) => `${c.missed} of ${c.ticks}`],
  ["Policy", ({ policy: p, strategy }) => `${p.name || p.kind}, ${strategy}`],
  ["Latency", ({ policy: p }) => p.answers ? `p50 ${figure(p.latency_p50_ms, 0, "ms")}, p90 ${figure(p.latency_p90_ms, 0, "ms")} (n = ${p.answers})` : "no answer yet"],
  ["Delay", ({ policy: p }) => p.answers ? `p50 ${figure(p.delay_p50, 0, "ticks")}, most ${figure(p.delay_max, 0, "ticks")}` : "no answer yet"],
  ["Joints", ({ link: l }) => `${age(l.ages.joints ?? Infinity)} old`],
  ["Faults seen", ({ link: l }) => Object.entries(l.faults).filter(([, count]) => count).map(([name, count]) => `${name} ${count}`).join(", ") || "none"],
  ["Task", (snapshot) => snapshot.task || "–"],
  ["Last episode", (snapshot) => snapshot.episode?.uuid ?? snapshot.episode ?? "–"],
  ["Boot", (snapshot) => snapshot.boot],
];

/** Fill the list of figures with every state that comes. */
export function figures(store) {
  const list = document.getElementById("figures");
  if (!list) return;
  const cells = ROWS.map(([name]) => {
    const term = document.createElement("dt");
    term.textContent = name;
    const value = document.createElement("dd");
    value.textContent = "–";
    list.append(term, value);
    return value;
  });
  store.on("snapshot", (snapshot) => {
    ROWS.forEach(([, text], index) => {
      const words = String(text(snapshot) || "–");
      if (cells[index].textContent !== words) cells[index].textContent = words;
    });
  });
}
