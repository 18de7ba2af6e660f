// The failure gallery: arrow keys move between clips, a category's letter assigns it to the chosen one, Ctrl+Z undoes.

import { post } from "../site/api.js";
import { t } from "../site/sentences.js";
import { Clips } from "./clips.js";

const FIELDS = ["failure_phase", "failure"];
const element = (id) => document.getElementById(id);

class Gallery {
  #cards = [...document.querySelectorAll("[data-trial]")];
  #choices = [...document.querySelectorAll("[data-field]")];
  #clips;
  #chosen = null;
  #done = []; // changes that can be undone, {card, before}, the newest last
  #asked = Promise.resolve();

  constructor() {
    const still = matchMedia("(prefers-reduced-motion: reduce)");
    this.#clips = new Clips(document.querySelectorAll("video[data-src]"), !still.matches);
    still.addEventListener("change", () => this.#play(!still.matches));
    for (const card of this.#cards) card.addEventListener("focusin", () => this.#choose(card));
    for (const choice of this.#choices) choice.addEventListener("click", () => this.#assign(choice));
    element("clips-play").addEventListener("click", () => this.#play(!this.#clips.playing));
    element("clips-print").addEventListener("click", () => this.#print());
    element("clips-undo")?.addEventListener("click", () => this.#undo());
    document.addEventListener("keydown", (event) => this.#key(event));
    this.#play(this.#clips.playing);
    this.#choose(this.#cards.find(({ id }) => `#${id}` === window.location.hash) ?? this.#cards[0]);
  }

  #play(playing) {
    this.#clips.playing = playing;
    element("clips-play").textContent = playing ? t("page.gallery.pause", "Pause the clips") : t("page.gallery.play", "Play the clips");
  }

  async #print() {
    const playing = this.#clips.playing;
    this.#tell(t("page.gallery.printing", "Bringing the pictures for print …"));
    await this.#clips.stills();
    this.#tell("");
    window.print();
    this.#play(playing);
  }

  #tell(sentence, bad = false) {
    const line = element("clips-said");
    line.textContent = sentence;
    line.classList.toggle("bad", bad);
  }

  // --- which one is chosen -------------------------------------------------------------------------------

  #choose(card) {
    if (this.#chosen) this.#mark(this.#chosen, false);
    this.#chosen = card;
    this.#mark(card, true);
    this.#show();
  }

  #mark(card, chosen) {
    card.tabIndex = chosen ? 0 : -1;
    if (chosen) card.setAttribute("aria-current", "true");
    else card.removeAttribute("aria-current");
  }

  #show() {
    for (const choice of this.#choices) choice.setAttribute("aria-pressed", String(this.#chosen.dataset[choice.dataset.field] === choice.dataset.words));
    for (const name of document.querySelectorAll("[data-chosen]")) name.textContent = t("page.gallery.trial", "Trial {id}", { id: this.#chosen.dataset.trial });
  }

  /** Return the next card in the direction of the key, in another line the nearest one; undefined if there is none. */
  #neighbour(key) {
    const here = this.#cards.indexOf(this.#chosen);
    if (key === "ArrowLeft") return this.#cards[here - 1];
    if (key === "ArrowRight") return this.#cards[here + 1];
    const own = this.#chosen.getBoundingClientRect();
    const down = key === "ArrowDown";
    const others = this.#cards
      .map((card) => ({ card, box: card.getBoundingClientRect() }))
      .filter(({ box }) => (down ? box.top >= own.bottom : box.bottom <= own.top));
    const away = ({ box }) => 1e4 * Math.abs(box.top - own.top) + Math.abs(box.left - own.left);
    return others.sort((one, other) => away(one) - away(other))[0]?.card;
  }

  // --- what is assigned ----------------------------------------------------------------------------------

  #assign({ dataset: { field, words } }) {
    const card = this.#chosen;
    this.#next(async () => {
      const before = await this.#send(card, { [field]: words });
      if (before) this.#done.push({ card, before });
    });
  }

  #undo() {
    this.#next(async () => {
      const newest = this.#done.at(-1);
      if (!newest) {
        this.#tell(t("page.gallery.nothing_to_undo", "Nothing is left to undo on this page."));
        return;
      }
      newest.card.focus();
      if (await this.#send(newest.card, { ...newest.before, reason: "a change of its failure was undone" })) this.#done.pop();
    });
  }

  /** Do requests one after the other, so that each starts from the result of the previous one. */
  #next(work) {
    this.#asked = this.#asked.then(work).then(() => {
      const undo = element("clips-undo");
      if (undo) undo.disabled = !this.#done.length;
    });
  }

  /** Send a correction; resolve to the previous values, or to null if nothing has changed. */
  async #send(card, content) {
    const before = Object.fromEntries(FIELDS.map((name) => [name, card.dataset[name]]));
    try {
      const { scores } = await post(card.dataset.address, { ...content, score: card.dataset.score });
      const [{ uuid }] = scores;
      const changed = uuid !== card.dataset.score;
      card.dataset.score = uuid;
      for (const name of FIELDS) card.dataset[name] = scores[0][name];
      const why = FIELDS.map((name) => scores[0][name]).filter(Boolean).join(": ") || t("page.gallery.not_specified", "not specified");
      card.querySelector("[data-why]").textContent = why;
      this.#show();
      this.#tell(t("page.gallery.trial_said", "Trial {id}: {why}.", { id: card.dataset.trial, why }));
      return changed ? before : null;
    } catch (error) {
      this.#tell(t("page.gallery.trial_said", "Trial {id}: {why}.", { id: card.dataset.trial, why: error.message }), true);
      return null;
    }
  }

  #key(event) {
    if (event.target.closest("select, textarea, input, dialog")) return;
    const key = event.key.toLowerCase();
    if ((event.ctrlKey || event.metaKey) && key === "z") {
      event.preventDefault();
      this.#undo();
      return;
    }
    if (event.ctrlKey || event.metaKey || event.altKey) return;
    const next = event.key.startsWith("Arrow") ? this.#neighbour(event.key) : null;
    const choice = event.repeat ? null : this.#choices.find(({ dataset }) => dataset.key === key);
    if (next) next.focus();
    else if (choice) this.#assign(choice);
    else return;
    event.preventDefault();
  }
}

if (document.querySelector("[data-trial]")) new Gallery();
