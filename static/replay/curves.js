// The pane of the curves: a plot for each of the joints that were chosen or that move most, and what applies to all of them.

import { Legend } from "../console/curves/curve_legend.js";
import { lastNotAbove } from "../site/binary_search.js";
import { t } from "../site/sentences.js";
import { loadPlots } from "../site/uplot.js";
import { Chunks } from "./chunks.js";
import { CurveCell } from "./curve_cell.js";
import { joint, message } from "./data.js";
import { movingMost } from "./moving.js";
import { isTuningEvent } from "./plot.js";
import { readout, write } from "./readout.js";

const KEY = "eva-replay-joints"; // names of the chosen joints; without this key, the joints that move most are drawn
const MULTIPLES = 4;

/** Fill the pane, or show a sentence instead; resolve to {held, marks, chunks}, which are empty if nothing is known. */
export async function curvePane({ clock, address, uplot }) {
  const note = document.getElementById("curves-note");
  try {
    const { header, numbers } = await message(address);
    const episode = read(header, numbers);
    const library = await loadPlots(uplot);
    if (library) new Pane(clock, episode, library);
    note.hidden = Boolean(library);
    note.textContent = library ? "" : t("page.replay.no_uplot", "Curves are drawn by uPlot, which is not installed: run make setup and start the lab again.");
    return { held: header.held, marks: header.marks, chunks: episode.chunks.spans };
  } catch (error) {
    note.textContent = t("page.replay.no_curves", "No curves: {why}.", { why: error.message });
    console.error(error);
    return { held: [], marks: [], chunks: [] };
  }
}

function read(header, numbers) {
  const { ticks, raw, makers, chunks } = header.streams;
  const all = (stream) => Object.fromEntries(Object.entries(stream.arrays).map(([name, place]) => [name, numbers(place)]));
  const owners = { ticks: all(ticks), makers: all(makers), chunks: all(chunks), strategies: chunks.json.strategies, period: header.period };
  return { header, ticks: owners.ticks, raw: all(raw), spaces: raw.json.spaces, chunks: new Chunks(owners) };
}

class Pane {
  #clock;
  #episode;
  #library;
  #behind;
  #cells = [];
  #place = document.getElementById("plots");
  #legend;
  #moving; // joints, sorted by how far they move
  #hovered = null; // [s]; null if the pointer is elsewhere
  #said = document.getElementById("chunk");

  constructor(clock, episode, library) {
    this.#clock = clock;
    this.#episode = episode;
    this.#library = library;
    const { held, marks, joints, units } = episode.header;
    this.#behind = { held, marks, safety: this.#safety(), owners: episode.chunks };
    this.#legend = new Legend(document.getElementById("legend"), (name, shown) => this.#cells.forEach((cell) => cell.reveal(name, shown)));
    this.#explain(document.getElementById("legend-marks"));
    this.#moving = movingMost(episode.ticks.measured, joints.length, units);
    document.getElementById("joints-moving").addEventListener("click", () => {
      localStorage.removeItem(KEY);
      this.#lay(this.#moving.slice(0, MULTIPLES));
    });
    document.getElementById("joint-add").addEventListener("click", () => this.#add());
    this.#lay(this.#chosen());
    for (const kind of ["tick", "seek"]) clock.addEventListener(kind, () => this.#at());
  }

  /** Return the joints of this browser's choice that the episode has or, if there is none, those that move most. */
  #chosen() {
    const names = this.#episode.header.joints;
    const kept = JSON.parse(localStorage.getItem(KEY) ?? "[]").map((name) => names.indexOf(name));
    const known = [...new Set(kept)].filter((index) => index >= 0);
    return known.length ? known : this.#moving.slice(0, MULTIPLES);
  }

  #lay(joints) {
    for (const cell of this.#cells) cell.destroy();
    this.#cells = joints.map((index, number) => this.#cell(index, number, joints.length));
    this.#place.replaceChildren(...this.#cells.map(({ element }) => element));
    for (const cell of this.#cells) cell.draw();
    const missing = this.#moving.length - joints.length;
    const add = document.getElementById("joint-add");
    add.setAttribute("aria-disabled", String(!missing));
    add.title = missing ? t("page.replay.one_more", "Draw one more joint") : t("page.replay.all_drawn", "All joints are drawn");
    this.#at();
  }

  #cell(index, number, count) {
    const { header, ticks, raw } = this.#episode;
    const length = ticks.time.length;
    const read = (of) => {
      const pick = (name) => joint(ticks[name], of, length);
      const curves = { time: ticks.time, state: pick("measured"), executed: pick("executed"), smoothed: pick("smoothed") };
      return { curves, raw: answers(raw.time, joint(raw.values, of, raw.time.length), raw.chunk), unit: header.units[of] ?? "" };
    };
    return new CurveCell({
      ...{ index, number, count, read, joints: header.joints, grippers: header.grippers, library: this.#library, behind: this.#behind },
      shown: (name) => this.#legend.shown(name),
      seek: (time) => this.#clock.seekRow(Math.floor(time * this.#clock.fps)),
      hover: (time) => this.#hover(time),
      chose: () => {
        this.#keep();
        this.#align();
        this.#at();
      },
      remove: () => this.#remove(number),
    });
  }

  /** Align the time axes of all plots, also if one of them has a second value axis. */
  #align() {
    const some = this.#cells.some(({ second }) => second);
    for (const cell of this.#cells) cell.align(some);
  }

  get #joints() {
    return this.#cells.map(({ index }) => index);
  }

  #keep() {
    localStorage.setItem(KEY, JSON.stringify(this.#joints.map((index) => this.#episode.header.joints[index])));
  }

  #add() {
    const drawn = this.#joints;
    const next = this.#moving.find((index) => !drawn.includes(index));
    if (next === undefined) return;
    this.#lay([...drawn, next]);
    this.#keep();
    this.#cells.at(-1).focus();
  }

  #remove(number) {
    if (this.#cells.length < 2) return;
    this.#lay(this.#joints.filter((_, place) => place !== number));
    this.#keep();
    this.#cells[Math.min(number, this.#cells.length - 1)].focus();
  }

  #safety() {
    const { time, safety } = this.#episode.ticks;
    const found = [];
    safety.forEach((what, index) => what && found.push({ time: time[index], refused: what === 2 }));
    return found;
  }

  #explain(element) {
    const { safety } = this.#episode.ticks;
    const { chunks, header } = this.#episode;
    if (chunks.spans.length) mark(element, t("page.marks.chunk", "chunk"), "--mark-chunk", "hairline", t("page.marks.chunk_means", "another chunk takes over; the strip over the curves has its number"));
    if (chunks.overlaps.length) mark(element, t("page.marks.overlap", "overlap"), "--mark-overlap", "patch", t("page.marks.overlap_means", "steps that several chunks made"));
    if (header.held.length) mark(element, t("page.marks.held", "held"), "--warn-soft", "patch", t("page.marks.held_means", "nothing was asked of the robot"));
    if (safety.includes(1)) mark(element, t("page.marks.changed", "changed"), "--warn", "tick", t("page.marks.changed_means", "safety sent another action than the one requested"));
    if (safety.includes(2)) mark(element, t("page.marks.refused", "refused"), "--danger", "tick", t("page.marks.refused_means", "safety sent nothing"));
    if (header.marks.length) mark(element, t("page.marks.event", "event"), "--text-normal", "tick", t("page.marks.event_means", "an event from the list"));
    if (header.marks.some(({ kind }) => isTuningEvent(kind))) mark(element, t("page.marks.tuned", "tuned"), "--active", "hairline", t("page.marks.tuned_means", "another strategy, or other parameters, from here on"));
    const { spaces } = this.#episode;
    if (!spaces.includes("joint")) this.#legend.explain("raw", spaces.length ? t("page.replay.other_space", "The policy acts in {spaces} space: it has no joints to draw.", { spaces: spaces.join(", ") }) : t("page.replay.no_space", "The policy acts in no space: it has no joints to draw."));
  }

  #hover(time) {
    if (time === this.#hovered) return;
    this.#hovered = time;
    this.#at();
  }

  /** Show the values and the chunk under the pointer or, without a pointer, at the clock. */
  #at() {
    const time = (this.#hovered ?? this.#clock.time) + 1e-6;
    const { chunks, ticks } = this.#episode;
    const owner = chunks.ownerAt(time);
    const tick = lastNotAbove(ticks.time, time);
    for (const cell of this.#cells) cell.at(this.#clock.time, { tick, time, owner });
    write(this.#said, readout(chunks, time));
  }
}

/** Add a line that explains a colour behind the curves. */
function mark(element, name, colour, shape, means) {
  const part = document.createElement("p");
  part.className = "legend legend-mark";
  const swatch = document.createElement("i");
  swatch.className = shape;
  swatch.style.setProperty("--colour", `var(${colour})`);
  part.append(swatch, Object.assign(document.createElement("span"), { className: "strong", textContent: name }), ` ${means}`);
  element.append(part);
}

/** Group consecutive values of one chunk into lines: [{id, times, values}]. */
function answers(times, values, ids) {
  const found = [];
  ids.forEach((id, index) => {
    if (!index || id !== ids[index - 1]) found.push({ id, times: [], values: [] });
    found.at(-1).times.push(times[index]);
    found.at(-1).values.push(values[index]);
  });
  return found;
}
