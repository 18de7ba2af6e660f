// The cameras of a trial on one clock: what is done to one is done to all.

const TOLERANCE_S = 0.1;

const videos = [...document.querySelectorAll(".result-videos video")];
const button = document.querySelector("[data-videos]");

function others(video) {
  return videos.filter((other) => other !== video);
}

function align(video) {
  for (const other of others(video)) {
    if (Math.abs(other.currentTime - video.currentTime) > TOLERANCE_S) other.currentTime = video.currentTime;
  }
}

function say() {
  if (button) button.textContent = videos.some((video) => !video.paused) ? "Pause all" : "Play all";
}

function playAll() {
  if (videos.every((video) => video.ended)) for (const video of videos) video.currentTime = 0;
  for (const video of videos) {
    // A browser may refuse to play: the button then goes on saying so.
    if (!video.ended) video.play().catch(say);
  }
}

function pauseAll() {
  for (const video of videos) video.pause();
}

for (const video of videos) {
  video.addEventListener("play", () => {
    align(video);
    for (const other of others(video)) if (other.paused && !other.ended) other.play().catch(say);
    say();
  });
  video.addEventListener("pause", () => {
    if (!video.ended && !video.seeking) for (const other of others(video)) other.pause();
    say();
  });
  video.addEventListener("seeked", () => align(video));
  video.addEventListener("ratechange", () => {
    for (const other of others(video)) other.playbackRate = video.playbackRate;
  });
}

if (button && videos.length) {
  button.hidden = false;
  button.addEventListener("click", () => (videos.some((video) => !video.paused) ? pauseAll() : playAll()));
}
