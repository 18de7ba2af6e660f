// The review of an episode: what the checks found, verdicts, annotated parts; everything has a key.

import { get, post } from "../site/api.js";
import { sayLost } from "./lost.js";
import { bands, flagFrom, flagsAt, list, stacked } from "./review_lanes.js";

const LOOK_AGAIN_MS = 4000; // while the checks are not done
const element = (id) => document.getElementById(id);

export class Review {
  #clock;
  #bar = element("review");
  #said = { flags: [], segments: [], reviews: [], quality: null, verdict: null };
  #begin = null; // the row at which a segment begins that has no end yet
  #edited = null; // what the segment's form is about: {first, last, segment?}
  #busy = false;
  #shown = 0; // answers to what was pressed

  constructor(clock) {
    this.#clock = clock;
    this.#bar.addEventListener("click", (event) => {
      const button = event.target.closest("[data-review]");
      if (button) this.#do(button.dataset.review);
    });
    element("note-form").addEventListener("submit", (event) => this.#saveNote(event));
    element("segment-form").addEventListener("submit", (event) => this.#saveSegment(event));
    document.addEventListener("keydown", (event) => this.#key(event));
    for (const kind of ["tick", "seek"]) clock.addEventListener(kind, () => this.#at());
    this.#load();
  }

  async #load() {
    const shown = this.#shown;
    try {
      const said = await get(this.#bar.dataset.address);
      if (shown === this.#shown) this.#show(said); // else what was pressed meanwhile has been answered, and is newer
    } catch (error) {
      this.#tell(error.message, true);
    }
    if (!this.#said.quality) setTimeout(() => this.#load(), LOOK_AGAIN_MS);
  }

  /** Show what a request answers; its failure is said, and nothing else changes. */
  async #ask(request, done = "") {
    if (this.#busy) {
      this.#tell("not yet: what was pressed before is on its way", true);
      return false;
    }
    this.#busy = true;
    try {
      const said = await request();
      this.#shown += 1;
      this.#show(said);
      if (done) this.#tell(done);
      return true;
    } catch (error) {
      this.#tell(error.message, true);
      return false;
    } finally {
      this.#busy = false;
    }
  }

  #tell(sentence, bad = false) {
    const line = element("review-said");
    line.textContent = sentence;
    line.classList.toggle("bad", bad);
    line.title = sentence;
  }

  // --- what is shown -------------------------------------------------------------------------------------

  #show(said) {
    this.#said = { ...said, flags: said.quality?.flags ?? [] };
    const { flags, segments, reviews, verdict, quality } = this.#said;
    const state = element("review-state");
    state.textContent = verdict ? `${verdict.verdict} by ${verdict.reviewer}` : "unreviewed";
    state.dataset.verdict = verdict?.verdict ?? "";
    bands(element("flags"), [...flags].reverse(), this.#frames, (band, flag) => {
      band.dataset.severity = flag.severity;
      band.title = flag.text;
      band.addEventListener("click", () => this.#clock.seekRow(flag.first));
    });
    const go = ({ first }) => (first >= 0 ? () => this.#clock.seekRow(first) : null);
    list(element("flags-list"), this.#flagLines(), quality ? "The checks found nothing." : "The checks are not done yet.");
    list(
      element("segments-list"),
      segments.map((one) => ({ words: one.label, detail: `${one.first} to ${one.last}${one.milestone ? `, then ${one.milestone}` : ""}, ${one.annotator}`, go: go(one) })),
      "No part is annotated yet.",
    );
    list(
      element("history-list"),
      reviews.map((one) => ({ words: one.note ? `${one.verdict}: ${one.note}` : one.verdict, detail: `${one.reviewer}, ${new Date(one.at).toLocaleString()}`, mark: one.verdict })),
      "Nobody has said anything yet.",
    );
    element("flags-count").textContent = quality ? (flags.length ? `Flags ${flags.length}` : "Clean") : "Unchecked";
    element("flags-count").dataset.severity = quality?.worst ?? "";
    element("segments-count").textContent = `Segments ${segments.length || ""}`.trim();
    element("history-count").textContent = `History ${reviews.length || ""}`.trim();
    const labels = [...new Set(segments.map(({ label }) => label))];
    element("segment-labels").replaceChildren(...labels.map((value) => Object.assign(document.createElement("option"), { value })));
    this.#at();
  }

  #flagLines() {
    const flags = this.#said.flags.map((flag) => ({
      words: flag.text,
      detail: [flag.kind.replaceAll("_", " "), flag.bound === null ? "" : `allowed ${Number(flag.bound.toPrecision(3))}`].filter(Boolean).join(", "),
      mark: flag.severity,
      go: flag.first >= 0 ? () => this.#clock.seekRow(flag.first) : null,
    }));
    const unchecked = (this.#said.quality?.unchecked ?? []).map((words) => ({ words, mark: "info" }));
    return [...flags, ...unchecked];
  }

  get #frames() {
    return Number(this.#bar.dataset.frames);
  }

  /** What belongs to the row that is shown: the open segment's band, and the words beside the buttons. */
  #at() {
    const row = this.#clock.row;
    const segments = stacked(this.#said.segments);
    if (this.#begin !== null) segments.push({ first: Math.min(this.#begin, row), last: Math.max(this.#begin, row), label: "…", open: true, lane: 0 });
    const strip = element("segments");
    strip.style.setProperty("--lanes", String(1 + Math.max(0, ...segments.map(({ lane }) => lane))));
    strip.hidden = !segments.length;
    bands(strip, segments, this.#frames, (band, segment) => {
      band.textContent = segment.label;
      band.style.setProperty("--lane", String(segment.lane));
      band.title = segment.open ? "" : `${segment.label}, ${segment.annotator}`;
      band.dataset.own = String(segment.annotator === this.#bar.dataset.user);
      band.toggleAttribute("data-open", Boolean(segment.open));
    });
    const [flag] = flagsAt(this.#said.flags, row);
    const here = element("flag-here");
    here.textContent = here.title = flag?.text ?? "";
    here.dataset.severity = flag?.severity ?? "";
    sayLost(this.#said.flags, row);
  }

  // --- what is done --------------------------------------------------------------------------------------

  #do(what) {
    const actions = {
      pass: () => this.#verdict("pass"),
      fail: () => this.#verdict("fail"),
      note: () => this.#open("note-form"),
      begin: () => this.#beginSegment(),
      end: () => this.#endSegment(),
      edit: () => this.#editSegment(),
      remove: () => this.#removeSegment(),
      next: () => this.#next(),
      flag: () => this.#toFlag(1),
      flagBack: () => this.#toFlag(-1),
      check: () => this.#check(),
      keys: () => element("review-keys").showModal(),
      cancel: () => this.#close(),
    };
    actions[what]();
  }

  #verdict(verdict) {
    this.#ask(() => post(this.#bar.dataset.address, { verdict }), verdict === "pass" ? "Passed." : "Failed.");
  }

  async #saveNote(event) {
    event.preventDefault();
    const field = event.target.elements.note;
    if (await this.#ask(() => post(this.#bar.dataset.address, { verdict: "note", note: field.value }), "The note is kept.")) {
      field.value = "";
      this.#close();
    }
  }

  #beginSegment() {
    this.#begin = this.#clock.row;
    this.#tell(`Segment from row ${this.#begin} on.`);
    this.#at();
  }

  #endSegment() {
    if (this.#begin === null) {
      this.#tell("No segment has begun: press [ at its first row.", true);
      return;
    }
    const ends = [this.#begin, this.#clock.row].sort((one, other) => one - other);
    this.#fill({ first: ends[0], last: ends[1] }, "", "");
  }

  #editSegment() {
    const found = this.#own();
    if (found) this.#fill({ first: found.first, last: found.last, segment: found.uuid }, found.label, found.milestone);
  }

  #fill(edited, label, milestone) {
    this.#clock.pause();
    this.#edited = edited;
    element("segment-span").textContent = `${edited.first} to ${edited.last}`;
    const { elements } = element("segment-form");
    elements.label.value = label;
    elements.milestone.value = milestone;
    this.#open("segment-form");
  }

  async #saveSegment(event) {
    event.preventDefault();
    const { label, milestone } = event.target.elements;
    const content = { ...this.#edited, label: label.value, milestone: milestone.value };
    if (await this.#ask(() => post(this.#bar.dataset.segments, content), "The segment is kept.")) {
      this.#begin = null;
      this.#close();
      this.#at();
    }
  }

  #removeSegment() {
    const found = this.#own();
    if (found) this.#ask(() => post(`${this.#bar.dataset.segments}/${found.uuid}/remove`, {}), `“${found.label}” is removed.`);
  }

  /** The user's shortest segment at this row; says so where there is none. */
  #own() {
    const row = this.#clock.row;
    const own = this.#said.segments.filter((one) => one.annotator === this.#bar.dataset.user && one.first <= row && row <= one.last);
    own.sort((one, other) => one.last - one.first - (other.last - other.first));
    if (!own.length) this.#tell("None of your segments is at this row.", true);
    return own[0];
  }

  #toFlag(step) {
    const row = flagFrom(this.#said.flags, this.#clock.row, step);
    if (row === null) this.#tell(step > 0 ? "No flag begins after this row." : "No flag begins before this row.");
    else this.#clock.seekRow(row);
  }

  async #check() {
    try {
      await post(this.#bar.dataset.quality, {});
      this.#tell("It is checked again; reload the page in a moment.");
    } catch (error) {
      this.#tell(error.message, true);
    }
  }

  async #next() {
    try {
      const { episode } = await get(this.#bar.dataset.next);
      if (episode) window.location.assign(`${this.#bar.dataset.replay}${episode}/`);
      else this.#tell("No other episode waits for a review.");
    } catch (error) {
      this.#tell(error.message, true);
    }
  }

  // --- forms and keys ------------------------------------------------------------------------------------

  #open(id) {
    this.#close();
    element(id).hidden = false;
    element(id).querySelector("input").focus();
  }

  #close() {
    for (const id of ["note-form", "segment-form"]) element(id).hidden = true;
  }

  #key(event) {
    if (event.ctrlKey || event.metaKey || event.altKey || element("review-keys").open) return;
    if (event.key === "Escape") {
      this.#begin = null;
      this.#close();
      this.#at();
      return;
    }
    if (event.target.closest("select, textarea, input:not([type=range])")) return;
    const keys = { p: "pass", f: "fail", n: "note", "[": "begin", "]": "end", e: "edit", x: "remove", u: "next", g: "flag", G: "flagBack", c: "check", "?": "keys" };
    const action = keys[event.key];
    if (!action || event.repeat) return;
    event.preventDefault();
    this.#do(action);
  }
}
