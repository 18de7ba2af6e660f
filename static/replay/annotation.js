// Segments of an episode: begun and ended by keys at the cursor or drawn on their lane, with the lab's vocabulary.

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
  #edited = null; // what the form is about: {first, last, segment?}

  /** `ask(request, done)` sends one and shows the answer, `tell(sentence, bad)` says something; `open` and `close` forms. */
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

  /** The lab's vocabulary as buttons; it is wanted by no more than this, and its failure is said. */
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

  /** Show the segments that there are. */
  show(segments) {
    this.#segments = segments;
    this.#lane.show(segments, new Map(this.#labels.map(({ words, colour }) => [words, colour])));
    const words = [...new Set([...this.#labels.map((label) => label.words), ...segments.map(({ label }) => label)])];
    element("segment-labels").replaceChildren(...words.map((value) => Object.assign(document.createElement("option"), { value })));
    this.at();
  }

  /** What belongs to the row that is shown: the band of the segment that has no end yet. */
  at() {
    this.#lane.open(this.#edited ? { ...this.#edited, label: "" } : this.#begun && { first: this.#begun.row, last: this.#clock.row, label: this.#begun.label });
  }

  /** What is being marked from now on: {row, label} of a segment that has no end yet, null for none. */
  #mark(begun) {
    this.#begun = begun;
    for (const button of element("segment-vocabulary").children) button.setAttribute("aria-pressed", String(begun?.label === button.dataset.label));
    this.at();
  }

  /** The label that has `key`; undefined where none has. */
  labelOf(key) {
    return this.#labels.find((label) => label.key === key)?.words;
  }

  /** A part of that label begins at this row, or ends here; one of another label ends before this row. */
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

  /** Nothing is being written any more. */
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

  /** The user's shortest segment at this row; says so where there is none. */
  #own() {
    const { row } = this.#clock;
    const own = this.#segments.filter((one) => one.annotator === this.#bar.dataset.user && one.first <= row && row <= one.last);
    own.sort((one, other) => one.last - one.first - (other.last - other.first));
    if (!own.length) this.#tell(t("page.segments.none_own", "None of your segments is at this row."), true);
    return own[0];
  }
}
