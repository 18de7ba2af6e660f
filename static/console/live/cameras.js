// Live pictures of the cameras, each from one JPEG; an old picture turns grey and shows its age.

import { cameraSource, cameraProblem } from "./camera_text.js";
import { formatAge } from "./labels.js";
import { t } from "../../site/sentences.js";

const STALE_S = 0.5; // age [s] from which a picture is old: the runtime's own limit for pictures
const SLOW = 0.8; // share of the fastest camera's rate below which a camera is slow
const WINDOW_MS = 2000;
const TELL_MS = 500;
const NONE = new Uint8Array(0);

class Camera {
  constructor(figure) {
    this.figure = figure;
    this.name = figure.dataset.camera;
    this.canvas = figure.querySelector("canvas");
    this.context = this.canvas.getContext("2d");
    this.rateText = figure.querySelector(".camera-rate");
    this.freshText = figure.querySelector(".camera-fresh");
    this.ageText = figure.querySelector(".camera-age");
    this.troubleText = figure.appendChild(document.createElement("p"));
    this.troubleText.className = "camera-trouble";
    this.troubleText.hidden = true;
    this.canvas.addEventListener("contextlost", () => this.forget());
    this.canvas.addEventListener("contextrestored", () => this.forget()); // a restored canvas is blank
    this.forget();
    this.drawn = []; // times of the last draws [ms]
    this.drawnAny = false;
  }

  /** Forget all pictures: the canvas shows nothing. */
  forget() {
    this.decoded = NONE; // the JPEG that was decoded last
    this.shown = NONE; // the JPEG that is on the screen
    this.capturedAt = -Infinity; // on this page's clock [ms]
  }

  draw(picture, bytes, seconds) {
    this.shown = bytes;
    if (this.canvas.width !== picture.width || this.canvas.height !== picture.height) {
      this.canvas.width = picture.width;
      this.canvas.height = picture.height;
    }
    this.context.drawImage(picture, 0, 0);
    picture.close();
    this.confirm(seconds);
  }

  /** Take in that the last decoded picture, of these bytes, was captured again `seconds` ago. */
  again(bytes, seconds) {
    if (this.shown === bytes) this.confirm(seconds);
    else this.tell(performance.now()); // it is not a picture, or not drawn yet
  }

  /** Record that the picture on the screen was captured `seconds` ago. */
  confirm(seconds) {
    const now = performance.now();
    if (this.context.isContextLost?.()) {
      this.forget();
    } else {
      this.capturedAt = now - seconds * 1000;
      this.drawn.push(now);
      this.drawnAny = true;
    }
    this.tell(now);
  }

  /** Show age and staleness at `now` [ms], without a new picture. */
  tell(now) {
    const seconds = (now - this.capturedAt) / 1000;
    const stale = !(seconds < STALE_S);
    this.figure.toggleAttribute("data-stale", stale);
    const text = Number.isFinite(seconds) && stale ? t("page.common.old", "{age} old", { age: formatAge(seconds) }) : "";
    if (this.ageText.textContent !== text) this.ageText.textContent = text;
    if (stale) this.freshText.textContent = "";
  }

  /** Return how many pictures per second this page draws. */
  shownRate(now) {
    while (this.drawn.length && now - this.drawn[0] > WINDOW_MS) this.drawn.shift();
    return (this.drawn.length * 1000) / WINDOW_MS;
  }

  /**
   * Show the condition of a station's own camera from the runtime's report `told`, at the runtime's `clock` [s]; without a
   * report, show nothing.
   */
  health(told, clock) {
    const wrong = cameraProblem(told, clock);
    const text = wrong ? t("page.common.why", "{name}: {why}", { name: wrong.word, why: wrong.reason }) : "";
    if (this.troubleText.textContent !== text) this.troubleText.textContent = text;
    this.troubleText.hidden = !text;
    this.figure.title = told ? cameraSource(told) : "";
  }

  rate(measured, captured, fastest, now) {
    const shown = this.shownRate(now);
    const known = Number.isFinite(measured);
    const slow = known && measured < SLOW * fastest;
    const text = known ? `${measured.toFixed(1)} Hz${slow ? " !" : ""}` : this.drawnAny ? t("page.cameras.rate_unknown", "rate unknown") : t("page.cameras.opening", "no picture yet");
    const fresh = known && !this.figure.hasAttribute("data-stale") && Number.isFinite(captured);
    this.freshText.textContent = fresh ? t("page.common.ago", "{age} ago", { age: formatAge(captured) }) : "";
    if (this.rateText.textContent !== text) this.rateText.textContent = text;
    this.rateText.toggleAttribute("data-slow", slow);
    this.rateText.title = known
      ? t("page.cameras.rates", "The camera delivers {rate} pictures per second; this page shows {shown}.", { rate: measured.toFixed(1), shown: shown.toFixed(1) })
      : t("page.cameras.no_rate", "The camera delivers no pictures per second; this page shows {shown}.", { shown: shown.toFixed(1) });
  }
}

/**
 * Return true if two JPEGs are equal. A simulated camera of a bench at rest sends the same JPEG again and again, and decoding
 * is most of the work.
 */
function equal(one, other) {
  return one.length > 0 && one.length === other.length && one.every((byte, at) => byte === other[at]);
}

export class Cameras {
  #cameras = new Map();
  #told = 0;

  constructor(store) {
    for (const figure of document.querySelectorAll("[data-camera]")) {
      const camera = new Camera(figure);
      this.#cameras.set(camera.name, camera);
    }
    store.on("snapshot", ({ link, facts, clock }) => {
      if (facts?.cameras) this.#keep(facts.cameras);
      this.#measured(link, clock);
    });
    store.on("second", () => store.fresh || this.#measured({ rates: {}, ages: {} }));
    setInterval(() => this.#tell(), 100);
  }

  get streams() {
    return [...this.#cameras.keys()].map((name) => `camera/${name}`);
  }

  /** Decode the pictures of a frame; resolve to a function that draws them. */
  async prepare(frame) {
    const ready = [];
    for (const [stream, place] of Object.entries(frame.header.streams)) {
      const camera = this.#cameras.get(stream.slice("camera/".length));
      if (!stream.startsWith("camera/") || !camera) continue;
      const bytes = frame.bytes(place);
      const before = camera.decoded;
      if (equal(bytes, before)) {
        ready.push(() => camera.again(before, place.age ?? 0));
        continue;
      }
      camera.decoded = bytes;
      const blob = new Blob([bytes], { type: place.mime });
      ready.push(
        createImageBitmap(blob).then(
          (picture) => () => camera.draw(picture, bytes, place.age ?? 0),
          () => () => camera.tell(performance.now()), // not a picture: the previous one stays and its age grows
        ),
      );
    }
    const draws = await Promise.all(ready);
    return () => draws.forEach((draw) => draw());
  }

  /** Hide cameras that the station does not have. */
  #keep(names) {
    for (const camera of this.#cameras.values()) camera.figure.hidden = !names.includes(camera.name);
    const shown = [...this.#cameras.values()].filter(({ figure }) => !figure.hidden).length;
    document.querySelector(".station").style.setProperty("--cameras", Math.max(1, shown));
  }

  #measured({ rates, ages, cameras = {} }, clock = NaN) {
    const now = performance.now();
    if (now - this.#told < TELL_MS) return; // figures that change too often cannot be read
    this.#told = now;
    const fastest = Math.max(0, ...[...this.#cameras.keys()].map((name) => rates[name] ?? 0));
    for (const camera of this.#cameras.values()) {
      camera.rate(rates[camera.name] ?? NaN, ages[camera.name] ?? NaN, fastest, now);
      camera.health(cameras[camera.name], clock);
    }
  }

  #tell() {
    const now = performance.now();
    for (const camera of this.#cameras.values()) camera.tell(now);
  }
}
