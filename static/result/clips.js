// Short clips of videos: only those in view are loaded, and play in a loop; stills are shown if no motion is wanted.

import { t } from "../site/sentences.js";

const NEAR = "200px"; // margin around the screen, so that a clip is loaded before it scrolls into view
const END_S = 0.04;
const LONGEST_MS = 8000; // longest time for which printing waits for a picture

export class Clips {
  #videos;
  #playing;
  #seen = new Set();

  /** `videos` are elements with data-src, data-begin and data-end [s]; with data-still, only that moment [s] is shown. */
  constructor(videos, playing = false) {
    this.#videos = [...videos];
    this.#playing = playing;
    const observer = new IntersectionObserver((entries) => entries.forEach((entry) => this.#turn(entry)), { rootMargin: NEAR });
    for (const video of this.#videos) {
      for (const kind of ["timeupdate", "pause", "ended"]) video.addEventListener(kind, () => this.#again(video));
      video.addEventListener("error", () => video.hasAttribute("src") && this.#broken(video));
      observer.observe(video);
    }
  }

  get playing() {
    return this.#playing;
  }

  set playing(playing) {
    this.#playing = playing;
    for (const video of this.#seen) this.#show(video);
  }

  /** Pause all clips for printing; resolve when each shows a picture or has failed, for each after LONGEST_MS at the latest. */
  stills() {
    this.playing = false;
    return Promise.all(
      this.#videos.map((video) => {
        this.#show(video);
        if (video.readyState >= HTMLMediaElement.HAVE_CURRENT_DATA && !video.seeking) return null;
        const done = new Promise((resolve) => {
          for (const kind of ["loadeddata", "seeked", "error"]) video.addEventListener(kind, resolve, { once: true });
        });
        return Promise.race([done, new Promise((resolve) => setTimeout(resolve, LONGEST_MS))]);
      }),
    );
  }

  #turn({ target, isIntersecting }) {
    if (isIntersecting) {
      this.#seen.add(target);
      this.#show(target);
    } else if (this.#seen.delete(target)) {
      target.removeAttribute("src");
      target.load(); // browsers limit the number of players
    }
  }

  #show(video) {
    const { src, begin, end, still } = video.dataset;
    const plays = this.#playing && still === undefined;
    const moment = still ?? (Number(begin) + Number(end)) / 2;
    if (!video.hasAttribute("src")) {
      video.preload = "auto";
      video.src = plays ? `${src}#t=${begin},${end}` : `${src}#t=${moment}`;
    }
    if (plays) video.play().catch(() => {}); // a clip that has left the screen meanwhile is not played
    else video.pause();
  }

  /** Start a clip again from its beginning when it has reached its end. */
  #again(video) {
    const { begin, end } = video.dataset;
    if (!this.#playing || !this.#seen.has(video) || video.dataset.still !== undefined || !(video.ended || video.currentTime >= Number(end) - END_S)) return;
    video.currentTime = Number(begin);
    this.#show(video);
  }

  #broken(video) {
    video.hidden = true;
    const fault = video.parentElement.querySelector("[data-fault]");
    fault.textContent = t("page.player.cannot_play", "this video cannot be played");
    fault.hidden = false;
  }
}
