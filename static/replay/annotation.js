// Segments of an episode, labelled with the lab's vocabulary: begun and ended by keys at the cursor, or drawn on their lane.

import { get, post } from "../site/api.js";
import { t } from "../site/sentences.js";
import { SegmentLane } from "./segment_lane.js";

const element = (id) => document.getElementById(id);

export class Annotation {
  #clock;
  #bar;
  #ask;
  #tell;
  #open;
  #close;
  #lane;
  #labels = []; // [{words, colour, key}]
  #segments = [];
  #begun = null; // {row, label} of a segment that has no end yet
  #edited = null; // what the form edits: {first, last, segment?}

  /**
   * `ask(request, done)` sends a request and shows the answer, `tell(sentence, bad)` shows a sentence; `open` and `close`
   * handle forms.
   */
  constructor({ clock, bar, ask, tell, open, close }) {
    [this.#clock, this.#bar, this.#ask, this.#tell, this.#open, this.#close] = [clock, bar, ask, tell, open, close];
    const strip = element("segments");
    strip.hidden = false;
    this.#lane = new SegmentLane({
      ...{ strip, clock, user: bar.dataset.user },
      drawn: (span) => this.#fill(span, "", ""),
      moved: (segment) => this.#put({ first: segment.first, last: segment.last, segment: segment.uuid, label: segment.label, milestone: segment.milestone }, t("page.segments.moved", "“{label}” is rows {first} to {last}.", { label: segment.label, first: segment.first, last: segment.last })),
    });
    element("segment-form").addEventListener("submit", (event) => this.#save(event));
    for (const kind of ["tick", "seek"]) clock.addEventListener(kind, () => this.at());
    this.#offer();
  }

  /** Load the lab's vocabulary and show it as buttons. Nothing else needs it, and a failure is only reported. */
  async #offer() {
    try {
      this.#labels = await get(this.#bar.dataset.labels);
    } catch (error) {
      this.#tell(t("page.segments.no_vocabulary", "the vocabulary did not load: {why}", { why: error.message }), true);
      return;
    }
    element("segment-vocabulary").replaceChildren(...this.#labels.map((label) => this.#button(label)));
    this.show(this.#segments);
  }

  #button({ words, colour, key }) {
    const button = Object.assign(document.createElement("button"), { type: "button", className: "button segment-label", title: t("page.segments.label_title", "Start a segment of that label at this row; press again to end it") });
    Object.assign(button.dataset, { colour, label: words });
    button.setAttribute("aria-pressed", "false");
    button.append(Object.assign(document.createElement("span"), { textContent: words }));
    if (key) button.append(Object.assign(document.createElement("kbd"), { textContent: key }));
    button.addEventListener("click", () => this.mark(words));
    return button;
  }

  /** Show these segments. */
  show(segments) {
    this.#segments = segments;
    this.#lane.show(segments, new Map(this.#labels.map(({ words, colour }) => [words, colour])));
    const words = [...new Set([...this.#labels.map((label) => label.words), ...segments.map(({ label }) => label)])];
    element("segment-labels").replaceChildren(...words.map((value) => Object.assign(document.createElement("option"), { value })));
    this.at();
  }

  /** Draw the unfinished segment up to the row that is shown. */
  at() {
    this.#lane.open(this.#edited ? { ...this.#edited, label: "" } : this.#begun && { first: this.#begun.row, last: this.#clock.row, label: this.#begun.label });
  }

  /** Set the segment being marked: {row, label} of one that has no end yet, or null for none. */
  #mark(begun) {
    this.#begun = begun;
    for (const button of element("segment-vocabulary").children) button.setAttribute("aria-pressed", String(begun?.label === button.dataset.label));
    this.at();
  }

  /** Return the label that has `key`, or undefined. */
  labelOf(key) {
    return this.#labels.find((label) => label.key === key)?.words;
  }

  /** Begin a segment of that label at this row, or end it here; an open segment of another label ends before this row. */
  mark(label) {
    const { row } = this.#clock;
    if (this.#edited) {
      this.#put({ ...this.#edited, label, milestone: element("segment-form").elements.milestone.value }, t("page.segments.label_saved", "“{label}” is saved.", { label })).then((kept) => kept && this.#done());
      return;
    }
    const begun = this.#begun;
    if (begun?.label && (begun.label === label || begun.row !== row)) {
      const last = begun.label === label ? row : row + Math.sign(begun.row - row);
      this.#put({ first: Math.min(begun.row, last), last: Math.max(begun.row, last), label: begun.label, milestone: "" }, t("page.segments.label_saved", "“{label}” is saved.", { label: begun.label })).then((kept) => kept || this.#begun || this.#mark(begun));
    }
    if (begun?.label !== label) this.begin(begun && !begun.label ? begun.row : row, label);
    else this.#mark(null);
  }

  begin(row = this.#clock.row, label = "") {
    this.#mark({ row, label });
    this.#tell(label ? t("page.segments.label_from", "“{label}” from row {row} on.", { label, row }) : t("page.segments.from", "A segment from row {row} on.", { row }));
  }

  end() {
    if (this.#begun === null) {
      this.#tell(t("page.segments.not_begun", "No segment has begun: press [ at its first row."), true);
      return;
    }
    const { row, label } = this.#begun;
    if (label) this.mark(label);
    else this.#fill({ first: Math.min(row, this.#clock.row), last: Math.max(row, this.#clock.row) }, "", "");
  }

  edit() {
    const found = this.#own();
    if (found) this.#fill({ first: found.first, last: found.last, segment: found.uuid }, found.label, found.milestone);
  }

  remove() {
    const found = this.#own();
    if (found) this.#ask(() => post(`${this.#bar.dataset.segments}/${found.uuid}/remove`, {}), t("page.segments.removed", "“{label}” is removed.", { label: found.label }));
  }

  /** Discard what is being edited. */
  cancel() {
    this.#done();
  }

  #done() {
    this.#edited = null;
    this.#close();
    this.#mark(null);
  }

  #fill(edited, label, milestone) {
    this.#clock.pause();
    this.#edited = edited;
    element("segment-span").textContent = t("page.segments.span", "{first} to {last}", { first: edited.first, last: edited.last });
    const { elements } = element("segment-form");
    elements.label.value = label;
    elements.milestone.value = milestone;
    this.#open("segment-form");
    this.at();
  }

  async #save(event) {
    event.preventDefault();
    const { label, milestone } = event.target.elements;
    if (await this.#put({ ...this.#edited, label: label.value, milestone: milestone.value }, t("page.segments.saved", "The segment is saved."))) this.#done();
  }

  #put(content, done) {
    return this.#ask(() => post(this.#bar.dataset.segments, content), done);
  }

  /** Return the user's shortest segment at this row; report it if there is none. */
  #own() {
    const { row } = this.#clock;
    const own = this.#segments.filter((one) => one.annotator === this.#bar.dataset.user && one.first <= row && row <= one.last);
    own.sort((one, other) => one.last - one.first - (other.last - other.first));
    if (!own.length) this.#tell(t("page.segments.none_own", "None of your segments is at this row."), true);
    return own[0];
  }
}
