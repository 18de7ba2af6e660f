// The pane of the curves: which joint, what its values are at the clock, and the plot.

import { Legend } from "../console/curves/curve_legend.js";
import { jointOptions } from "../console/manual/joint_names.js";
import { last } from "../site/ascending.js";
import { Chunks } from "./chunks.js";
import { joint, message } from "./data.js";
import { Plot, tunes } from "./plot.js";
import { readout, write } from "./readout.js";

const KEY = "eva-replay-joint";

/** Fill the pane, or put a sentence in its place; resolves to {held, marks}, empty where nothing is known. */
export async function curvePane({ clock, address, uplot }) {
  const note = document.getElementById("curves-note");
  try {
    const { header, numbers } = await message(address);
    const episode = read(header, numbers);
    const library = (await import(uplot).catch(() => null))?.default;
    if (library) new Pane(clock, episode, library);
    note.hidden = Boolean(library);
    note.textContent = library ? "" : "Curves are drawn by uPlot, which is not installed: run make setup and start the lab again.";
    return { held: header.held, marks: header.marks };
  } catch (error) {
    note.textContent = `No curves: ${error.message}.`;
    console.error(error);
    return { held: [], marks: [] };
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
  #plot;
  #curves = null;
  #raw = []; // what each chunk wanted of the joint
  #legend;
  #hovered = null; // [s], null where the pointer is elsewhere
  #said = document.getElementById("chunk");

  constructor(clock, episode, library) {
    this.#clock = clock;
    this.#episode = episode;
    const { held, marks } = episode.header;
    const behind = { held, marks, safety: this.#safety(), owners: episode.chunks };
    const element = document.getElementById("legend");
    this.#legend = new Legend(element, (name, shown) => this.#plot.reveal(name, shown));
    this.#explain(element);
    const seek = (time) => clock.seekRow(Math.floor(time * clock.fps));
    this.#plot = new Plot({ element: document.getElementById("curves"), library, behind, shown: (name) => this.#legend.shown(name), seek, hover: (time) => this.#hover(time) });
    this.#select();
    for (const kind of ["tick", "seek"]) clock.addEventListener(kind, () => this.#at());
  }

  #safety() {
    const { time, safety } = this.#episode.ticks;
    const found = [];
    safety.forEach((what, index) => what && found.push({ time: time[index], refused: what === 2 }));
    return found;
  }

  #select() {
    const select = document.getElementById("joint");
    const names = this.#episode.header.joints;
    select.replaceChildren(...jointOptions(names, this.#episode.header.grippers));
    const wanted = names.indexOf(localStorage.getItem(KEY));
    select.selectedIndex = Math.max(0, wanted);
    select.addEventListener("change", () => {
      localStorage.setItem(KEY, names[select.selectedIndex]);
      this.#show(select.selectedIndex);
    });
    this.#show(select.selectedIndex);
  }

  #show(index) {
    const { ticks, raw } = this.#episode;
    const length = ticks.time.length;
    const pick = (name) => joint(ticks[name], index, length);
    this.#curves = { time: ticks.time, state: pick("measured"), executed: pick("executed"), smoothed: pick("smoothed") };
    document.getElementById("unit").textContent = this.#episode.header.units[index] ?? "";
    this.#raw = answers(raw.time, joint(raw.values, index, raw.time.length), raw.chunk);
    this.#plot.show(this.#curves, this.#raw);
    this.#at();
  }

  #explain(element) {
    const { safety } = this.#episode.ticks;
    const { chunks, header } = this.#episode;
    if (chunks.spans.length) mark(element, "chunk", "--mark-chunk", "hairline", "Where another chunk takes over; the strip over the curves has its number");
    if (chunks.overlaps.length) mark(element, "overlap", "--mark-overlap", "patch", "Steps that several chunks made");
    if (header.held.length) mark(element, "held", "--warn-soft", "patch", "Nobody asked the robot for anything");
    if (safety.includes(1)) mark(element, "changed", "--warn", "tick", "Safety had another action sent than was asked for");
    if (safety.includes(2)) mark(element, "refused", "--danger", "tick", "Safety let nothing be sent");
    if (header.marks.length) mark(element, "event", "--text-normal", "tick", "Something that the list of events tells, at the top of the plot");
    if (header.marks.some(({ kind }) => tunes(kind))) mark(element, "tuned", "--active", "hairline", "Another strategy, or other parameters, from here on");
    const { spaces } = this.#episode;
    if (!spaces.includes("joint")) this.#legend.explain("raw", `The policy speaks in ${spaces.join(", ") || "no"} space: it has no joint to draw.`);
  }

  #hover(time) {
    this.#hovered = time;
    this.#at();
  }

  /** The values and the chunk under the pointer, or else at the clock. */
  #at() {
    this.#plot.at(this.#clock.time);
    const time = this.#hovered ?? this.#clock.time;
    const { chunks } = this.#episode;
    this.#plot.choose(chunks.ownerAt(time + 1e-6));
    write(this.#said, readout(chunks, time + 1e-6));
    const tick = last(this.#curves.time, time + 1e-6);
    for (const name of ["state", "executed", "smoothed"]) this.#legend.value(name, tick < 0 ? NaN : this.#curves[name][tick]);
    this.#legend.value("raw", wanted(this.#raw, time + 1e-6));
  }
}

/** Say what a colour behind the curves means. */
function mark(element, name, colour, shape, means) {
  const part = document.createElement("span");
  part.className = "legend legend-mark";
  part.title = means;
  const swatch = document.createElement("i");
  swatch.className = shape;
  swatch.style.setProperty("--colour", `var(${colour})`);
  part.append(swatch, name);
  element.append(part);
}

/** What the newest chunk wants at `time`; NaN where it says nothing. */
function wanted(chunks, time) {
  const chunk = chunks.findLast(({ times }) => times[0] <= time);
  return chunk ? chunk.values[last(chunk.times, time)] : NaN;
}

/** Consecutive values of one chunk belong to one line: [{id, times, values}]. */
function answers(times, values, ids) {
  const found = [];
  ids.forEach((id, index) => {
    if (!index || id !== ids[index - 1]) found.push({ id, times: [], values: [] });
    found.at(-1).times.push(times[index]);
    found.at(-1).values.push(values[index]);
  });
  return found;
}
