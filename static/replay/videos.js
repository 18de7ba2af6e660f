// Any number of videos that follow the clock. Row k of every video is shown from k / fps to (k + 1) / fps.

const NEAR_S = 0.02; // closer than a person sees
const BEHIND_S = 0.06; // beyond it the clock waits for the video
const FAR_S = 0.3; // beyond it a jump is quicker than catching up
const CATCH_UP = 0.12; // share of the rate by which a video that is off runs faster or slower
const CHECK_MS = 200;

export class Videos {
  #clock;
  #videos = [];

  constructor(elements, addresses, clock) {
    this.#clock = clock;
    elements.forEach((video, index) => this.#add(video, addresses[index]));
    clock.waitFor(() => this.#playable());
    clock.addEventListener("play", () => this.#start());
    clock.addEventListener("pause", () => this.#stop());
    clock.addEventListener("seek", () => this.#jump());
    clock.addEventListener("rate", () => this.#follow());
    setInterval(() => this.#follow(), CHECK_MS);
  }

  #add(element, address) {
    const video = { element, broken: false };
    element.addEventListener("error", () => {
      video.broken = true;
      element.parentElement.querySelector("[data-fault]").textContent = "this video cannot be played";
    });
    element.addEventListener("loadedmetadata", () => this.#place(video));
    element.src = address;
    this.#videos.push(video);
  }

  get #whole() {
    return this.#videos.filter((video) => !video.broken);
  }

  /** Whether all show what the clock says and have the pictures that come next. */
  #playable() {
    return this.#whole.every(({ element }) => {
      const over = element.ended || element.duration - element.currentTime < 2 / this.#clock.fps;
      return over || (element.readyState >= HTMLMediaElement.HAVE_FUTURE_DATA && this.#clock.time - element.currentTime < BEHIND_S);
    });
  }

  #start() {
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

  /** In the middle of the row's picture, so that no rounding shows a neighbour. */
  #place({ element }) {
    const clock = this.#clock;
    const wanted = clock.playing ? clock.time : (clock.row + 0.5) / clock.fps;
    if (Math.abs(element.currentTime - wanted) > 1e-4) element.currentTime = wanted;
  }

  #follow() {
    if (!this.#clock.playing) return;
    for (const video of this.#whole) {
      const { element } = video;
      const off = element.currentTime - this.#clock.time;
      if (Math.abs(off) > FAR_S && !element.seeking) this.#place(video);
      const hurry = Math.abs(off) > NEAR_S ? 1 - Math.sign(off) * CATCH_UP : 1;
      element.playbackRate = this.#clock.rate * hurry;
      if (element.paused && !element.ended) this.#start();
    }
  }
}
