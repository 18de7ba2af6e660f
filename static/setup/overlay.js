// The wanted layout over a picture of the real bench: live from a camera, the position's reference, or a file. The user drags
// the corners of the area to where they lie in the picture; this browser remembers them for each camera. Then objects can be
// dragged in the picture too. A file of the user's own never leaves the browser.

import { get } from "../site/api.js";
import { escaped, look, moved, n, outline, stepped, THING, things, whereabouts } from "./bench.js";
import { projection, seen } from "./plane.js";
import { t } from "../site/sentences.js";

const LIVE_MS = 700;
const AGAIN_MS = 3000; // wait after a picture that could not be loaded [ms]
const SIDE = 1000; // units of the drawing along each side of the picture
const FIRST = [[0.2, 0.85], [0.8, 0.85], [0.7, 0.25], [0.3, 0.25]]; // left and right near, right and left far corner, as shares of the picture
const NAMES = [t("page.overlay.left_near", "left near corner"), t("page.overlay.right_near", "right near corner"), t("page.overlay.right_far", "right far corner"), t("page.overlay.left_far", "left far corner")];
const ARROWS = { ArrowLeft: [-1, 0], ArrowRight: [1, 0], ArrowUp: [0, -1], ArrowDown: [0, 1] };

export class Overlay {
  #root;
  #sizes;
  #addresses;
  #stations;
  #bench = {};
  #changed = null; // called with each bench that the user makes by moving objects; null if nothing may be moved
  #own = null; // {name, address} of a picture file of the user's own
  #references = [];
  #corners = FIRST;
  #timer = 0;

  constructor(root, { bench, stations, addresses }) {
    this.#root = root;
    this.#sizes = bench;
    this.#stations = stations;
    this.#addresses = addresses;
    this.#camera().addEventListener("change", () => this.#chosen());
    this.#part("again").addEventListener("click", () => this.#put(this.#default()));
    this.#part("file").addEventListener("change", ({ target }) => this.#file(target.files[0]));
    this.#part("density").addEventListener("input", () => this.#draw());
    const svg = this.#part("svg");
    svg.addEventListener("pointerdown", (event) => this.#pressed(event));
    svg.addEventListener("keydown", (event) => this.#key(event));
    root.addEventListener("toggle", () => this.#chosen());
    this.#part("picture").addEventListener("load", ({ target }) => {
      target.hidden = false;
      this.#told("");
    });
    this.#part("picture").addEventListener("error", () => this.#trouble());
  }

  /** Show the position's bench over its references; `changed(bench)` is called when an object was moved. */
  show(bench, references, changed = null) {
    this.#bench = bench ?? {};
    this.#changed = changed;
    if (references !== this.#references) this.#offer(references);
    this.#draw();
  }

  #part(name) {
    return this.#root.querySelector(`[data-overlay=${name}]`);
  }

  #camera() {
    return this.#part("camera");
  }

  #offer(references) {
    this.#references = references;
    const before = this.#camera().value;
    const live = this.#stations.flatMap(({ name, title, cameras }) => cameras.map((camera) => [`live ${name} ${camera}`, t("page.overlay.live", "{title}: {camera}, live", { title, camera })]));
    const kept = references.map(({ station, camera, picture }) => [`kept ${station} ${camera} ${picture}`, t("page.overlay.kept", "{station}: {camera}, reference", { station, camera })]);
    const own = this.#own ? [[`file own ${encodeURIComponent(this.#own.name)}`, this.#own.name]] : [];
    const options = [...own, ...kept, ...live].map(([value, text]) => new Option(text, value));
    this.#camera().replaceChildren(...options);
    if (options.some(({ value }) => value === before)) this.#camera().value = before;
    this.#chosen();
  }

  #file(file) {
    if (!file) return;
    const reader = new FileReader();
    reader.addEventListener("load", () => {
      this.#own = { name: file.name, address: reader.result };
      this.#offer(this.#references);
      this.#camera().selectedIndex = 0;
      this.#chosen();
    });
    reader.readAsDataURL(file);
  }

  #chosen() {
    clearTimeout(this.#timer);
    const [kind, station, camera, picture] = this.#camera().value.split(" ");
    if (!this.#root.open || !station) return;
    const kept = localStorage.getItem(this.#key_of(station, camera));
    this.#corners = kept ? JSON.parse(kept) : this.#default();
    this.#part("picture").alt = kind === "live" ? t("page.overlay.shows", "What {camera} of {station} shows now", { camera, station }) : t("page.overlay.reference", "The reference of {camera} of {station}", { camera, station });
    if (kind === "kept") this.#part("picture").src = picture;
    else if (kind === "file") this.#part("picture").src = this.#own.address;
    else this.#look(this.#address(station, camera));
    this.#draw();
  }

  #address(station, camera) {
    return this.#addresses.live.replace("STATION", encodeURIComponent(station)).replace("CAMERA", encodeURIComponent(camera));
  }

  #look(address) {
    const again = () => {
      if (!this.#root.open) return;
      if (!document.hidden) this.#part("picture").src = `${address}?at=${Date.now()}`;
      this.#timer = setTimeout(again, LIVE_MS);
    };
    again();
  }

  /** Show why there is no picture, and try again a little later. */
  async #trouble() {
    clearTimeout(this.#timer);
    this.#part("picture").hidden = true;
    if (this.#camera().value.startsWith("file ")) {
      this.#told(t("page.overlay.no_picture_file", "{name} is no picture that this browser can show.", { name: this.#own.name }));
      return;
    }
    try {
      await get(this.#part("picture").getAttribute("src"));
    } catch (error) {
      this.#told(t("page.overlay.no_picture", "No picture: {why}", { why: error.message }));
    }
    this.#timer = setTimeout(() => this.#chosen(), AGAIN_MS);
  }

  #told(words) {
    this.#part("said").textContent = words;
  }

  #default() {
    const [kind, station, camera] = this.#camera().value.split(" ");
    const known = kind && this.#stations.find(({ name }) => name === station);
    return known?.corners?.[camera] ?? FIRST;
  }

  #key_of(station, camera) {
    return `eva-corners:${station}:${camera}`;
  }

  #put(corners) {
    const [, station, camera] = this.#camera().value.split(" ");
    this.#corners = corners;
    localStorage.setItem(this.#key_of(station, camera), JSON.stringify(corners));
    this.#draw();
  }

  #draw() {
    const svg = this.#part("svg");
    const { corner, over } = svg.contains(document.activeElement) ? document.activeElement.dataset : {};
    const [left, right, near, far] = this.#sizes.area.map((side) => 1000 * side);
    const h = projection([[left, near], [right, near], [right, far], [left, far]], this.#corners);
    const shape = (points, kind, more = "") => `<polygon class="${kind}" ${more} points="${points.map((point) => seen(h, point).map((share) => n(SIDE * share)).join(" ")).join(", ")}"/>`;
    const movable = (thing) => `data-over="${escaped(thing.key)}"${this.#changed ? ` tabindex="0" role="button" aria-roledescription="${escaped(THING)}" aria-label="${escaped(whereabouts(thing))}"` : ""}`;
    const laid = h ? [shape([[left, near], [right, near], [right, far], [left, far]], "area"), ...things(this.#bench, this.#sizes).map((thing) => shape(outline(thing), `over over-${look(thing.kind, thing.round)}`, movable(thing)))] : [];
    const handles = this.#corners.map(
      ([x, y], index) => `<circle class="corner" data-corner="${index}" cx="${n(SIDE * x)}" cy="${n(SIDE * y)}" r="14" tabindex="0" role="button" aria-label="${escaped(t("page.overlay.corner", "{corner} of the area", { corner: NAMES[index] }))}"/>`,
    );
    svg.toggleAttribute("data-movable", Boolean(this.#changed && h));
    svg.innerHTML = `<g opacity="${this.#part("density").value}">${laid.join("")}</g>${handles.join("")}`;
    const focused = corner ? `[data-corner="${corner}"]` : over && `[data-over="${CSS.escape(over)}"]`;
    if (focused) svg.querySelector(focused)?.focus({ preventScroll: true });
  }

  #cornered(index, x, y) {
    const inside = (share) => Math.min(Math.max(share, 0), 1);
    this.#put(this.#corners.map((corner, other) => (other === index ? [inside(x), inside(y)] : corner)));
  }

  #thing(key) {
    return things(this.#bench, this.#sizes).find((one) => one.key === key);
  }

  /** Return a function that lets an object follow the pointer over the plane of the table. */
  #following(thing) {
    const [left, right, near, far] = this.#sizes.area.map((side) => 1000 * side);
    const plane = projection(this.#corners, [[left, near], [right, near], [right, far], [left, far]]);
    let from = null;
    return (x, y) => {
      const at = seen(plane, [x, y]);
      from ??= at;
      const [to, aside] = [thing.x + at[0] - from[0], thing.y + at[1] - from[1]].map(Math.round);
      this.#changed(moved(this.#bench, thing, { x: to, y: aside }, this.#sizes));
    };
  }

  #pressed(event) {
    const [corner, over] = [event.target.closest("[data-corner]"), event.target.closest("[data-over]")];
    if (event.button !== 0 || !(corner || (over && this.#changed))) return;
    event.preventDefault();
    const svg = this.#part("svg");
    const index = Number(corner?.dataset.corner);
    (corner ?? over).focus({ preventScroll: true });
    const move = corner ? (x, y) => this.#cornered(index, x, y) : this.#following(this.#thing(over.dataset.over));
    const drag = ({ clientX, clientY }) => {
      const { left, top, width, height } = svg.getBoundingClientRect();
      move((clientX - left) / width, (clientY - top) / height);
    };
    if (over) drag(event); // sets where the drag starts
    const end = () => {
      svg.removeEventListener("pointermove", drag);
      for (const kind of ["pointerup", "pointercancel"]) svg.removeEventListener(kind, end);
    };
    svg.setPointerCapture(event.pointerId);
    svg.addEventListener("pointermove", drag);
    for (const kind of ["pointerup", "pointercancel"]) svg.addEventListener(kind, end);
  }

  #key(event) {
    const { corner: index, over } = event.target.dataset;
    const thing = this.#changed && over && this.#thing(over);
    const change = thing && stepped(thing, event);
    const along = index !== undefined && ARROWS[event.key];
    if (!change && !along) return;
    event.preventDefault();
    if (change) {
      this.#changed(moved(this.#bench, thing, change, this.#sizes));
      return;
    }
    const step = event.shiftKey ? 0.002 : 0.01;
    const [x, y] = this.#corners[index];
    this.#cornered(Number(index), x + step * along[0], y + step * along[1]);
  }
}
