// The wanted layout over a picture of the real bench: live from a camera, or the reference of the position. The corners of
// the area are dragged to where they lie in the picture; this browser remembers them for each camera.

import { get } from "../site/api.js";
import { n, outline, things } from "./bench.js";
import { projection, seen } from "./plane.js";

const LIVE_MS = 700;
const AGAIN_MS = 3000; // after a picture that did not come
const SIDE = 1000; // units of the drawing along each side of the picture
const FIRST = [[0.2, 0.85], [0.8, 0.85], [0.7, 0.25], [0.3, 0.25]]; // left and right near, right and left far: shares
const NAMES = ["left near corner", "right near corner", "right far corner", "left far corner"];
const ARROWS = { ArrowLeft: [-1, 0], ArrowRight: [1, 0], ArrowUp: [0, -1], ArrowDown: [0, 1] };

export class Overlay {
  #root;
  #sizes;
  #addresses;
  #stations;
  #bench = {};
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

  /** The position that is looked at: its bench, and the references that there are of it. */
  show(bench, references) {
    this.#bench = bench ?? {};
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
    const live = this.#stations.flatMap(({ name, title, cameras }) => cameras.map((camera) => [`live ${name} ${camera}`, `${title}: ${camera}, live`]));
    const kept = references.map(({ station, camera, picture }) => [`kept ${station} ${camera} ${picture}`, `${station}: ${camera}, reference`]);
    const options = [...kept, ...live].map(([value, text]) => new Option(text, value));
    this.#camera().replaceChildren(...options);
    if (options.some(({ value }) => value === before)) this.#camera().value = before;
    this.#chosen();
  }

  #chosen() {
    clearTimeout(this.#timer);
    const [kind, station, camera, picture] = this.#camera().value.split(" ");
    if (!this.#root.open || !station) return;
    const kept = localStorage.getItem(this.#key_of(station, camera));
    this.#corners = kept ? JSON.parse(kept) : this.#default();
    this.#part("picture").alt = `${kind === "live" ? "What" : "The reference of"} ${camera} of ${station}${kind === "live" ? " shows now" : ""}`;
    if (kind === "kept") this.#part("picture").src = picture;
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

  /** Say why there is no picture, and look again a little later. */
  async #trouble() {
    clearTimeout(this.#timer);
    this.#part("picture").hidden = true;
    try {
      await get(this.#part("picture").getAttribute("src"));
    } catch (error) {
      this.#told(`No picture: ${error.message}`);
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
    const focused = document.activeElement?.dataset?.corner;
    const [left, right, near, far] = this.#sizes.area.map((side) => 1000 * side);
    const h = projection([[left, near], [right, near], [right, far], [left, far]], this.#corners);
    const shape = (points, kind) => `<polygon class="${kind}" points="${points.map((point) => seen(h, point).map((share) => n(SIDE * share)).join(" ")).join(", ")}"/>`;
    const laid = h ? [shape([[left, near], [right, near], [right, far], [left, far]], "area"), ...things(this.#bench, this.#sizes).map((thing) => shape(outline(thing), `over over-${thing.kind}`))] : [];
    const handles = this.#corners.map(
      ([x, y], index) => `<circle class="corner" data-corner="${index}" cx="${n(SIDE * x)}" cy="${n(SIDE * y)}" r="14" tabindex="0" role="button" aria-label="${NAMES[index]} of the area"/>`,
    );
    svg.innerHTML = `<g opacity="${this.#part("density").value}">${laid.join("")}</g>${handles.join("")}`;
    if (focused) svg.querySelector(`[data-corner="${focused}"]`)?.focus({ preventScroll: true });
  }

  #moved(index, x, y) {
    const inside = (share) => Math.min(Math.max(share, 0), 1);
    this.#put(this.#corners.map((corner, other) => (other === index ? [inside(x), inside(y)] : corner)));
  }

  #pressed(event) {
    const corner = event.target.closest("[data-corner]");
    if (!corner || event.button !== 0) return;
    event.preventDefault();
    const svg = this.#part("svg");
    const index = Number(corner.dataset.corner);
    corner.focus({ preventScroll: true });
    const drag = ({ clientX, clientY }) => {
      const { left, top, width, height } = svg.getBoundingClientRect();
      this.#moved(index, (clientX - left) / width, (clientY - top) / height);
    };
    const end = () => {
      svg.removeEventListener("pointermove", drag);
      for (const kind of ["pointerup", "pointercancel"]) svg.removeEventListener(kind, end);
    };
    svg.setPointerCapture(event.pointerId);
    svg.addEventListener("pointermove", drag);
    for (const kind of ["pointerup", "pointercancel"]) svg.addEventListener(kind, end);
  }

  #key(event) {
    const along = ARROWS[event.key];
    const index = event.target.dataset.corner;
    if (!along || index === undefined) return;
    event.preventDefault();
    const step = event.shiftKey ? 0.002 : 0.01;
    const [x, y] = this.#corners[index];
    this.#moved(Number(index), x + step * along[0], y + step * along[1]);
  }
}
