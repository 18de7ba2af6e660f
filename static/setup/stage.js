// The bench from above, with objects that can be moved and turned by mouse, touch and keys, in mm and degrees.

import { box, drawn, ground, moved, n, stepped, THING, things, turned, whereabouts, windowOf } from "./bench.js";
import { t } from "../site/sentences.js";

const HANDLE = 26; // distance [mm] from an object's far edge to the handle that turns it

export class Stage {
  #svg;
  #sizes;
  #changed;
  #bench = {};
  #still = true;
  #ghosts = [];
  #view;
  #chosen = ""; // key of the object whose handle is shown

  /** `changed(bench)` is called with each bench that the user makes by moving an object. */
  constructor(svg, sizes, changed) {
    this.#svg = svg;
    this.#sizes = sizes;
    this.#changed = changed;
    svg.addEventListener("pointerdown", (event) => this.#pressed(event));
    svg.addEventListener("keydown", (event) => this.#key(event));
    svg.addEventListener("focusin", (event) => this.#choose(event.target.closest("[data-thing]")?.dataset.thing));
  }

  /**
   * Show this bench and, faintly, those of `ghosts`; with `still`, nothing can be moved. `all` are benches that fit in the view
   * too.
   */
  show(bench, { still = false, ghosts = this.#ghosts, all = [] } = {}) {
    this.#bench = bench ?? {};
    this.#still = still;
    this.#ghosts = ghosts;
    this.#view = windowOf([this.#bench, ...all, ...ghosts], this.#sizes);
    this.#draw();
  }

  #draw() {
    const focused = this.#svg.contains(document.activeElement) ? document.activeElement.dataset.thing : "";
    const { sides, reach } = this.#sizes;
    const circles = sides.map(([x, y]) => `<circle class="reach" cx="${n(1000 * x)}" cy="${n(-1000 * y)}" r="${n(1000 * reach)}"/>`);
    const faint = this.#ghosts.flatMap((bench) => things(bench, this.#sizes).map((thing) => drawn(thing, { attributes: "data-ghost" })));
    const own = things(this.#bench, this.#sizes).map((thing) => this.#movable(thing));
    const arms = `<text class="side" x="0" y="${n(this.#view.y + this.#view.height - 10)}">${attribute(t("page.stage.arms", "the arms are on this side"))}</text>`;
    this.#svg.setAttribute("viewBox", box(this.#view));
    this.#svg.innerHTML = ground(this.#sizes, this.#view) + circles.join("") + arms + faint.join("") + own.join("");
    if (focused) this.#svg.querySelector(`[data-thing="${CSS.escape(focused)}"]`)?.focus({ preventScroll: true });
  }

  #movable(thing) {
    const { key, name, round, depth } = thing;
    const label = whereabouts(thing);
    const named = `data-thing="${attribute(key)}"`;
    if (this.#still) return drawn(thing, { attributes: `${named} role="img" aria-label="${attribute(label)}"`, words: name });
    const far = -depth / 2 - HANDLE;
    const handle = !round && key === this.#chosen ? `<path class="turn-line" d="M0 0V${n(far)}"/><circle class="turn" data-turn cy="${n(far)}" r="9"/>` : "";
    const attributes = `${named} tabindex="0" role="button" aria-roledescription="${attribute(THING)}" aria-label="${attribute(label)}"`;
    return drawn(thing, { attributes, inside: handle, words: name });
  }

  #choose(key) {
    if (!key || key === this.#chosen) return;
    this.#chosen = key;
    this.#draw();
  }

  #thing(key) {
    return things(this.#bench, this.#sizes).find((thing) => thing.key === key);
  }

  #put(thing, change) {
    this.#bench = moved(this.#bench, thing, change, this.#sizes);
    this.#draw();
    this.#changed(this.#bench);
  }

  #at(event) {
    const point = new DOMPoint(event.clientX, event.clientY).matrixTransform(this.#svg.getScreenCTM().inverse());
    return { x: point.x, y: -point.y };
  }

  #pressed(event) {
    const pressed = event.target.closest("[data-thing]");
    if (!pressed || this.#still || event.button !== 0) return;
    event.preventDefault();
    const { thing: key } = pressed.dataset;
    const [before, from] = [this.#thing(key), this.#at(event)];
    const turning = event.target.closest("[data-turn]");
    pressed.focus({ preventScroll: true });
    const drag = (later) => {
      const to = this.#at(later);
      if (turning) this.#put(before, { yaw: turned(Math.round((Math.atan2(to.y - before.y, to.x - before.x) * 180) / Math.PI - 90)) });
      else this.#put(before, { x: Math.round(before.x + to.x - from.x), y: Math.round(before.y + to.y - from.y) });
    };
    const end = (last) => {
      this.#svg.removeEventListener("pointermove", drag);
      for (const kind of ["pointerup", "pointercancel"]) this.#svg.removeEventListener(kind, end);
      if (last.type === "pointercancel") this.#put(before, before);
    };
    this.#svg.setPointerCapture(event.pointerId);
    this.#svg.addEventListener("pointermove", drag);
    for (const kind of ["pointerup", "pointercancel"]) this.#svg.addEventListener(kind, end);
  }

  #key(event) {
    const thing = this.#thing(event.target.closest("[data-thing]")?.dataset.thing);
    const change = thing && !this.#still && stepped(thing, event);
    if (!change) return;
    event.preventDefault();
    this.#put(thing, change);
  }
}

function attribute(text) {
  return text.replace(/[&"<]/g, (sign) => `&#${sign.charCodeAt(0)};`);
}
