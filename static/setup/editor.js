// The editor of a scene: everything that is typed and dragged is one object, kept as a draft until it is saved.

import { post, RequestFailed } from "../site/api.js";
import { MilestoneList } from "./milestones.js";
import { Overlay } from "./overlay.js";
import { Positions } from "./positions.js";
import { t } from "../site/sentences.js";

const PREVIEW_MS = 600;
const SAVED = "eva-saved"; // key of the address of a scene that was saved before its page was opened
const SAVE_MS = 30000; // generous [ms], because an unknown outcome is worse than a long wait

class Editor {
  #given = JSON.parse(document.getElementById("state").textContent);
  #form = document.getElementById("scene");
  #said = document.getElementById("said");
  #faults = document.getElementById("faults");
  #save = document.getElementById("save");
  #key = `eva-draft:${location.pathname}${location.search}`;
  #saved;
  #timer = 0;
  #shown = []; // what was wrong at the last attempt to save

  constructor() {
    const { scene, seen, kept, references, bench, stations, addresses } = this.#given;
    this.#saved = JSON.stringify(scene);
    const draft = sessionStorage.getItem(this.#key);
    this.scene = draft ? JSON.parse(draft).scene : scene;
    this.seen = draft ? JSON.parse(draft).seen : seen;
    const changed = () => this.#changed();
    const overlay = new Overlay(document.getElementById("overlay"), { bench, stations, addresses });
    this.positions = new Positions(this, { bench, kept, references, may: Boolean(this.#save), changed, overlay });
    this.milestones = new MilestoneList(this, changed);
    this.#fill();
    if (draft) this.#tell(t("page.scene.restored", "Your unsaved changes are restored."), "pressed");
    if (sessionStorage.getItem(SAVED) === location.pathname) this.#tell(t("page.scene.saved", "Saved."), "accepted");
    sessionStorage.removeItem(SAVED);
    document.getElementById("bench")?.addEventListener("change", ({ target }) => this.#otherBench(target.value.trim()));
    document.getElementById("discard").addEventListener("click", () => this.#discard());
    this.#form.addEventListener("input", (event) => this.#typed(event.target));
    this.#save?.addEventListener("click", () => this.#sent());
    document.addEventListener("keydown", (event) => {
      if (event.key !== "s" || !(event.ctrlKey || event.metaKey)) return;
      event.preventDefault();
      this.#save?.click();
    });
    document.getElementById("operator").addEventListener("toggle", () => this.#previewed());
    this.#faults.addEventListener("click", (event) => event.target.dataset.place && this.#find(event.target.dataset.place));
    this.#mark();
    this.#previewed();
    document.querySelector(".scene-grid").inert = false; // enabled only now, because earlier inputs would be lost
  }

  #fill() {
    for (const field of this.#form.querySelectorAll("[data-of]")) {
      if (field.type === "checkbox") field.checked = this.scene[field.dataset.of];
      else field.value = this.scene[field.dataset.of] ?? "";
    }
    this.positions.show();
    this.milestones.show();
  }

  #typed(field) {
    const name = field.dataset.of;
    if (!name) return;
    if (field.type === "checkbox") this.scene[name] = field.checked;
    else if (field.type === "number") this.scene[name] = field.value === "" ? null : Number(field.value);
    else this.scene[name] = field.value;
    const own = this.#form.querySelector("[data-of=name]");
    if (name === "title" && own && !own.dataset.typed) own.value = this.scene.name = named(field.value);
    if (field === own) own.dataset.typed = "yes"; // the name does not follow the title any more
    this.#changed();
  }

  #changed() {
    const cured = `positions.${this.positions.index}.`;
    if (this.#shown.some(({ place }) => place.startsWith(cured))) this.#show(this.#shown.filter(({ place }) => !place.startsWith(cured)));
    sessionStorage.setItem(this.#key, JSON.stringify({ scene: this.scene, seen: this.seen }));
    this.#mark();
    clearTimeout(this.#timer);
    this.#timer = setTimeout(() => this.#previewed(), PREVIEW_MS);
  }

  #mark() {
    const other = JSON.stringify(this.scene) !== this.#saved;
    document.getElementById("unsaved").hidden = !other;
    document.getElementById("discard").hidden = !other;
  }

  /** Begin again with the task of another simulated bench. */
  #otherBench(name) {
    const address = new URL(location.href);
    address.searchParams.set("bench", name);
    location.assign(address);
  }

  #discard() {
    if (!confirm(t("page.scene.discard", "Discard everything that is not saved?"))) return;
    sessionStorage.removeItem(this.#key);
    location.reload();
  }

  /** Show the operator's cards for the position that is shown. */
  async #previewed() {
    if (!document.getElementById("operator").open) return;
    const place = document.getElementById("preview");
    try {
      const { html } = await post(this.#given.addresses.preview, { scene: this.scene, position: this.positions.index });
      place.innerHTML = html;
    } catch (error) {
      place.textContent = t("page.scene.not_shown", "Not shown: {why}", { why: error.message });
    }
  }

  async #sent() {
    if (this.#save.disabled) return;
    this.#save.disabled = true;
    this.#tell(t("page.scene.saving", "Saving …"), "pressed");
    this.#show([]);
    try {
      const { address, remarks, scene, seen, kept } = await post(location.pathname, { scene: this.scene, seen: this.seen }, { timeout: SAVE_MS });
      sessionStorage.removeItem(this.#key);
      if (address !== location.pathname) {
        sessionStorage.setItem(SAVED, address);
        location.assign(address);
        return;
      }
      Object.assign(this, { scene, seen });
      this.#saved = JSON.stringify(scene);
      this.positions.kept = kept;
      this.#fill();
      this.#mark();
      this.#tell([t("page.scene.saved", "Saved."), ...remarks].join(" "), "accepted");
    } catch (error) {
      if (!(error instanceof RequestFailed)) throw error;
      this.#refused(error);
    } finally {
      this.#save.disabled = false;
    }
  }

  #refused({ message, body }) {
    this.#show(body.faults ?? []);
    this.#tell(body.faults ? t("page.scene.not_saved_faults", "Not saved: see what is wrong. Nothing that you typed is lost.") : t("page.scene.not_saved", "Not saved: {message}", { message }), "refused");
    if (!body.seen) return;
    const over = document.createElement("button");
    Object.assign(over, { type: "button", className: "button", textContent: t("page.scene.overwrite", "Overwrite with mine") });
    over.addEventListener("click", () => {
      this.seen = body.seen;
      this.#sent();
    });
    const look = document.createElement("a");
    Object.assign(look, { href: location.pathname, target: "_blank", rel: "noopener", textContent: t("page.scene.theirs", "Show theirs") });
    this.#said.append(" ", look, " ", over);
  }

  /** List what is wrong, with a button that leads to each place, and mark the fields. */
  #show(faults) {
    this.#shown = faults;
    this.positions.mark(faults.map(({ place }) => place.split(".")).filter(([kind]) => kind === "positions").map(([, index]) => Number(index)));
    for (const field of this.#form.querySelectorAll("[aria-invalid]")) field.removeAttribute("aria-invalid");
    this.#faults.replaceChildren(
      ...faults.map(({ place, text }) => {
        const item = document.createElement("li");
        const way = document.createElement("button");
        Object.assign(way, { type: "button", className: "link", textContent: text });
        way.dataset.place = place;
        item.append(way);
        return item;
      }),
    );
    this.#faults.hidden = !faults.length;
    for (const { place } of faults) this.#field(place)?.setAttribute("aria-invalid", "true");
  }

  #find(place) {
    const [kind, index] = place.split(".");
    if (kind === "positions" && index) this.positions.choose(Number(index));
    (this.#field(place) ?? document.getElementById(kind))?.focus();
  }

  #field(place) {
    const [kind, index, name] = place.split(".");
    if (kind === "milestones" && index) return document.querySelector(`#milestone-rows > :nth-child(${Number(index) + 1}) [data-milestone=${name ?? "text"}]`);
    if (kind === "positions" && Number(index) !== this.positions.index) return null;
    if (kind === "positions" && name === "bench") return document.querySelector("#things input");
    if (kind === "positions") return document.querySelector(`[data-position=${name === "description" ? name : "label"}]`);
    return this.#form.querySelector(`[data-of="${CSS.escape(kind)}"]`);
  }

  #tell(words, kind) {
    this.#said.textContent = words;
    this.#said.dataset.kind = kind;
  }
}

/** Return a short name made from a title, for addresses. */
function named(title) {
  return title.normalize("NFKD").toLowerCase().replace(/[^a-z0-9]+/g, "-").replace(/^-+|-+$/g, "").slice(0, 60);
}

new Editor();
