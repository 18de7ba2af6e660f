// The review of an episode: findings of the checks, verdicts and annotated segments, all with keys.

import { get, post } from "../site/api.js";
import { t } from "../site/sentences.js";
import { when } from "../site/times.js";
import { Annotation } from "./annotation.js";
import { showLostFrames } from "./lost_frames.js";
import { drawBands, nextFlag, flagsAt, fillList, span, verdictWord } from "./review_lanes.js";

const NOTE_S = 2; // how long a note is shown after its moment [s]
const LOOK_AGAIN_MS = 4000; // interval [ms] of new requests while the checks are not done
const element = (id) => document.getElementById(id);

export class Review {
  #clock;
  #bar = element("review");
  #said = { flags: [], segments: [], reviews: [], covered: 0, quality: null, verdict: null };
  #near; // note about the moment that is shown
  #noted = 0; // the row at which a note was begun
  #annotation;
  #asked = Promise.resolve(); // requests of the user, one after the other
  #shown = 0; // number of answers to the user's requests
  #leaving = false; // true while the next episode is being opened: keys pressed now are meant for that one

  constructor(clock) {
    this.#clock = clock;
    this.#bar.addEventListener("click", (event) => {
      const button = event.target.closest("[data-review]");
      if (button) this.#do(button.dataset.review);
    });
    element("note-form").addEventListener("submit", (event) => this.#saveNote(event));
    this.#annotation = new Annotation({
      ...{ clock, bar: this.#bar },
      ask: (request, done) => this.#ask(request, done),
      tell: (sentence, bad) => this.#tell(sentence, bad),
      open: (form) => this.#open(form),
      close: () => this.#close(),
    });
    document.addEventListener("keydown", (event) => this.#key(event));
    for (const kind of ["tick", "seek"]) clock.addEventListener(kind, () => this.#at());
    window.addEventListener("pageshow", () => (this.#leaving = false)); // the user came back with the browser's Back button
    this.#load().then(() => this.#tellWaiting());
  }

  async #load() {
    const shown = this.#shown;
    try {
      const said = await get(this.#bar.dataset.address);
      if (shown === this.#shown) this.#show(said); // otherwise a request of the user was answered meanwhile, and is newer
    } catch (error) {
      this.#tell(error.message, true);
    }
    if (!this.#said.quality) setTimeout(() => this.#load(), LOOK_AGAIN_MS);
  }

  /**
   * Send a request after all earlier ones and show its answer; a failure is reported and changes nothing else. Resolve to
   * whether it succeeded.
   */
  #ask(request, done = "") {
    const answer = this.#asked.then(async () => {
      try {
        const said = await request();
        this.#shown += 1;
        this.#show(said);
        if (done) this.#tell(done);
        return true;
      } catch (error) {
        this.#tell(error.message, true);
        return false;
      }
    });
    this.#asked = answer;
    return answer;
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
    const { flags, segments, reviews, verdict, quality, covered } = this.#said;
    const state = element("review-state");
    state.textContent = verdict ? t("page.review.verdict_by", "{verdict} by {who}", { verdict: verdictWord(verdict.verdict), who: verdict.reviewer }) : t("page.review.unreviewed", "unreviewed");
    state.dataset.verdict = verdict?.verdict ?? "";
    const notes = this.#notes.map(({ frame, note, reviewer }) => ({ first: frame, last: frame, severity: "note", text: `${reviewer}: ${note}` }));
    drawBands(element("flags"), [...[...flags].reverse(), ...notes], this.#frames, (band, flag) => {
      band.dataset.severity = flag.severity;
      band.title = flag.text;
      band.addEventListener("click", () => this.#clock.seekRow(flag.first));
    });
    const go = ({ first }) => (first >= 0 ? () => this.#clock.seekRow(first) : null);
    fillList(element("flags-list"), this.#flagLines(), quality ? t("page.review.nothing_found", "The checks found nothing.") : t("page.review.not_done", "The checks are not done yet."));
    fillList(
      element("segments-list"),
      segments.map((one) => ({ words: one.label, detail: span(one, one.annotator), go: go(one) })),
      t("page.review.no_segments_yet", "No segment is annotated yet."),
    );
    fillList(
      element("history-list"),
      reviews.map((one) => ({
        words: one.note ? `${verdictWord(one.verdict)}: ${one.note}` : verdictWord(one.verdict),
        detail: one.frame === null ? `${one.reviewer}, ${when(one.at)}` : t("page.review.said_at", "at {moment}, {who}, {when}", { moment: this.#seconds(one.frame), who: one.reviewer, when: when(one.at) }),
        mark: one.verdict,
        go: one.frame === null ? null : () => this.#clock.seekRow(one.frame),
      })),
      t("page.review.no_reviews_yet", "No review yet."),
    );
    element("flags-count").textContent = quality ? (flags.length ? t("page.review.flags", "Flags {n}", { n: flags.length }) : t("page.review.clean", "Clean")) : t("page.review.unchecked", "Unchecked");
    element("flags-count").dataset.severity = quality?.worst ?? "";
    element("segments-count").textContent = segments.length ? t("page.review.segments_n", "Segments {n}", { n: segments.length }) : t("page.review.segments", "Segments");
    element("history-count").textContent = reviews.length ? t("page.review.reviews_n", "Reviews {n}", { n: reviews.length }) : t("page.review.reviews", "Reviews");
    element("history-covered").hidden = !covered;
    this.#annotation.show(segments);
    this.#at();
  }

  #flagLines() {
    const flags = this.#said.flags.map((flag) => ({
      words: flag.text,
      detail: [flag.kind.replaceAll("_", " "), flag.bound === null ? "" : t("page.review.allowed", "allowed {bound}", { bound: Number(flag.bound.toPrecision(3)) })].filter(Boolean).join(", "),
      mark: flag.severity,
      go: flag.first >= 0 ? () => this.#clock.seekRow(flag.first) : null,
    }));
    const unchecked = (this.#said.quality?.unchecked ?? []).map((words) => ({ words, mark: "info" }));
    return [...flags, ...unchecked];
  }

  /** Notes about one moment, in order. */
  get #notes() {
    return this.#said.reviews.filter(({ frame }) => frame !== null).sort((one, other) => one.frame - other.frame);
  }

  #seconds(row) {
    return `${(row / this.#clock.fps).toFixed(2)} s`;
  }

  get #frames() {
    return Number(this.#bar.dataset.frames);
  }

  /** Update the texts beside the buttons for the row that is shown. */
  #at() {
    const row = this.#clock.row;
    const [flag] = flagsAt(this.#said.flags, row);
    const near = this.#notes.findLast(({ frame }) => frame <= row && row - frame < NOTE_S * this.#clock.fps);
    const here = element("flag-here");
    here.textContent = here.title = near ? `${near.reviewer}: ${near.note}` : (flag?.text ?? "");
    here.dataset.severity = near ? "note" : (flag?.severity ?? "");
    if (near && near !== this.#near) {
      const said = element("review-said");
      said.textContent = said.title = here.title; // there is more room than beside the time
    }
    this.#near = near;
    showLostFrames(this.#said.flags, row);
  }

  // --- what is done --------------------------------------------------------------------------------------

  #do(what) {
    const actions = {
      pass: () => this.#verdict("pass"),
      fail: () => this.#verdict("fail"),
      passNext: () => this.#verdictAndNext("pass"),
      failNext: () => this.#verdictAndNext("fail"),
      note: () => this.#note(),
      begin: () => this.#annotation.begin(),
      end: () => this.#annotation.end(),
      edit: () => this.#annotation.edit(),
      remove: () => this.#annotation.remove(),
      next: () => this.#next(),
      flag: () => this.#toFlag(1),
      flagBack: () => this.#toFlag(-1),
      check: () => this.#check(),
      keys: () => element("review-keys").showModal(),
      cancel: () => this.#annotation.cancel(),
    };
    actions[what]();
  }

  #verdict(verdict) {
    return this.#ask(() => post(this.#bar.dataset.address, { verdict }), verdict === "pass" ? t("page.review.passed", "Passed.") : t("page.review.failed", "Failed."));
  }

  async #verdictAndNext(verdict) {
    if (await this.#verdict(verdict)) this.#next();
  }

  #note() {
    this.#noted = this.#clock.row;
    element("note-moment").textContent = this.#seconds(this.#noted);
    this.#open("note-form");
  }

  async #saveNote(event) {
    event.preventDefault();
    const { note: field, here } = event.target.elements;
    const frame = here.checked ? this.#noted : null;
    const done = here.checked ? t("page.review.note_saved_here", "The note is saved; the address of this page leads to its moment.") : t("page.review.note_saved", "The note is saved.");
    if (await this.#ask(() => post(this.#bar.dataset.address, { verdict: "note", note: field.value, frame }), done)) {
      if (frame !== null) this.#clock.seekRow(frame);
      field.value = "";
      this.#close();
    }
  }

  #toFlag(step) {
    const row = nextFlag(this.#said.flags, this.#clock.row, step);
    if (row === null) this.#tell(step > 0 ? t("page.review.no_flag_after", "No flag begins after this row.") : t("page.review.no_flag_before", "No flag begins before this row."));
    else this.#clock.seekRow(row);
  }

  async #check() {
    try {
      await post(this.#bar.dataset.quality, {});
      this.#tell(t("page.review.checking", "It is being checked again; reload the page in a moment."));
    } catch (error) {
      this.#tell(error.message, true);
    }
  }

  /** Open the next episode, with the same speed, as soon as all requests are answered. */
  async #next() {
    if (this.#leaving) return;
    this.#leaving = true;
    await this.#asked;
    try {
      const { episode } = await get(this.#bar.dataset.next);
      const { rate } = this.#clock;
      if (episode) {
        this.#tell(t("page.review.opening", "Opening the next episode …"));
        window.location.assign(`${this.#bar.dataset.replay}${episode}/${rate === 1 ? "" : `?speed=${rate}`}`);
        return;
      }
      this.#tell(t("page.review.none_waiting", "No other episode is waiting for a review."));
    } catch (error) {
      this.#tell(error.message, true);
    }
    this.#leaving = false;
  }

  async #tellWaiting() {
    try {
      const { waiting } = await get(this.#bar.dataset.next);
      if (!this.#shown && !this.#leaving) this.#tell(waiting === 1 ? t("page.review.one_waiting", "1 episode is waiting for a review.") : t("page.review.many_waiting", "{n} episodes are waiting for a review.", { n: waiting }));
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
      this.#annotation.cancel();
      return;
    }
    if (event.target.closest("select, textarea, input:not([type=range])")) return;
    const keys = { p: "pass", f: "fail", n: "note", "[": "begin", "]": "end", e: "edit", x: "remove", P: "passNext", F: "failNext", u: "next", g: "flag", G: "flagBack", c: "check", "?": "keys" };
    const [action, label] = [keys[event.key], this.#annotation.labelOf(event.key)];
    if ((!action && !label) || event.repeat) return;
    event.preventDefault();
    if (this.#leaving) this.#tell(t("page.review.leaving", "Not counted: the next episode is still being opened."));
    else if (action) this.#do(action);
    else this.#annotation.mark(label);
  }
}
