// The positions of a scene: thumbnails, and the present position on the stage and in numbers.

import { escaped, look, nameOf, placed, problems, things, thumbnail, windowOf, without } from "./bench.js";
import { Generator } from "./generator.js";
import { Stage } from "./stage.js";
import { t } from "../site/sentences.js";

const NUMBERS = [["x", "x mm"], ["y", "y mm"], ["yaw", t("page.positions.turn", "turn °")], ["width", t("page.positions.width", "width mm")], ["depth", t("page.positions.depth", "depth mm")]];
// Other titles are the bench's own.
const FACTORS = {
  light: t("page.positions.light", "Light"),
  friction: t("page.positions.friction", "Friction, times"),
  mass: t("page.positions.mass", "Mass of blocks, times"),
  camera_x: t("page.positions.camera_x", "Camera to the right, m"),
  camera_y: t("page.positions.camera_y", "Camera away, m"),
  camera_z: t("page.positions.camera_z", "Camera up, m"),
  distractors: t("page.positions.distractors", "Further blocks"),
};
const OBJECT = [0, 0.3, 0, 0.08, 0.08]; // m, m, degrees, m, m

export class Positions {
  index = 0;
  #editor;
  #bench;
  #references;
  #may;
  #changed;
  #overlay;
  #stage;
  #view; // view box of the thumbnails
  #wrong = []; // indices of positions that cannot be saved
  #generator;
  #part = (id) => document.getElementById(id);

  constructor(editor, { bench, kept, references, may, changed, overlay }) {
    Object.assign(this, { kept });
    this.#editor = editor;
    this.#bench = bench;
    this.#references = references;
    this.#may = may;
    this.#changed = changed;
    this.#overlay = overlay;
    const kinds = Object.keys(bench.objects).map((key) => new Option(t("page.positions.simulated", "the simulated {name}", { name: nameOf(key, bench) }), key));
    this.#part("add-kind")?.append(...kinds);
    this.#stage = new Stage(this.#part("stage"), bench, (laid) => this.#laid(laid));
    this.#part("thumbnails").addEventListener("click", (event) => this.#pressed(event));
    this.#part("position").addEventListener("input", (event) => this.#typed(event.target));
    this.#part("position").addEventListener("click", (event) => event.target.closest("[data-take-away]") && this.#taken(event.target.closest("[data-thing-row]").dataset.thingRow));
    const choices = Object.entries(bench.choices).map(([key, choice]) => this.#choice(key, choice));
    const factors = Object.entries(bench.factors).map(([key, factor]) => this.#factor(key, factor));
    this.#part("factors").innerHTML = [...choices, ...factors].join("");
    // A bench with a program of its own has nothing to lay out.
    for (const part of document.querySelectorAll("[data-laid-out]")) part.hidden = bench.program;
    this.#part("factors-box").open = choices.length > 0;
    for (const [id, act] of Object.entries({
      "add-position": () => this.#added(),
      "remove-position": () => this.#removed(),
      "add-thing": () => this.#thing(),
    })) this.#part(id)?.addEventListener("click", act);
    const form = this.#part("generator");
    if (form) this.#generator = new Generator(form, bench, { bench: () => this.#one?.bench, draw: () => this.#draw(), keep: (...made) => this.#keep(...made) });
  }

  get #all() {
    return this.#editor.scene.positions;
  }

  get #one() {
    return this.#all[this.index];
  }

  get #still() {
    return !this.#may || Boolean(this.kept[this.#one?.id]);
  }

  /** Mark the thumbnails of positions that cannot be saved as they are. */
  mark(wrong) {
    this.#wrong = wrong;
    this.#thumbnails();
  }

  choose(index) {
    this.index = index;
    this.show();
  }

  show() {
    this.index = Math.min(this.index, Math.max(0, this.#all.length - 1));
    this.#thumbnails();
    this.#numbers(true);
    this.#draw();
    this.#generator?.offer();
    const pictures = this.#references[this.#one?.id] ?? [];
    this.#part("references").innerHTML = pictures
      .map(({ station, camera, picture, page }) => `<li class="small"><a href="${page}"><img src="${picture}" alt="" width="120" height="90">${escaped(t("page.positions.camera_of", "{camera} of {station}", { camera, station }))}</a></li>`)
      .join("");
    this.#part("references-title").hidden = !pictures.length;
  }

  #draw() {
    this.#stage.show(this.#one?.bench, { still: this.#still, ghosts: this.#generator?.made ?? [], all: this.#all.map(({ bench }) => bench) });
    this.#told();
  }

  #told() {
    const said = this.#one ? problems(this.#one.bench, this.#bench) : [];
    this.#part("bench-problems").replaceChildren(...said.map((words) => Object.assign(document.createElement("li"), { textContent: words })));
    const moved = (bench) => {
      this.#laid(bench);
      this.#draw();
    };
    this.#overlay.show(this.#one?.bench, this.#references[this.#one?.id] ?? [], this.#still ? null : moved);
  }

  #thumbnails() {
    const view = (this.#view = windowOf(this.#all.map(({ bench }) => bench), this.#bench, 15));
    const list = this.#part("thumbnails");
    const focused = list.contains(document.activeElement);
    list.innerHTML = this.#all
      .map(({ id, number, label, bench }, index) => {
        const name = `${t("page.positions.position", "Position {n}", { n: number })}${label ? ` · ${label}` : ""}`;
        return `<li><button type="button" class="position-pick" data-index="${index}"${this.#wrong.includes(index) ? " data-wrong" : ""}${index === this.index ? ' aria-current="true"' : ""}>${thumbnail(bench, this.#bench, view, "", this.#references[id]?.[0].picture)}<span class="clip">${escaped(name)}</span></button></li>`;
      })
      .join("");
    if (focused) list.querySelector("[aria-current]")?.focus();
  }

  #pressed(event) {
    const button = event.target.closest("[data-index]");
    if (button) this.choose(Number(button.dataset.index));
  }

  /** Show label, description and the numbers of all objects; with `whole`, also in fields that the user may be editing. */
  #numbers(whole) {
    const one = this.#one;
    const why = this.kept[one?.id];
    this.#part("position").hidden = !one;
    this.#part("position-kept").hidden = !why;
    this.#part("position-kept").textContent = why ? t("page.positions.kept", "Position {n} stays as it is, because of {why}. Add a position: it begins like this one.", { n: one.number, why }) : "";
    if (!one) return;
    this.#part("position-title").textContent = t("page.positions.position", "Position {n}", { n: one.number });
    for (const name of ["label", "description"]) {
      const field = this.#part("position").querySelector(`[data-position=${name}]`);
      if (whole) field.value = one[name];
      field.readOnly = this.#still;
    }
    for (const field of this.#part("factors").querySelectorAll("input")) {
      const value = one.bench?.factors?.[field.dataset.factor];
      field.readOnly = this.#still;
      if (field !== document.activeElement) field.value = value ?? "";
    }
    for (const field of this.#part("factors").querySelectorAll("select")) {
      field.value = one.bench?.choices?.[field.dataset.choice] ?? this.#bench.choices[field.dataset.choice].usual;
      field.disabled = this.#still;
    }
    this.#part("factors-box").open ||= Object.keys(one.bench?.factors ?? {}).length > 0;
    for (const id of ["add-thing", "add-kind", "remove-position"]) if (this.#part(id)) this.#part(id).disabled = this.#still;
    const all = things(one.bench, this.#bench);
    const rows = this.#part("things");
    const keys = [...rows.children].map((row) => row.dataset.thingRow).join("\n");
    if (keys !== all.map(({ key }) => key).join("\n")) rows.innerHTML = all.map((thing) => this.#row(thing)).join("");
    all.forEach((thing, index) => {
      for (const [name] of NUMBERS) {
        const field = rows.children[index].querySelector(`[data-number=${name}]`);
        if (!field) continue;
        field.readOnly = this.#still;
        if (field !== document.activeElement) field.value = String(Math.round(10 * thing[name]) / 10);
      }
      const away = rows.children[index].querySelector("[data-take-away]");
      if (away) away.disabled = this.#still;
    });
    this.#part("no-things").hidden = all.length > 0;
  }

  #row({ key, name, kind, round }) {
    const has = kind === "object" ? 5 : round ? 2 : 3;
    const fields = NUMBERS.slice(0, has).map(
      ([field, words]) => `<label class="field small"><span class="label">${words}</span><input type="number" step="1" data-number="${field}" aria-label="${escaped(t("page.positions.number", "{name}: {words}", { name, words }))}"></label>`,
    );
    const away = this.#may ? `<button type="button" class="button button-quiet" data-take-away aria-label="${escaped(t("page.positions.take_away_one", "Take away {name}", { name }))}">${escaped(t("page.positions.take_away", "Take away"))}</button>` : "";
    return `<li class="thing-row" data-thing-row="${escaped(key)}"><span class="row spread line"><span class="strong thing-key thing-key-${look(kind, round)}">${escaped(name)}</span>${away}</span><span class="thing-numbers">${fields.join("")}</span></li>`;
  }

  #factor(key, { title, usual, low, high }) {
    const step = key === "distractors" ? 1 : "any";
    return `<label class="field small"><span class="label">${escaped(FACTORS[key] ?? title)}</span><input type="number" data-factor="${key}" min="${low}" max="${high}" step="${step}" placeholder="${usual}"></label>`;
  }

  #choice(key, { title, values }) {
    const options = values.map((value) => `<option>${escaped(value)}</option>`);
    return `<label class="field small"><span class="label">${escaped(title)}</span><select data-choice="${key}">${options.join("")}</select></label>`;
  }

  #laid(bench) {
    this.#one.bench = bench;
    this.#numbers(false);
    const picture = this.#part("thumbnails").children[this.index].querySelector("svg"); // the other thumbnails do not change
    picture.outerHTML = thumbnail(bench, this.#bench, this.#view, "", this.#references[this.#one.id]?.[0].picture);
    this.#told();
    this.#changed();
  }

  #typed(field) {
    const { position, number, factor, choice } = field.dataset;
    if (choice) this.#laid({ ...this.#one.bench, choices: { ...this.#one.bench?.choices, [choice]: field.value } });
    if (factor && field.validity.valid) {
      const { [factor]: _, ...others } = this.#one.bench?.factors ?? {};
      const factors = field.value === "" ? others : { ...others, [factor]: Number(field.value) };
      const { factors: __, ...bench } = this.#one.bench ?? {};
      this.#laid(Object.keys(factors).length ? { ...bench, factors } : bench);
    }
    if (position) {
      this.#one[position] = field.value;
      this.#thumbnails();
      this.#changed();
    } else if (number && field.value !== "" && Number.isFinite(Number(field.value))) {
      const thing = things(this.#one.bench, this.#bench).find(({ key }) => key === field.closest("[data-thing-row]").dataset.thingRow);
      this.#laid(placed(this.#one.bench, thing, { [number]: Number(field.value) }));
      this.#draw();
    }
  }

  #taken(key) {
    const thing = things(this.#one.bench, this.#bench).find((one) => one.key === key);
    this.#laid(without(this.#one.bench, thing));
    this.#draw();
    this.#part("add-thing").focus();
  }

  /** Add an object: one of the simulated bench, or one with a name. */
  #thing() {
    const kind = this.#part("add-kind").value;
    const name = this.#part("thing-name").value.trim();
    const bench = this.#one.bench ?? {};
    if (kind === "object" && !name) {
      this.#part("thing-name").focus();
      return;
    }
    if (kind === "object" ? bench.objects?.[name] : bench[kind]) {
      this.#tell(t("page.positions.there", "{name} is there already", { name: kind === "object" ? name : nameOf(kind, this.#bench) }));
      return;
    }
    const more = kind === "object" ? { objects: { ...bench.objects, [name]: OBJECT } } : { [kind]: this.#bench.objects[kind].example };
    this.#part("thing-name").value = "";
    this.#laid({ ...bench, ...more });
    this.#draw();
    this.#generator?.offer();
  }

  #tell(words) {
    this.#part("positions-said").textContent = words;
  }

  /** Add a position like the present one. */
  #added() {
    const like = this.#one ?? { label: "", description: "", bench: null };
    this.#all.push({ ...structuredClone(like), id: null, label: "", number: 0 });
    this.#numbered();
    this.choose(this.#all.length - 1);
    this.#tell(t("page.positions.added", "Position {n} is added: move what should be elsewhere", { n: this.#one.number }));
    this.#changed();
  }

  #removed() {
    const [{ number }] = this.#all.splice(this.index, 1);
    this.#numbered();
    this.show();
    this.#tell(t("page.positions.removed", "Position {n} is removed", { n: number }));
    this.#changed();
  }

  /** Number the positions that are not saved yet, after those that are. */
  #numbered() {
    let number = Math.max(0, ...this.#all.filter(({ id }) => id).map((one) => one.number));
    for (const one of this.#all) if (!one.id) one.number = number += 1;
  }

  /** Add generated positions; with `replace`, they replace all positions that may be removed. */
  #keep(benches, replace) {
    const { description } = this.#one;
    if (replace) this.#editor.scene.positions = this.#all.filter(({ id }) => this.kept[id]);
    const first = this.#all.length;
    this.#all.push(...benches.map((bench) => ({ id: null, number: 0, label: "", description, bench })));
    this.#numbered();
    this.choose(first);
    this.#tell(benches.length === 1 ? t("page.positions.one_kept", "1 position is kept") : t("page.positions.many_kept", "{n} positions are kept", { n: benches.length }));
    this.#changed();
  }
}
