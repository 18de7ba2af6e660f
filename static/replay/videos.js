// Videos that follow the clock. Row k is shown from start + k / fps to start + (k + 1) / fps, where `start` is the start of the
// episode in its video file, which may hold several episodes.

import { t } from "../site/sentences.js";

const NEAR_S = 0.02; // smaller differences are not visible
const BEHIND_S = 0.06; // delay of a video beyond which the clock waits for it
const FAR_S = 0.3; // difference beyond which a jump is quicker than catching up
const CATCH_UP = 0.12; // share of the rate by which a video that is ahead or behind plays slower or faster
const CHECK_MS = 200;
const AGAIN_MS = 60000; // time after which a video that fails is requested once more: its address may have expired

export class Videos {
  #clock;
  #videos = [];

  /** `videos` are [{element, address, start}]. */
  constructor(videos, clock) {
    this.#clock = clock;
    for (const { element, address, start = 0 } of videos) this.#add(element, address, start);
    clock.waitFor(() => this.#playable());
    clock.addEventListener("play", () => this.#start());
    clock.addEventListener("pause", () => this.#stop());
    clock.addEventListener("seek", () => this.#jump());
    clock.addEventListener("rate", () => this.#follow());
    setInterval(() => this.#follow(), CHECK_MS);
  }

  #add(element, address, start) {
    const video = { element, start, broken: false, asked: performance.now() };
    const broken = () => {
      if (performance.now() - video.asked > AGAIN_MS) {
        video.asked = performance.now();
        element.load(); // our own address redirects to a new address of the store
        return;
      }
      video.broken = true;
      element.parentElement.querySelector("[data-fault]").textContent = t("page.player.cannot_play", "this video cannot be played");
    };
    element.addEventListener("error", broken);
    element.addEventListener("loadedmetadata", () => this.#place(video));
    if (element.getAttribute("src") !== address) element.src = address;
    else if (element.error) broken(); // the page requested it before this script ran
    else if (element.readyState >= HTMLMediaElement.HAVE_METADATA) this.#place(video);
    this.#videos.push(video);
  }

  get #whole() {
    return this.#videos.filter((video) => !video.broken);
  }

  /** Return whether all videos show the clock's row and have their next pictures. */
  #playable() {
    const { duration, fps, time } = this.#clock;
    return this.#whole.every(({ element, start }) => {
      const shown = element.currentTime - start;
      const over = element.ended || Math.min(duration, element.duration - start) - shown < 2 / fps;
      return over || (element.readyState >= HTMLMediaElement.HAVE_FUTURE_DATA && time - shown < BEHIND_S);
    });
  }

  #start() {
    if (!this.#clock.playing) return;
    for (const video of this.#whole) {
      video.element.playbackRate = this.#clock.rate;
      video.element.play().catch((error) => {
        if (error.name !== "AbortError") console.error(`${video.element.dataset.camera}: ${error.message}`);
      });
    }
  }

  #stop() {
    for (const { element } of this.#whole) element.pause();
  }

  #jump() {
    for (const video of this.#whole) this.#place(video);
  }

  /**
   * Move a paused video to the middle of its row, so that no rounding shows a neighbouring picture; a playing one to the
   * clock's time.
   */
  #place({ element, start }) {
    const clock = this.#clock;
    const wanted = start + (clock.playing ? clock.time : (clock.row + 0.5) / clock.fps);
    const begins = element.currentTime === 0 && wanted < 1 / clock.fps; // the first picture is shown without a seek
    if (!begins && Math.abs(element.currentTime - wanted) > 1e-4) element.currentTime = wanted;
  }

  #follow() {
    if (this.#clock.resting) this.#stop();
    if (!this.#clock.playing) return;
    for (const video of this.#whole) {
      const { element, start } = video;
      const off = element.currentTime - start - this.#clock.time;
      if (Math.abs(off) > FAR_S && !element.seeking) this.#place(video);
      const hurry = Math.abs(off) > NEAR_S ? 1 - Math.sign(off) * CATCH_UP : 1;
      element.playbackRate = this.#clock.rate * hurry;
      if (element.paused && !element.ended) this.#start();
    }
  }
}
